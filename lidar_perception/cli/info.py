"""info: what is in a bag."""

from __future__ import annotations

from pathlib import Path

import click
from rich.table import Table

from lidar_perception.data.bag import Bag
from lidar_perception.runs.terminal import console


@click.command()
@click.argument("bag", type=click.Path(path_type=Path))
def info(bag: Path) -> None:
    """Topics, types, counts and length of a BAG.

    \b
    Example:
      lidar-perception info drive.bag
    """
    with Bag(bag) as opened:
        seconds = max(0, opened.end_ns - opened.start_ns) / 1e9
        table = Table(title=f"{bag}: {seconds:.1f} s", title_justify="left")
        for column in ("topic", "type", "messages", "QoS"):
            table.add_column(column, justify="right" if column == "messages" else "left",
                             overflow="fold")
        for topic, kind in sorted(opened.topics.items()):
            profile = "; ".join(f"{q.reliability.name.lower()}, {q.durability.name.lower()}"
                                for q in opened.qos(topic)[:1])
            table.add_row(topic, kind, str(opened.counts[topic]), profile)
    console.print(table)
