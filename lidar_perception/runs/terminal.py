"""The terminal: results on standard output, progress and problems on standard error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

console = Console(highlight=False)
errors = Console(stderr=True, highlight=False)


def progress() -> Progress:
    """A progress bar on standard error: text, bar, count, elapsed and remaining time."""
    return Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                    TimeElapsedColumn(), TimeRemainingColumn(), console=errors, transient=True)


def track(items: Iterable, description: str, total: int) -> Iterator:
    """The items, under a progress bar of `total` steps."""
    with progress() as bar:
        yield from bar.track(items, total=total, description=description)
