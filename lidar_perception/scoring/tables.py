"""Tables for people."""

from __future__ import annotations

import math

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

MAX_SHOWN = 5  # reasons why frames were skipped


def make_table(title: str, first: str, *others: str, width: int = 0) -> Table:
    """A table whose columns fit into 80 characters: the first one of words, which are folded on a
    narrow terminal, the others, each at least `width` wide, of numbers."""
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, caption_justify="left")
    table.add_column(first, overflow="fold")
    for name in others:
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    return table


def format_number(value: float | None, digits: int = 2, width: int = 5) -> str:
    """In at most width characters: 84.00, 100.0; a dash for None and infinity."""
    return "-" if value is None or math.isinf(value) else f"{value:.{digits}f}"[:width].rstrip(".")


def format_interval(interval: list[float] | None) -> str:
    """44-89; a dash for none."""
    return "-" if interval is None else "-".join(f"{value:.0f}" for value in interval)


def format_percent(row: dict, *keys: str) -> list[str]:
    """Shares of a row of scores, 0 .. 1, in percent."""
    return [f"{100 * row[key]:.1f}" for key in keys]


def format_counts(row: dict, *keys: str) -> list[str]:
    """Whole numbers of a row of scores."""
    return [str(row[key]) for key in keys]


def print_time(ms: float | None, console: Console) -> None:
    """Of the detector, if one was run."""
    if ms is not None:
        console.print(f"detector: {ms:.1f} ms a frame (median)")


def print_skipped(lines: list[str], console: Console) -> None:
    """The first reasons why frames were left out."""
    for line in lines[:MAX_SHOWN]:
        console.print(Text("skipped", "yellow") + f": {line}")
    if len(lines) > MAX_SHOWN:
        console.print(Text("skipped", "yellow")
                      + f": {len(lines) - MAX_SHOWN} more, see the JSON file")
