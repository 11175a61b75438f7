"""Definition of an experiment, and the tables and figures of its report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from lidar_perception.data.frame import Frame


@dataclass(frozen=True)
class Cell:
    """A measured value, its 95 % interval and the paper's value; None where there is none.

    Attributes:
        digits: Decimals shown. Values are in the unit of their column, such as percent.
    """

    value: float | None
    low: float | None = None
    high: float | None = None
    paper: float | None = None
    digits: int = 1


Row = tuple[str | Cell, ...]


@dataclass(frozen=True)
class Table:
    """A table of the report.

    Attributes:
        name: Name of the CSV file, without its ending.
        header: Names of the columns, with units.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""


@dataclass(frozen=True)
class Line:
    """One curve of a figure.

    Attributes:
        low, high: 95 % interval of y.
        dashed: Draw a dashed line, for the paper's values.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float | None]
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()
    dashed: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes of a figure."""

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Figure:
    """A figure of the report; name is the name of the PNG file, without its ending."""

    name: str
    title: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Section:
    """A heading of the report, with a text, tables and figures."""

    title: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """An experiment: each frame gives a record, and all records give the report.

    Attributes:
        measure: measure(frames, i) returns the record of frame i, a dict that JSON can hold. It
            may read the frames before i. It raises InputError to skip the frame; the report counts
            and names skipped frames.
        make_sections: make_sections(records) returns the report of the records of all frames, in
            their order. It is also called with the records of unfinished runs, and with none.
        settings: Everything that the records depend on. A run resumes only with equal settings.

    Both functions belong to a module, so that worker processes can import them.
    """

    name: str
    title: str
    question: str
    measure: Callable[[Sequence[Frame], int], dict[str, Any]]
    make_sections: Callable[[list[dict[str, Any]]], list[Section]]
    settings: dict[str, Any] = field(default_factory=dict)
