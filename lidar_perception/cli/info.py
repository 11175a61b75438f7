"""info: list the contents of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from rich.table import Table

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import data_argument, lost_labels
from lidar_perception.data import bag_frames
from lidar_perception.data.bag import Bag
from lidar_perception.data.open import layout_of, open_recording
from lidar_perception.runs.terminal import console


@click.command(cls=Command)
@data_argument()
def info(data: Path) -> None:
    """Print the topics, types, counts and length of a bag; of any other recording its layout,
    frames, times, first cloud and labels.

    \b
    Examples:
      lidar-perception info drive.bag
      lidar-perception info /data/kitti/tracking
    """
    if layout_of(data) in (None, bag_frames):
        _print_bag(data)
    else:
        _print_recording(open_recording(data))


def _print_bag(path: Path) -> None:
    with Bag(path) as opened:
        seconds = max(0, opened.end_ns - opened.start_ns) / 1e9
        table = Table(title=f"{path}: {seconds:.1f} s", title_justify="left")
        for column in ("topic", "type", "messages", "QoS"):
            table.add_column(column, justify="right" if column == "messages" else "left",
                             overflow="fold")
        for topic, kind in sorted(opened.topics.items()):
            profile = "; ".join(f"{q.reliability.name.lower()}, {q.durability.name.lower()}"
                                for q in opened.qos(topic)[:1])
            table.add_row(topic, kind, str(opened.counts[topic]), profile)
    console.print(table)


def _print_recording(recording: Any) -> None:
    console.print(str(recording))
    drives = sorted({frame.sequence for frame in recording if frame.sequence})
    if drives:
        console.print(f"drives: {', '.join(drives)}")
    stamps = [frame.stamp_ns for frame in recording]
    console.print("times: as recorded, the first at "
                  f"{min(stamps) // 10**9}.{min(stamps) % 10**9:09} s" if recording.timed
                  else "times: none, 10 Hz assumed")
    first = recording.frames[0]
    scan = first.load()
    intensity = ("no intensity" if scan.intensity is None else
                 f"intensity up to {scan.intensity.max(initial=0):.3g}")
    if first.intensity_max() > 1:
        intensity += f" of 1, which is {first.intensity_max():g} in the files"
    console.print(f"first cloud: {first.name}, {len(scan)} points, {intensity}")
    truth = first.truth()
    if truth is not None:
        console.print(f"its labels: {', '.join(truth.labels) or 'none'}")
    for line in lost_labels(recording):
        console.print(line)
