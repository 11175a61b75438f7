"""Options shared by the commands that read recordings or score labelled frames."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from lidar_perception.runs.files import check_writable_folder, write_text
from lidar_perception.runs.machine import count_cores
from lidar_perception.runs.terminal import errors
from lidar_perception.types import InputError

# docs/reference/recordings.md has the complete list.
DATA_HELP = (
    "Bag (ROS 2 or ROS 1), KITTI, nuScenes or SemanticKITTI folder, .pcd, .ply, .npy or .bin "
    "files, or the output of `simulate`. BAG:/TOPIC names the clouds of a bag that has "
    "several."
)
MAX_DEFAULT_JOBS = 16  # enough to feed a GPU


def path_option(name: str, description: str, metavar: str = "FILE", **option_args: Any) -> Callable:
    """Return an option that takes a path."""
    return click.option(name, type=click.Path(path_type=Path), metavar=metavar, help=description, **option_args)


class OutFile(click.Path):
    """Path of a file that a command will write. It is refused at the start if it is not writable."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        parent = next(folder for folder in path.absolute().parents if folder.exists())
        if path.is_dir() or str(path) == "-" or not (parent.is_dir() and os.access(parent, os.W_OK)):
            raise InputError(f"cannot write {path}; give the name of a file in a writable folder")
        return path


def out_file_option(name: str, description: str, *aliases: str, **option_args: Any) -> Callable:
    """Return an option that takes the path of a file to write."""
    return click.option(name, *aliases, type=OutFile(path_type=Path), metavar="FILE", help=description, **option_args)


