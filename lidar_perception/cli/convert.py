"""convert: turn recordings into bags and data sets, and labels into other formats."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import click
from rich.text import Text

from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import limit_option, open_and_describe, path_option, split_option
from lidar_perception.labels.datasets import LAYOUTS
from lidar_perception.labels.exchange import FORMATS, READERS
from lidar_perception.labels.names import ALIASES
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.types import InputError

MCAP = "mcap"
DATASETS, LABELS = tuple(LAYOUTS), tuple(FORMATS)


@click.command(cls=Command)
@click.argument("source", type=click.Path(path_type=Path), metavar="DATA", required=False)
@click.option(
    "--to",
    "--format",
    "format",
    default=MCAP,
    show_default=True,
    type=Choice(dict.fromkeys((MCAP, *DATASETS, *LABELS)), ALIASES),
    help="Format to write.",
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Bag, folder or file to create.")
@path_option(
    "--data", "Drive to convert, as DATA. To convert labels, give their drive here and their path as DATA.", "DRIVE"
)
@click.option(
    "--from",
    "labels_format",
    type=Choice(READERS, ALIASES),
    help="Format of the labels at DATA. Default: detected automatically.",
)
@click.option(
    "--detections",
    metavar="TOPIC",
    help="Convert the boxes on this topic of the bag at DATA (MarkerArray or Detection3DArray) instead of its labels.",
)
@click.option(
    "--points", default="", metavar="TOPIC", help="Topic of the clouds of a bag.  [default: /points, or the only one]"
)
@path_option(
    "--robot",
    "robot.param.yaml that `setup` wrote, for a recording with a tilted or rotated sensor. Clouds are "
    "converted as in the nodes: levelled, with x ahead, and without the robot's own returns.",
)
@click.option(
    "--deskew",
    is_flag=True,
    help="For a bag: move the points of each cloud to its "
    "stamp, by its column of times and the odometry or TF of the bag.",
)
@click.option("--images", is_flag=True, help="With --to mcap: include the left colour images, as PNG.")
@split_option
@limit_option
@click.option("--force", is_flag=True, help="Replace an existing bag, or files with the same names.")
def convert(
    source: Path | None,
    format: str,
    out: Path,
    data: Path | None,
    labels_format: str | None,
    detections: str | None,
    points: str,
    robot: Path | None,
    deskew: bool,
    images: bool,
    split: Path | None,
    limit: int | None,
    force: bool,
) -> None:
    """Convert the recording DATA to one MCAP bag, or to a data set folder with clouds, labels, poses
    and calibration, or convert only its labels to the format of another tool. With --data DRIVE,
    DATA is the path of labels of that drive.

    A bag has the topics /points, /ground_truth/detections, /camera/camera_info, /camera/extrinsics,
    /tf_static, /odom and with --images /camera/image/compressed. Scans that cannot be read are
    skipped and listed; the exit code is then 1. A folder or file is either written completely or
    not at all. Nothing is replaced without --force.

    \b
    Examples:
      lidar-perception convert /data/kitti/tracking --out tracking.bag
      lidar-perception convert drive.bag --robot robot/robot.param.yaml --out level.bag
      lidar-perception convert drive --to kitti-tracking --out drive_kitti
      lidar-perception convert result --detections /fused_detector/output/detections \\
        --to kitti --out detected
      lidar-perception convert /data/kitti/tracking --to openlabel --out labels.json
      lidar-perception convert labels --data drive --to sustech --out drive_sustech/label
    """
    if source is None:
        source, data = data, None
    if source is None:
        raise click.UsageError("DATA is missing: give the path of a recording")
    converts_labels = data is not None or (format in LABELS and format not in (MCAP, *DATASETS))
    for is_invalid, message in (
        (images and (converts_labels or format != MCAP), "--images requires --to mcap"),
        (
            (robot is not None or deskew) and (converts_labels or detections is not None),
            "--robot and --deskew require a recording with clouds",
        ),
        (labels_format is not None and data is None, "--from requires labels at DATA; give their drive with --data"),
        (
            labels_format is not None and detections is not None,
            "--detections and --from cannot be combined; --detections is for bags, --from for other labels",
        ),
        (data is not None and format == "nuscenes", "for labels, choose --to nuscenes-detection or nuscenes-tracking"),
    ):
        if is_invalid:
            raise click.UsageError(message)
    recording = open_and_describe(
        source if data is None else data, check_mount=robot is None, split=split, points=points
    )
    transform = _make_frame_transform(recording, robot, deskew)
    if converts_labels:
        _convert_labels(source, recording, format, out, labels_format, data is not None, detections, limit, force)
    elif format == MCAP and detections is None:
        _convert_to_bag(source, recording, transform, out, images, limit, force)
    else:
        _convert_to_dataset(source, recording, transform, format, out, detections, limit, force)


def _make_frame_transform(recording: Any, file: Path | None, deskew: bool) -> Callable[[Any], Any]:
    """Return a function that levels and deskews a frame as nodes with this parameter file do.

    Without a file and without deskewing, the function returns the frame unchanged.
    """
    if file is None and not deskew:
        return lambda frame: frame
    from lidar_perception.data import bag_frames, cloud_folder

    if not any(layout.can_open(recording.path) for layout in (bag_frames, cloud_folder)):
        raise InputError(
            f"{recording.path} ({recording.layout}) already has level clouds; --robot and --deskew require bags or "
            "cloud files"
        )
    from lidar_perception.data.levelling import SensorMount, level_frame

    mount = SensorMount()
    if file is not None:
        mount, file_enables_deskew = _read_mount(file)
        deskew = deskew or file_enables_deskew
    if not deskew:
        return partial(level_frame, mount=mount)
    from lidar_perception.data.bag import BagHandle
    from lidar_perception.data.bag_poses import BagPoses

    if not bag_frames.can_open(recording.path):
        raise InputError(f"{recording.path} is not a bag, so it has no odometry or TF, which --deskew needs")
    frame = recording.frames[len(recording) // 2]
    poses = BagPoses(BagHandle(recording.path), frame.load().frame_id).lookup
    level_frame(frame, mount, poses).load()  # fails early if a topic or a column is missing
    return partial(level_frame, mount=mount, poses=poses)


def _read_mount(file: Path) -> tuple[Any, bool]:
    """Return the SensorMount of a parameter file, and True if the file enables deskewing."""
    from lidar_perception.candidates.params import PipelineParams
    from lidar_perception.cli.options import read_config
    from lidar_perception.data.levelling import SensorMount
    from lidar_perception.param_fields import with_values
    from lidar_perception.params import CloudNodeParams

    try:
        params, node_params = (
            with_values(defaults, read_config(file, defaults)) for defaults in (PipelineParams(), CloudNodeParams())
        )
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None
    if params == PipelineParams() and node_params == CloudNodeParams():
        raise InputError(f"{file} does not describe a mounting; give robot.param.yaml, which `setup` writes")
    if node_params.base_frame and params.crop.body:
        raise InputError(
            f"{file} gives crop.body in '{node_params.base_frame}' (base_frame); remove base_frame and give the box "
            "in the sensor's frame, as setup writes it"
        )
    pose = params.ground.sensor_pose
    return SensorMount(
        pose.height,
        pose.roll,
        pose.pitch,
        math.radians(node_params.input.ahead),
        params.crop,
        params.input.intensity_max,
    ), node_params.input.deskew != "off"


def _convert_to_bag(
    source: Path,
    recording: Any,
    transform: Callable[[Any], Any],
    out: Path,
    images: bool,
    limit: int | None,
    force: bool,
) -> None:
    from lidar_perception.data.to_bag import write_bag

    count = min(len(recording), limit or len(recording))
    skipped: list[str] = []
    frames = show_progress(map(transform, islice(recording, count)), f"converting {source}", count)
    written_count = write_bag(out, frames, images=images, force=force, skipped=skipped)
    console.print(f"{out}: {written_count} scans of {count}")
    for line in skipped:
        console.print(Text("left out", "yellow") + f": {line}")
    raise SystemExit(1 if skipped else 0)


def _read_topic_boxes(source: Path, recording: Any, topic: str) -> Any:
    """Read the boxes on a topic of a bag as DriveLabels."""
    from lidar_perception.data.open import split_topic
    from lidar_perception.labels.formats import bag

    return bag.read(split_topic(source)[0], recording.frames[:], topic)


def _convert_to_dataset(
    source: Path,
    recording: Any,
    transform: Callable[[Any], Any],
    format: str,
    out: Path,
    detections: str | None,
    limit: int | None,
    force: bool,
) -> None:
    from lidar_perception.labels.datasets import write_dataset
    from lidar_perception.labels.exchange import export_labels

    labels = None if detections is None else _read_topic_boxes(source, recording, detections)
    count = min(len(recording), limit or len(recording))
    if labels is not None and format == MCAP:
        export_labels(labels.take_first(count), format, out, recording.frames[:count], force)
        console.print(f"{out}: {count} scans")
        return
    frames = show_progress(map(transform, islice(recording, count)), f"converting {source}", count)
    summary = write_dataset(format, frames, out, labels, force)
    drives = f"{summary.drives} drive{'' if summary.drives == 1 else 's'}"
    console.print(f"{out}: {summary.frames} scans of {drives}, {summary.boxes} boxes")
    for remark, frame_count in summary.remarks.items():
        console.print(Text(remark, "yellow") + f" ({frame_count} scans)")


def _convert_labels(
    source: Path,
    recording: Any,
    format: str,
    out: Path,
    labels_format: str | None,
    is_label_path: bool,
    detections: str | None,
    limit: int | None,
    force: bool,
) -> None:
    from lidar_perception.labels.drive_labels import DriveLabels, read_frame_labels
    from lidar_perception.labels.exchange import export_labels, import_labels, recognise_format

    count = min(len(recording), limit or len(recording))
    if detections is not None:
        labels = _read_topic_boxes(source, recording, detections)
    elif is_label_path:
        labels = import_labels(source, labels_format or recognise_format(source), recording.frames)
    else:
        labels = DriveLabels(list(map(read_frame_labels, recording.frames[:])))
    export = export_labels(labels.take_first(count), format, out, recording.frames[:count], force)
    console.print(f"{out}: {export.boxes} boxes of {export.frames} frames, as {format}")
    for content in export.left_out:
        console.print(f"left out: {content}, which the format cannot store", style="yellow")
