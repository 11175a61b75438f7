"""setup: measure a sensor and its mounting from unlabelled clouds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import data_argument, out_folder_option
from lidar_perception.runs.files import make_folder, write_text
from lidar_perception.runs.terminal import console, errors, make_progress, show_scanning
from lidar_perception.types import InputError

FILES = ("sensor.yaml", "robot.param.yaml", "lidar_perception.rviz", "foxglove_layout.json")
COLORS = {"high": "green", "fair": "default", "low": "yellow"}


@click.command(cls=Command)
@data_argument(
    "A bag, a .pcd, .ply, .npy or .bin file or a folder of them, or the folder of a data set. Labels are not needed."
)
@out_folder_option("Folder for the files.", required=True)
@click.option("--topic", metavar="TOPIC", help="Topic of the clouds, for a bag with several sensors.")
@click.option(
    "--scans",
    type=click.IntRange(1),
    default=40,
    show_default=True,
    help="Number of clouds to use, in pairs spread over the recording.",
)
@click.option(
    "--height-hint",
    type=click.FloatRange(0, 50, min_open=True),
    metavar="METRES",
    help="Known height of the sensor, to check against the clouds.",
)
@click.option("--force", is_flag=True, help="Replace the files of an earlier run.")
def setup(data: Path, out: Path, topic: str | None, scans: int, height_hint: float | None, force: bool) -> None:
    """Measure a LiDAR, its mounting and the robot's body from unlabelled clouds.

    Prints each value with its confidence, and warnings with remedies. Writes sensor.yaml, which
    `simulate --sensor` and `train --sensor` take, robot.param.yaml for the nodes, and layouts for
    RViz and Foxglove. Works best with some minutes of driving in open space.

    \b
    Examples:
      lidar-perception setup drive.bag --topic /points --out robot
      lidar-perception simulate --sensor robot/sensor.yaml --out street
      lidar-perception run fused_detector --ros-args --params-file robot/robot.param.yaml
    """
    existing_files = [name for name in FILES if (out / name).exists()]
    if existing_files and not force:
        raise InputError(f"{out / existing_files[0]} already exists; give another folder or --force")
    from lidar_perception.data.raw_clouds import choose_clouds, open_clouds
    from lidar_perception.sensor_setup.measurement.measure import measure_sensor
    from lidar_perception.sensor_setup.measurement.recorded_poses import read_recorded_poses
    from lidar_perception.sensor_setup.measurement.scans import read_scan
    from lidar_perception.sensor_setup.report.files import format_params, format_sensor
    from lidar_perception.sensor_setup.report.values import list_values
    from lidar_perception.sensor_setup.report.warnings import find_warnings

    with show_scanning(data):
        clouds = open_clouds(data, topic)
    if topic is not None and not clouds.topic:
        raise InputError(f"--topic {topic} requires a bag; {data} is {clouds.layout}")
    count = f"{clouds.count} cloud{'s' * (clouds.count != 1)}"
    errors.print(f"{data}: {clouds.layout}, {count}", style="dim")
    numbers, scans_read, skipped = [], [], []
    indices = choose_clouds(clouds.count, scans)
    with make_progress() as bar:
        task = bar.add_task("reading", total=len(indices) + 1)
        for i in indices:
            try:
                scans_read.append(read_scan(clouds.load(i), f"cloud {i} of {data}"))
                numbers.append(i)
            except InputError as error:
                skipped.append(str(error))
            bar.advance(task)
        if not scans_read:
            raise InputError(skipped[0])
        bar.update(task, description="measuring")
        recorded_poses = read_recorded_poses(clouds.poses, numbers, clouds.stamps_ns)
        measurement = measure_sensor(
            scans_read, numbers, str(data), clouds.count, clouds.stamps_ns, recorded_poses, height_hint
        )
    files = {
        "sensor.yaml": format_sensor(measurement),
        "robot.param.yaml": format_params(measurement),
        **_make_layouts(clouds.topic or "/points", measurement.source.scans[0].frame_id),
    }
    make_folder(out)
    for name, text in files.items():
        write_text(out / name, text)
    _print_values(list_values(measurement))
    for line in skipped:
        console.print(Text("left out", "yellow") + f": {line}")
    for line in find_warnings(measurement):
        console.print(Text("warning", "yellow") + f": {line}")
    console.print(f"{out}: {', '.join(files)}")


def _print_values(rows: list[Any]) -> None:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("what", "value", "confidence"):
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(row.name, row.value, Text(row.confidence, COLORS[row.confidence]))
    console.print(table)


def _make_layouts(topic: str, frame: str) -> dict[str, str]:
    """Return the package's layouts for RViz and Foxglove with this topic and frame.

    Empty if the layouts are not installed.
    """
    folders = (
        Path(__file__).parents[2] / "config",  # folder of a checkout; otherwise the installed folder is used
        *(p / "share/lidar_perception/config" for p in Path(__file__).parents),
    )
    folder = next((p for p in folders if (p / FILES[-1]).is_file()), None)
    if folder is None:
        return {}
    rviz = (folder / FILES[-2]).read_text(encoding="utf-8")
    foxglove = (folder / FILES[-1]).read_text(encoding="utf-8")
    if frame:
        rviz = rviz.replace("Fixed Frame: velodyne", f"Fixed Frame: {frame}")
        foxglove = foxglove.replace('"velodyne"', json.dumps(frame))
    foxglove = foxglove.replace('"/points"', json.dumps(topic))
    rviz = rviz.replace("        Value: points\n", f"        Value: {topic}\n")
    return {FILES[-2]: rviz, FILES[-1]: foxglove}
