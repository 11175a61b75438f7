"""Definitions of an experiment, and of the tables and figures of its report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from experiments.framework.trained_models import Model, TrainedModel, Training


@dataclass(frozen=True)
class Cell:
    """A measured value, its 95 % interval and the paper's value. Unknown values are None.

    Values are in the unit of their column, such as percent.

    Attributes:
        digits: Number of decimals to show.
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
        name: Name of the CSV file without suffix.
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
        dashed: True to draw a dashed line, as for the paper's values.
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
    """A figure of the report. `name` is the name of the PNG file without its suffix."""

    name: str
    title: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture of the report, with pixels (height, width, 3) uint8. `name` is as in Figure."""

    name: str
    title: str
    pixels: np.ndarray


@dataclass(frozen=True)
class Section:
    """A heading of the report, with a text, tables and figures."""

    title: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure | Picture, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """An experiment, which measures one record per frame and makes a report from all records.

    Attributes:
        measure: Function measure(frames, i) that returns the record of frame i, a JSON-serialisable
            dict. It may read earlier frames. It raises InputError to skip the frame; the report
            counts and lists skipped frames.
        make_sections: Function make_sections(records) that makes the report from the records of all
            frames, in order. It is also called with the records of unfinished runs, and with an
            empty list.
        settings: Everything that the records depend on. A run can only be resumed with equal
            settings.
        training: Parameters of the detectors to train, or None if the experiment trains none. With
            training, measure() and make_sections() also get models=, the trained models by name.
        protocol: Training parameters of the paper, by dotted name. They are used for recordings
            without a time budget.
        models: Function models(params, seed) that returns the detectors to train for a seed, the
            most important ones first.
        illustrate: Function illustrate(records, frames) that makes sections with pictures of
            frames. It also gets models=.
        has_models: True if the functions already have their models, see with_models().

    The functions are defined at module level, so that worker processes can import them.
    """

    name: str
    title: str
    question: str
    measure: Callable[..., dict[str, Any]]
    make_sections: Callable[..., list[Section]]
    settings: dict[str, Any] = field(default_factory=dict)
    training: Training | None = None
    protocol: Mapping[str, Any] = field(default_factory=dict)
    models: Callable[[Any, int], Sequence[Model]] | None = None
    illustrate: Callable[..., list[Section]] | None = None
    has_models: bool = False

    def with_models(self, models: Mapping[str, TrainedModel]) -> Experiment:
        """Return the experiment whose functions get these models."""
        return replace(
            self,
            measure=partial(self.measure, models=models),
            make_sections=partial(self.make_sections, models=models),
            illustrate=self.illustrate and partial(self.illustrate, models=models),
            has_models=True,
        )