class OutFolder(click.Path):
    """Folder that a command will write into, which need not exist. It is refused at the start if not writable."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        check_writable_folder(path)
        return path


def out_folder_option(description: str, name: str = "--out", **option_args: Any) -> Callable:
    """Return an option that takes the path of a folder to write into."""
    return click.option(name, type=OutFolder(path_type=Path), metavar="FOLDER", help=description, **option_args)


def make_jobs_option(description: str, minimum: int = 0) -> Callable:
    """Return the option --jobs, by default one process per core.

    Args:
        description: start of its help.
        minimum: minimum number of processes.
    """
    return click.option(
        "--jobs",
        type=click.IntRange(minimum),
        default=lambda: min(count_cores(), MAX_DEFAULT_JOBS),
        show_default=f"one per core, at most {MAX_DEFAULT_JOBS}",
        help=f"{description} The result is the same.",
    )


def data_argument(
    description: str = DATA_HELP,
    *,
    required: bool = True,
    several: bool = False,
    value_type: Any = click.Path(path_type=Path),
) -> Callable:
    """Return a decorator that adds the argument DATA, and the option --data with the same meaning.

    The decorated function receives the value as `data`.

    Args:
        description: help of --data.
        required: True if one of the two must be given; otherwise `data` may be None, or ().
        several: True to accept any number of values, as a tuple.
        value_type: type of a value.
    """

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(*args: Any, data: Any, data_option: Any, **kwargs: Any) -> Any:
            if data and data_option:
                argument_text, option_text = (
                    " ".join(map(str, value if several else [value])) for value in (data, data_option)
                )
                raise click.UsageError(f"expected one DATA, got {argument_text} and --data {option_text}")
            if required and not (data or data_option):
                raise click.UsageError("DATA is missing: give the path of a recording")
            return function(*args, data=data or data_option, **kwargs)

        wrapper = click.option(
            "--data",
            "data_option",
            type=value_type,
            multiple=several,
            metavar="DATA",
            help=f"Same as DATA. {description}",
        )(wrapper)
        return click.argument(
            "data",
            type=value_type,
            required=False,
            nargs=-1 if several else 1,
            metavar=("DATA" if required else "[DATA]") + "..." * several,
        )(wrapper)

    return decorate


def make_mount_height_option(default: str) -> Callable:
    """Return the option --mount-height, with a description of the height without it."""
    return click.option(
        "--mount-height",
        type=click.FloatRange(0, 10),
        default=0.0,
        metavar="M",
        help=f"Height of the sensor above the ground. Default: {default}.",
    )


mount_height_option = make_mount_height_option("the height in the recording, or measured on its first clouds")
simulated_height_option = make_mount_height_option("the height in its file or preset")
split_option = path_option("--split", "Use only the frames or sequences named in this file, one per line.")
limit_option = click.option("--limit", type=click.IntRange(1), metavar="N", help="Only the first N frames.")
jobs_option = click.option(
    "--jobs", type=click.IntRange(1), default=1, show_default=True, metavar="N", help="Number of processes."
)
dask_option = click.option(
    "--dask",
    metavar="ADDRESS",
    help="Run on the workers of the Dask "
    "scheduler at this address, such as tcp://10.0.0.1:8786. The workers must be able to read DATA at the same path.",
)
json_option = out_file_option("--json", "Write the scores to this file.", "json_file")
intervals_option = click.option(
    "--intervals",
    type=click.IntRange(0),
    default=0,
    metavar="N",
    help="Also print bootstrap intervals from N resamples of the "
    "drives, or of blocks of 10 frames if there are few drives. 200 resamples are enough.",
)
port_option = click.option(
    "--port", type=click.IntRange(0, 65535), default=0, show_default=True, help="Port on 127.0.0.1; 0: any free port."
)
browser_option = click.option(
    "--open/--no-open", "browser", default=True, help="Open the page in a browser.  [default: open]"
)


@dataclass(frozen=True)
class ScoringOptions:
    """Options shared by the commands that score frames."""

    data: Any  # one path, or a list of paths
    split: Path | None
    limit: int | None
    jobs: int
    dask: str | None
    json_file: Path | None

    @property
    def in_this_process(self) -> bool:
        """True if all frames are scored in this process."""
        return self.jobs == 1 and self.dask is None

    def open_recording(self, needs: str | None, data: Path | None = None, **open_args: Any) -> Any:
        """Open the recording, or another one at `data` (see open_and_describe).

        Args:
            needs: required content, such as data.frame.BOXES; None: nothing.

        Raises:
            InputError: the recording lacks the required content.
        """
        recording = open_and_describe(data or self.data, split=self.split, **open_args)
        if needs is not None:
            recording.require(needs, click.get_current_context().command_path.partition(" ")[2])
        return recording

    def fill(self, report: Any, recording: Any, start: Any, title: str = "evaluating") -> None:
        """Add the scores of all frames of the recording to a report, see scoring.run.fill_report."""
        from lidar_perception.scoring.run import fill_report

        fill_report(report, recording, start, limit=self.limit, jobs=self.jobs, dask=self.dask, title=title)

    def write(self, content: dict) -> None:
        """Write the scores as JSON if --json was given."""
        write_json(self.json_file, content)


def refuse_jobs_with_dask(has_jobs: bool, dask: str | None) -> None:
    """Raise UsageError if both --jobs and --dask are given."""
    if has_jobs and dask:
        raise click.UsageError("--jobs and --dask cannot be combined; --jobs runs on this machine, --dask on others")


def scoring_options(data: Callable = data_argument(), *, parallel: bool = True) -> Callable:
    """Return a decorator that adds DATA, --split, --limit, --jobs, --dask and --json.

    The decorated function receives them as `options`, a ScoringOptions.

    Args:
        data: decorator that adds DATA.
        parallel: False to leave out --jobs and --dask.
    """

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(*args: Any, data, split, limit, json_file, jobs=1, dask=None, **kwargs: Any) -> Any:
            refuse_jobs_with_dask(jobs > 1, dask)
            options = ScoringOptions(data, split, limit, jobs, dask, json_file)
            return function(*args, options=options, **kwargs)

        processes = (dask_option, jobs_option) if parallel else ()
        for option in (json_option, *processes, limit_option, split_option, data):
            wrapper = option(wrapper)
        return wrapper

    return decorate


def open_and_describe(data: Path, *, check_mount: bool = True, **open_args: Any) -> Any:
    """Open a recording (see data.open.open_recording) and print its summary.

    If the recording does not state the sensor height, it is measured on the first clouds.

    Args:
        check_mount: True to report a tilted sensor and the scale of the intensity.
    """
    from lidar_perception.data.mount_check import apply_measured_height, find_mount_problem, load_first_clouds
    from lidar_perception.data.open import open_recording
    from lidar_perception.wire.messages import diagnose_recorded_intensity

    recording = open_recording(data, **open_args)
    errors.print(str(recording), style="dim")
    for line in describe_missing_scans(recording):
        errors.print(line, style="yellow")
    clouds = load_first_clouds(recording)
    recording_with_height = apply_measured_height(recording, clouds)
    if recording_with_height is not recording:
        height = next(iter(recording_with_height)).sensor_height
        errors.print(f"sensor height {height:.2f} m, measured on the first clouds", style="dim")
    if check_mount and clouds:
        if (full_scale := recording.frames[0].intensity_max()) > 1:
            errors.print(f"intensity 0 .. {full_scale:g}, read as 0 .. 1", style="dim")
        for problem in filter(
            None,
            (
                None if recording.has_sensor_height else find_mount_problem(recording, clouds),
                diagnose_recorded_intensity(recording.path, clouds),
            ),
        ):
            errors.print(problem, style="yellow")
    return recording_with_height


def describe_missing_scans(recording: Any) -> list[str]:
    """Return a message with the number of labels whose scan is missing; [] if there are none."""
    reasons = [reason for _, reason in recording.missing_scans]
    return [f"labels without a scan: {len(reasons)}, such as {reasons[0]}"] if reasons else []


def with_recorded_height(recording: Any, params: Any) -> Any:
    """Return params with the sensor height of the recording, unless they already set a height."""
    from lidar_perception.ground.params import set_sensor_height
    from lidar_perception.types import SENSOR_HEIGHT

    if params.ground.sensor_pose.height != SENSOR_HEIGHT:
        return params
    return set_sensor_height(params, recording.frames[0].sensor_height)


def write_json(path: Path | None, content: dict) -> None:
    """Write the scores as JSON, unless path is None."""
    if path is not None:
        write_text(path, json.dumps(content, indent=1))


def make_no_labels_error(recording: Any, skipped: list[str], requirement: str = "labels") -> InputError:
    """Return the error for a run without scored frames, with the reason for the first frame."""
    reason = f" ({skipped[0]})" if skipped else ""
    return InputError(f"{recording.path}: no frame with {requirement}{reason}")
