"""Tables and messages of scores on the terminal."""

from __future__ import annotations

import math

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

MAX_SHOWN = 5  # maximum number of reasons listed for skipped frames


def make_table(title: str, first: str, *others: str, width: int = 0) -> Table:
    """Make a table for 80 columns: a first column of text, the others numbers of min. `width`."""
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, caption_justify="left")
    table.add_column(first, overflow="fold")
    for name in others:
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    return table


def format_number(value: float | None, digits: int = 2, width: int = 5) -> str:
    """Format a number in at most width characters (84.00, 100.0); a dash for None and inf."""
    return "-" if value is None or math.isinf(value) else f"{value:.{digits}f}"[:width].rstrip(".")


def format_interval(interval: list[float] | None) -> str:
    """Format an interval as 44-89; a dash for None."""
    return "-" if interval is None else "-".join(f"{value:.0f}" for value in interval)


def format_percent(row: dict, *keys: str) -> list[str]:
    """Format shares 0..1 of a row of scores in percent."""
    return [f"{100 * row[key]:.1f}" for key in keys]


def format_counts(row: dict, *keys: str) -> list[str]:
    """Format integers of a row of scores."""
    return [str(row[key]) for key in keys]


def print_time(ms: float | None, console: Console) -> None:
    """Print the median duration of the detector, if it was run."""
    if ms is not None:
        console.print(f"detector: {ms:.1f} ms a frame (median)")


def print_skipped(lines: list[str], console: Console) -> None:
    """Print the first reasons why frames were skipped."""
    for line in lines[:MAX_SHOWN]:
        console.print(Text("skipped", "yellow") + f": {line}")
    if len(lines) > MAX_SHOWN:
        console.print(Text("skipped", "yellow") + f": {len(lines) - MAX_SHOWN} more, see the JSON file")
