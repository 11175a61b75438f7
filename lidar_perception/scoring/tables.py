"""Tables for people."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table


def narrow_table(title: str, first: str, *others: str, width: int = 0) -> Table:
    """A table whose columns fit into 80 characters: the first one of words, the others, each at
    least width wide, of numbers."""
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, caption_justify="left")
    table.add_column(first, no_wrap=True)
    for name in others:
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    return table


def print_skipped(lines: list[str], console: Console, most: int = 5) -> None:
    """The first reasons why frames were left out."""
    for line in lines[:most]:
        console.print(f"[yellow]skipped[/]: {escape(line)}")
    if len(lines) > most:
        console.print(f"[yellow]skipped[/]: {len(lines) - most} more, see the JSON file")
