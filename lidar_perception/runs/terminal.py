"""The terminal: results on standard output, progress and problems on standard error."""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.status import Status
from rich.table import Table
from rich.text import Text

from lidar_perception.types import InputWarning


class Terminal(Console):
    """A console whose text is no markup, as it holds names of files. Only a terminal breaks lines
    of text, and tables are as wide as it; in a file or a pipe nothing is broken or cut."""

    def __init__(self, **more: Any) -> None:
        super().__init__(highlight=False, markup=False, **more)

    @property
    def options(self) -> ConsoleOptions:
        return super().options if self.file.isatty() else super().options.update(max_width=WIDE)

    def print(self, *objects: Any, **how: Any) -> None:
        text = all(isinstance(each, str | Text) for each in objects)
        if self.file.isatty():
            super().print(*objects, **{"soft_wrap": text, **how})
            return
        for each in [objects] if text else [[each] for each in objects]:
            parts = _parts(each[0]) if isinstance(each[0], Table) else [each]
            for part in parts:
                super().print(*part, **{"soft_wrap": text, "crop": False, **how})


def _parts(table: Table) -> list[list[Any]]:
    """The title, which rich would break at the width of the table, and the rest of a table."""
    bare = copy.copy(table)
    bare.title = None
    return [[each] for each in (table.title, bare) if each is not None]


WIDE = 100_000  # characters; wider than any table

console = Terminal()
errors = Terminal(stderr=True)

@contextmanager
def input_warnings_shown() -> Iterator[None]:
    """Print each InputWarning once, as one line on standard error."""
    with warnings.catch_warnings():
        warnings.filterwarnings("once", category=InputWarning)
        show = warnings.showwarning

        def print_line(message: Warning | str, category: type[Warning], *where: Any,
                       **more: Any) -> None:
            if issubclass(category, InputWarning):
                errors.print(Text("warning", "yellow") + f": {message}")
            else:
                show(message, category, *where, **more)

        warnings.showwarning = print_line
        yield


EVERY = 15.0  # seconds between lines where there is no terminal


def progress() -> Progress:
    """Progress on standard error: in a terminal a bar with text, count, elapsed and remaining time;
    elsewhere, as in a log, a line of the same every EVERY seconds."""
    return (Progress if errors.is_terminal else _Lines)(
        TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TimeRemainingColumn(), console=errors, transient=True,
        auto_refresh=errors.is_terminal, disable=not errors.is_terminal)


class _Lines(Progress):
    """Progress that is written line by line; rich itself shows nothing, but knows the speed."""

    said = 0.0

    def add_task(self, *args: Any, **fields: Any) -> TaskID:
        self.said = time.monotonic()
        return super().add_task(*args, **fields)

    def update(self, task_id: TaskID, **fields: Any) -> None:
        super().update(task_id, **fields)
        self._say(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._say(task_id)

    def _say(self, task_id: TaskID) -> None:
        now = time.monotonic()
        if now - self.said < EVERY:
            return
        self.said = now
        task = next(task for task in self.tasks if task.id == task_id)
        if not task.visible:
            return
        of = "" if task.total is None else f" of {task.total:.0f}"
        left = task.time_remaining
        errors.print(f"{task.description}: {task.completed:.0f}{of}"
                     + ("" if left is None else f", {duration(left)} left"))


def looking_through(path: Path) -> Status:
    """Shown in a terminal while all frames of a recording are found, for the times of all: of a bag
    of hours that takes minutes."""
    return errors.status(Text(f"looking through {path}"))


@contextmanager
def paused(bar: Progress) -> Iterator[None]:
    """Without this bar, so that another one can be shown."""
    if bar.disable:
        yield
        return
    bar.stop()
    try:
        yield
    finally:
        bar.start()


def track(items: Iterable, description: str, total: int) -> Iterator:
    """The items, under the progress of `total` steps."""
    with progress() as bar:
        yield from bar.track(items, total=total, description=description)


def duration(seconds: float) -> str:
    """For people: 40 s, 12 min, 1.5 h."""
    return (f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min" if seconds < 5400
            else f"{seconds / 3600:.1f} h")
