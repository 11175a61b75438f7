"""Command realism: compare simulated scans with real ones."""

from __future__ import annotations

from pathlib import Path

import click

from experiments.realism.compare import compare_scans, measure_scans, select_frames
from experiments.realism.report import print_realism
from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.cli.command import Command
from lidar_perception.cli.data import (
    data_argument,
    open_and_describe,
    out_file_option,
    simulated_height_option,
    write_json,
)
from lidar_perception.data.frame import BOXES
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.simulation.scene import MAX_PEOPLE, Scenes
from lidar_perception.simulation.sensor import find_sensor


@click.command(cls=Command)
@data_argument("Real labelled scans: a data set or bag.")
@click.option(
    "--sensor", default="hdl64e", show_default=True, help="Sensor to simulate, as in `lidar-perception simulate`."
)
@simulated_height_option
@click.option(
    "--frames",
    type=click.IntRange(1),
    default=40,
    show_default=True,
    help="Number of simulated scans, each from a different street.",
)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True)
@click.option(
    "--people",
    type=click.FloatRange(0, MAX_PEOPLE),
    default=1.0,
    show_default=True,
    help="Number of pedestrians and cyclists relative to the default.",
)
@out_file_option("--json", "Write all curves to this file.")
def realism(
    data: Path, sensor: str, mount_height: float, frames: int, seed: int, people: float, json: Path | None
) -> None:
    """Compare scans of simulated streets with the labelled scans of DATA, curve by curve.

    \b
    Example:
      ./lidar realism /data/kitti/object --json realism.json
    """
    model = find_sensor(sensor, mount_height)
    recording = open_and_describe(data)
    recording.require(BOXES, "realism")
    real_frames = select_frames(recording)
    warm_up()
    real = measure_scans(show_progress(real_frames, "measuring real scans", len(real_frames)), PAPER)
    simulated_frames = simulate_frames(seed, frames, model, frames_per_drive=1, scenes=Scenes(None, people, "street"))
    simulated = measure_scans(show_progress(simulated_frames, "measuring simulated scans", frames), PAPER)
    content = {"data": str(data), "seed": seed, **compare_scans(real, simulated)}
    print_realism(content, console)
    write_json(json, content)
