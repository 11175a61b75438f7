"""Terminal output: results on standard output, progress and problems on standard error."""

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
    """Console that prints text without interpreting markup, because text can contain file names.

    On a terminal, lines are wrapped and tables are fitted to its width. Output to a file or a pipe
    is never wrapped or cut.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(highlight=False, markup=False, **options)

    @property
    def options(self) -> ConsoleOptions:
        options = super().options
        return options if self.file.isatty() else options.update(max_width=MAX_WIDTH)

    def print(self, *objects: Any, **options: Any) -> None:
        is_text = all(isinstance(item, str | Text) for item in objects)
        if self.file.isatty():
            super().print(*objects, **{"soft_wrap": is_text, **options})
            return
        for group in [objects] if is_text else [[item] for item in objects]:
            parts = _split_title(group[0]) if isinstance(group[0], Table) else [group]
            for part in parts:
                super().print(*part, **{"soft_wrap": is_text, "crop": False, **options})


def _split_title(table: Table) -> list[list[Any]]:
    """Separate the title of a table from the table, because rich wraps it at the width of the table."""
    table_without_title = copy.copy(table)
    table_without_title.title = None
    return [[part] for part in (table.title, table_without_title) if part is not None]


MAX_WIDTH = 100_000  # width of output to a file or pipe in characters, wider than any table

console = Terminal()
errors = Terminal(stderr=True)


@contextmanager
def show_input_warnings() -> Iterator[None]:
    """Print each InputWarning in the block once, as a single line on standard error."""
    with warnings.catch_warnings():
        warnings.filterwarnings("once", category=InputWarning)
        default_show = warnings.showwarning

        def print_line(message: Warning | str, category: type[Warning], *args: Any, **kwargs: Any) -> None:
            if issubclass(category, InputWarning):
                errors.print(Text("warning", "yellow") + f": {message}")
            else:
                default_show(message, category, *args, **kwargs)

        warnings.showwarning = print_line
        yield


LOG_INTERVAL_S = 15.0  # time between progress lines if standard error is not a terminal


def make_progress() -> Progress:
    """Make a progress display on standard error.

    On a terminal it is a bar with description, count, elapsed and remaining time. Otherwise a line
    with description, count and remaining time is printed every LOG_INTERVAL_S seconds.
    """
    return (Progress if errors.is_terminal else _LineProgress)(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=errors,
        transient=True,
        auto_refresh=errors.is_terminal,
        disable=not errors.is_terminal,
    )


class _LineProgress(Progress):
    """Progress display that prints lines; rich is used only to compute the remaining time."""

    last_line = 0.0

    def add_task(self, *args: Any, **fields: Any) -> TaskID:
        self.last_line = time.monotonic()
        return super().add_task(*args, **fields)

    def update(self, task_id: TaskID, **fields: Any) -> None:
        super().update(task_id, **fields)
        self._print_line(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._print_line(task_id)

    def _print_line(self, task_id: TaskID) -> None:
        now = time.monotonic()
        if now - self.last_line < LOG_INTERVAL_S:
            return
        self.last_line = now
        task = next(task for task in self.tasks if task.id == task_id)
        if not task.visible:
            return
        total = "" if task.total is None else f" of {task.total:.0f}"
        remaining_s = task.time_remaining
        errors.print(
            f"{task.description}: {task.completed:.0f}{total}"
            + ("" if remaining_s is None else f", {format_duration(remaining_s)} left")
        )


def show_scanning(path: Path) -> Status:
    """Show a status line while the times of all frames are read, which can take minutes for a bag."""
    return errors.status(Text(f"reading the times of the frames in {path}"))


@contextmanager
def pause_progress(bar: Progress) -> Iterator[None]:
    """Hide a progress bar within the block, so that another one can be shown."""
    if bar.disable:
        yield
        return
    bar.stop()
    try:
        yield
    finally:
        bar.start()


def show_progress(items: Iterable, description: str, total: int) -> Iterator:
    """Yield `total` items and show the progress."""
    with make_progress() as bar:
        yield from bar.track(items, total=total, description=description)


def format_duration(seconds: float) -> str:
    """Format a duration for display, such as 40 s, 12 min or 1.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
