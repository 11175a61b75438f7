"""info: print the contents of a recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import data_argument, describe_missing_scans
from lidar_perception.data import bag_frames
from lidar_perception.data.bag import Bag
from lidar_perception.data.open import describe_formats, find_layout, open_recording
from lidar_perception.runs.terminal import console
from lidar_perception.types import InputError


@click.command(cls=Command)
@data_argument()
@click.option("--json", "as_json", is_flag=True, help="Print JSON to standard output.")
def info(data: Path, as_json: bool) -> None:
    """Print the topics, types, counts and duration of a bag, or the layout, frames, times, first
    cloud and labels of another recording.

    \b
    Examples:
      lidar-perception info drive.bag
      lidar-perception info /data/kitti/tracking
      lidar-perception info drive.bag --json
    """
    layout = find_layout(data)
    if layout is None and data.is_dir():
        raise InputError(f"{data} has no metadata.yaml and is not another kind of recording: {describe_formats()}")
    if layout in (None, bag_frames):
        content, print_content = _describe_bag(data), _print_bag
    else:
        content, print_content = _describe_recording(data), _print_recording
    if as_json:
        click.echo(json.dumps(content, indent=1))
    else:
        print_content(content)


def _describe_bag(path: Path) -> dict[str, Any]:
    with Bag(path) as bag:
        return {
            "path": str(path),
            "start_ns": bag.start_ns,
            "seconds": max(0, bag.end_ns - bag.start_ns) / 1e9,
            "topics": [
                {
                    "topic": topic,
                    "type": type_name,
                    "messages": bag.counts[topic],
                    "qos": next(
                        (
                            f"{qos.reliability.name.lower()}, {qos.durability.name.lower()}"
                            for qos in bag.find_qos(topic)
                        ),
                        None,
                    ),
                }
                for topic, type_name in sorted(bag.topics.items())
            ],
            "unreadable": [
                {"topic": name, "type": topic.type, "encoding": topic.encoding, "messages": topic.messages}
                for name, topic in sorted(bag.unreadable.items())
            ],
        }


def _print_bag(content: dict[str, Any]) -> None:
    table = Table(title=f"{content['path']}: {content['seconds']:.1f} s", title_justify="left")
    for column in ("topic", "type", "messages", "QoS"):
        table.add_column(column, justify="right" if column == "messages" else "left", overflow="fold")
    for row in content["topics"]:
        table.add_row(row["topic"], row["type"], str(row["messages"]), row["qos"])
    for row in content["unreadable"]:
        table.add_row(row["topic"], f"{row['type']} as {row['encoding']}, not read", str(row["messages"]), "")
    console.print(table)


def _describe_recording(path: Path) -> dict[str, Any]:
    recording = open_recording(path)
    first = recording.frames[0]
    scan, truth = first.load(), first.truth()
    return {
        "path": str(path),
        "summary": str(recording),
        "layout": recording.layout,
        "frames": len(recording),
        "has": sorted(recording.contents),
        "drives": sorted({frame.sequence for frame in recording if frame.sequence}),
        "start_ns": min(frame.stamp_ns for frame in recording) if recording.has_times else None,
        "first_cloud": {
            "name": first.name,
            "points": len(scan),
            "full_intensity": first.intensity_max(),
            "greatest_intensity": None if scan.intensity is None else float(scan.intensity.max(initial=0)),
            "labels": None if truth is None else truth.labels,
        },
        "lost_labels": describe_missing_scans(recording),
    }


def _print_recording(content: dict[str, Any]) -> None:
    console.print(content["summary"])
    if content["drives"]:
        console.print(f"drives: {', '.join(content['drives'])}")
    start = content["start_ns"]
    console.print(
        "times: none, 10 Hz assumed"
        if start is None
        else f"times: as recorded, the first at {start // 10**9}.{start % 10**9:09} s"
    )
    first = content["first_cloud"]
    greatest = first["greatest_intensity"]
    intensity = "no intensity" if greatest is None else f"intensity up to {greatest:.3g}"
    if first["full_intensity"] > 1:
        intensity += f" (0 .. {first['full_intensity']:g} in the files, read as 0 .. 1)"
    console.print(f"first cloud: {first['name']}, {first['points']} points, {intensity}")
    if first["labels"] is not None:
        console.print(f"labels of the first cloud: {', '.join(first['labels']) or 'none'}")
    for line in content["lost_labels"]:
        console.print(line)
