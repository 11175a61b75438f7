"""The options of every verb that walks over labelled frames, and how it opens them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import errors
from lidar_perception.types import InputError

WHAT = ("KITTI (object, tracking, raw), nuScenes or SemanticKITTI folder, rosbag2 bag, or what "
        "`simulate` wrote.")


def a_path(name: str, what: str, metavar: str = "FILE", **more: Any) -> Callable:
    """An option that takes a path."""
    return click.option(name, type=click.Path(path_type=Path), metavar=metavar, help=what, **more)


data_option = a_path("--data", WHAT, "PATH", required=True)
split_option = a_path("--split", "Only the frames, or whole sequences, named in this file, one a "
                      "line.")
limit_option = click.option("--limit", type=click.IntRange(1), metavar="N",
                            help="Only the first N frames.")
device_option = click.option("--device", default="auto", help="Where networks run: auto, cpu, "
                             "cuda. Default: auto.")
jobs_option = click.option("--jobs", type=click.IntRange(1), default=1, show_default=True,
                           metavar="N", help="Processes.")
dask_option = click.option("--dask", metavar="ADDRESS", help="Measure on the workers of the Dask "
                           "scheduler at this address, such as tcp://10.0.0.1:8786, which see PATH "
                           "under the same name.")


json_option = click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
                           help="Write the scores to this file.")


def frame_options(function: Callable) -> Callable:
    """--data, --split, --limit, --jobs and --dask."""
    for option in (dask_option, jobs_option, limit_option, split_option, data_option):
        function = option(function)
    return function


def opened(data: Path, **how: Any) -> Any:
    """The recording at a path, see data.open.open_recording; says in a line what it is."""
    from lidar_perception.data.open import open_recording
    recording = open_recording(data, **how)
    errors.print(escape(str(recording)), soft_wrap=True, style="dim")
    return recording


def one_way(jobs: int, dask: str | None) -> dict[str, Any]:
    """jobs and dask as scoring.run takes them; only one of them says where."""
    if dask and jobs > 1:
        raise click.UsageError("--jobs is for this machine, --dask for others: give one of them")
    return {"jobs": jobs, "dask": dask}


def write_json(path: Path | None, content: dict) -> None:
    """Write what was measured, if a file was asked for."""
    if path is not None:
        write_text(path, json.dumps(content, indent=1))


def no_labels(recording: Any, skipped: list[str], what: str = "labels") -> InputError:
    """That nothing was scored, with the first reason."""
    reason = f" ({skipped[0]})" if skipped else ""
    return InputError(f"{recording.path}: no frame with {what}{reason}")
