"""Terminal output of scores: tables, formatted numbers and messages."""

from __future__ import annotations

import math

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

MAX_SHOWN = 5  # maximum number of skipped frames to list


def make_table(title: str, first: str, *others: str, width: int = 0) -> Table:
    """Make a table with a column of text, followed by right-aligned columns of at least `width`."""
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, caption_justify="left")
    table.add_column(first, overflow="fold")
    for name in others:
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    return table


def format_number(value: float | None, digits: int = 2, width: int = 5) -> str:
    """Format a number with at most `width` characters (84.00, 100.0). None and inf become a dash."""
    return "-" if value is None or math.isinf(value) else f"{value:.{digits}f}"[:width].rstrip(".")


def format_interval(interval: list[float] | None) -> str:
    """Format an interval like 44-89. None becomes a dash."""
    return "-" if interval is None else "-".join(f"{value:.0f}" for value in interval)


def format_percent(row: dict, *keys: str) -> list[str]:
    """Format the ratios (0..1) at these keys of a row of scores as percentages."""
    return [f"{100 * row[key]:.1f}" for key in keys]


def format_counts(row: dict, *keys: str) -> list[str]:
    """Format the counts at these keys of a row of scores."""
    return [str(row[key]) for key in keys]


def print_time(ms: float | None, console: Console) -> None:
    """Print the median run time of the detector, unless it is None."""
    if ms is not None:
        console.print(f"detector: {ms:.1f} ms per frame (median)")


def print_skipped(lines: list[str], console: Console) -> None:
    """Print the reasons for skipped frames, at most MAX_SHOWN of them."""
    for line in lines[:MAX_SHOWN]:
        console.print(Text("skipped", "yellow") + f": {line}")
    if len(lines) > MAX_SHOWN:
        console.print(Text("skipped", "yellow") + f": {len(lines) - MAX_SHOWN} more, see the JSON file")
