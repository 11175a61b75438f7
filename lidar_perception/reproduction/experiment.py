"""What an experiment is: one frame to a record, all records to tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from lidar_perception.data.frame import Frame


@dataclass(frozen=True)
class Cell:
    """A measured figure with its 95 % interval and the paper's figure; None where there is none.

    digits: decimals shown. Values are as shown: percent where the unit of the column is percent.
    """

    value: float | None
    low: float | None = None
    high: float | None = None
    paper: float | None = None
    digits: int = 1


Row = tuple[str | Cell, ...]


@dataclass(frozen=True)
class Table:
    """name becomes a file name; header names the columns, with units; a cell is text or a Cell."""

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""


@dataclass(frozen=True)
class Line:
    """One curve of a figure; low and high are its 95 % interval; dashed for the paper's."""

    label: str
    x: Sequence[float]
    y: Sequence[float | None]
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()
    dashed: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Figure:
    """name becomes a file name."""

    name: str
    title: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Section:
    """A heading of the report, with what was asked, what came out, tables and figures."""

    title: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """measure(frames, i) gives the record of frame i, a dict that JSON can hold, with its name
    under 'frame'; it may look at the frames before i. InputError: the frame is skipped, counted
    and named. sections(records) makes the report of the records of all frames, in their order;
    it is also called on half-finished runs and on no records at all. Both are functions of a
    module, so that worker processes can import them. settings: what the records depend on; a run
    resumes only where it is the same."""

    name: str
    title: str
    question: str
    measure: Callable[[Sequence[Frame], int], dict[str, Any]]
    sections: Callable[[list[dict[str, Any]]], list[Section]]
    settings: dict[str, Any] = field(default_factory=dict)
