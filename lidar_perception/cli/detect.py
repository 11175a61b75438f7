"""detect: run a detector on a recording and write the results."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.text import Text

from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import (
    dask_option,
    data_argument,
    jobs_option,
    limit_option,
    mount_height_option,
    open_and_describe,
    out_file_option,
    out_folder_option,
    refuse_jobs_with_dask,
    split_option,
)
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.labels.names import ALIASES
from lidar_perception.runs.terminal import console, errors
from lidar_perception.tracking.params import RECORDED_EGO, TrackingParams
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from lidar_perception.detecting.formats import Run
    from lidar_perception.detecting.run import Summary

FORMATS = ("kitti", "json", "csv", "mcap", "openlabel")


class Formats(click.ParamType):
    """Names of formats, separated by commas."""

    name = "formats"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        if isinstance(value, tuple):
            return value
        choice = Choice(FORMATS, ALIASES)
        return tuple(choice.convert(name, param, ctx) for name in str(value).split(","))


@click.command(cls=Command)
@data_argument()
@out_folder_option("Folder for the results.", required=True)
@click.option(
    "--format",
    "--to",
    "formats",
    type=Formats(),
    multiple=True,
    metavar="FORMAT[,FORMAT...]",
    help=f"What to write: {', '.join(FORMATS)}. May be repeated.  [default: json]",
)
@detector_options(tracking=True)
@click.option(
    "--min-score",
    type=click.FloatRange(0, 1),
    metavar="SCORE",
    help="Minimum score of a box of any class. Default: the thresholds of the detector.",
)
@mount_height_option
@click.option(
    "--track", is_flag=True, help="Write tracks, with ids and velocities, instead of separate boxes for each frame."
)
@click.option(
    "--ego",
    type=Choice(RECORDED_EGO),
    default="auto",
    show_default=True,
    help="With --track, the sensor's motion: from the recording's poses; from the scans, "
    "by KISS-ICP (the extra [odometry]); or none: tracks are relative to the sensor.",
)
@click.option(
    "--clouds/--no-clouds",
    default=True,
    show_default=True,
    help="With --format mcap: write the clouds into the bag too.",
)
@click.option("--png", is_flag=True, help="Draw a picture of every frame, png/FRAME.png.")
@out_file_option("--video", "Draw a video: .mp4 (the extra [video]), .gif or .webp.")
@click.option(
    "--color",
    type=Choice(["height", "intensity"]),
    default="height",
    show_default=True,
    help="Colour of the points in pictures.",
)
@split_option
@limit_option
@jobs_option
@dask_option
@click.option("--force", is_flag=True, help="Start over if FOLDER has another run.")
def detect(
    data: Path,
    out: Path,
    formats: tuple[tuple[str, ...], ...],
    detector: DetectorChoice,
    tracking: TrackingParams,
    min_score: float | None,
    mount_height: float,
    track: bool,
    ego: str,
    clouds: bool,
    png: bool,
    video: Path | None,
    color: str,
    split: Path | None,
    limit: int | None,
    jobs: int,
    dask: str | None,
    force: bool,
) -> None:
    """Run a detector on every frame of the recording at DATA and write boxes, classes and scores,
    with --track also ids and velocities, into FOLDER. DATA needs no labels.

    \b
    kitti      kitti/FRAME.txt, result files of KITTI's object benchmark;
               with --track kitti/SEQUENCE.txt, of its tracking benchmark
    json, csv  detections.json, detections.csv: boxes in the LiDAR frame
    mcap       bag/, a rosbag2 bag with the topics of the nodes, for RViz, Foxglove and view
    openlabel  openlabel/SEQUENCE.json, ASAM OpenLABEL, for label and convert

    --png draws every frame, png/FRAME.png, and --video a video, without a browser.

    Each finished frame is saved at once: the same command resumes an interrupted run, and adds
    formats to a complete one. Frames that cannot be read are listed; the exit code is then 1.

    \b
    Examples:
      lidar-perception detect drive.bag --out results
      lidar-perception detect /data/kitti/object --format kitti,csv --out results --jobs 4
      lidar-perception detect drive.bag --track --range around --format mcap --out results
      lidar-perception detect drive.bag --track --out results --video drive.mp4
    """
    from lidar_perception.detecting.bag import BagFormat
    from lidar_perception.detecting.formats import FORMATS as WRITERS
    from lidar_perception.detecting.formats import Run
    from lidar_perception.detecting.pictures import FrameDrawer, PictureWriter, VideoWriter
    from lidar_perception.detecting.run import detect as run_detector
    from lidar_perception.detecting.run import make_header
    from lidar_perception.detectors.open import check_weights
    from lidar_perception.rendering.files import check_video
    from lidar_perception.tracking.drive_tracker import choose_ego_source

    refuse_jobs_with_dask(jobs > 1, dask)
    if not track and (ego != "auto" or tracking != TrackingParams()):
        raise click.UsageError("--ego and --set tracking.* require --track")
    recording = open_and_describe(data, split=split, sensor_height=mount_height or None)
    if track and not recording.is_sequential:
        raise InputError(
            f"{data} ({recording.layout}) has unrelated frames, which cannot be tracked; leave out --track"
        )
    format_names = list(dict.fromkeys(name for names in formats for name in names))
    if not format_names and not png and video is None:
        format_names = ["json"]
    count = min(len(recording), limit or len(recording))
    if video is not None:
        check_video(video, count)
    height = recording.frames[0].sensor_height
    for warning in check_weights(Path(detector.weights), height):
        errors.print(warning)
    make_detector = partial(detector.open, sensor_height=height, min_score=min_score)
    opened_detector = make_detector()
    header = make_header(
        recording,
        detector.weights,
        opened_detector,
        tracking=tracking if track else None,
        ego=choose_ego_source(recording, ego) if track else None,
        split=None if split is None else str(split),
        device=detector.device,
    )
    if track and min_score is None:  # the tracker also uses weak detections
        make_detector = partial(detector.open, sensor_height=height, min_score=tracking.min_score)
        opened_detector = make_detector()
    run = Run(recording, out, header, count)
    drawer = FrameDrawer(run, color)
    writer_factories: list[Any] = [
        partial(BagFormat, with_clouds=clouds, with_tracks=track) if name == "mcap" else WRITERS[name]
        for name in format_names
    ]
    writer_factories += [partial(PictureWriter, drawer=drawer)] if png else []
    writer_factories += [partial(VideoWriter, drawer=drawer, path=video)] if video else []
    summary = run_detector(
        run,
        make_detector if jobs > 1 or dask else lambda: opened_detector,
        writer_factories,
        tracking=tracking if track else None,
        ego=header["ego"] or "none",
        jobs=jobs,
        dask=dask,
        force=force,
    )
    print_summary(summary, run)
    raise SystemExit(1 if summary.skipped else 0)


def print_summary(summary: Summary, run: Run) -> None:
    """Print counts of boxes, the paths of the results, and the problems of the run."""
    from lidar_perception.scoring.tables import make_table, print_skipped, print_time

    content = summary.compute()
    table = make_table(f"{content['frames']} frames of {run.recording.path}", "class", "boxes", "a frame", width=7)
    for name, count in sorted(content["boxes"].items(), key=lambda item: -item[1]):
        table.add_row(name, str(count), f"{count / content['frames']:.1f}")
    table.add_row("all", str(sum(content["boxes"].values())), "")
    console.print(table)
    if run.header["tracking"] is not None:
        console.print(f"{content['tracks']} tracks, poses: {run.header['ego']}")
    print_time(content["ms"], console)
    for path in summary.paths:
        console.print(f"written: {path}")
    for remark, *others in run.remarks.values():
        suffix = f" ({len(others)} more such frames)" if others else ""
        console.print(Text("note", "yellow") + f": {remark}{suffix}")
    for problem, count in content["problems"].items():
        frames = "frame" if count == 1 else "frames"
        console.print(Text("problem", "yellow") + f" in {count} {frames}: {problem}")
    print_skipped(content["skipped"], console)
