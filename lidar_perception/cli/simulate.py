"""simulate: labelled scans without a data set."""

from __future__ import annotations

from pathlib import Path

import click

from lidar_perception.datasets.to_bag import write_bag
from lidar_perception.simulation.to_bag import simulated_scans
from lidar_perception.terminal import console, track


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Bag folder to make.")
@click.option("--frames", type=click.IntRange(1), default=40, show_default=True,
              help="Scans, 10 a second.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True,
              help="Seed of the scene; the same seed gives the same scans.")
@click.option("--force", is_flag=True, help="Replace the bag if it exists.")
def simulate(out: Path, frames: int, seed: int, force: bool) -> None:
    """Write a simulated street drive with true boxes as an MCAP bag.

    \b
    Example:
      lidar-perception simulate --frames 100 --seed 7 --out drive
    """
    count = write_bag(out, track(simulated_scans(seed, frames), "simulating", frames), force=force)
    console.print(f"{out}: {count} scans")
