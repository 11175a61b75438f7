"""evaluate tracking: tracks against labels with ids, without ROS."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click
from rich.text import Text

from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import (
    data_argument,
    json_option,
    limit_option,
    no_labels,
    opened,
    split_option,
    write_json,
)
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs.terminal import console
from lidar_perception.tracking.params import RECORDED_EGO, TrackingParams


@click.command(cls=Command)
@data_argument()
@split_option
@limit_option
@detector_options(tracking=True)
@click.option("--ego", type=Choice(RECORDED_EGO), default="auto", show_default=True,
              help="The sensor's motion: from the recording's poses; from the scans, by KISS-ICP "
              "(the extra [odometry]); or none: tracks are relative to the sensor. auto: the first "
              "of these that is available, poses where one of the first frames has one.")
@json_option
def tracking(data: Path, split: Path | None, limit: int | None, detector: DetectorChoice,
             tracking: TrackingParams, ego: str, json_file: Path | None) -> None:
    """Score tracks of Car, Pedestrian and Cyclist: HOTA, CLEAR MOT and AB3DMOT.

    The labels need track ids, and the frames of a drive come one after the other, so this runs in
    one process.

    \b
    Examples:
      lidar-perception evaluate tracking /data/kitti/tracking --json tracks.json
      lidar-perception evaluate tracking drive --ego kiss_icp --weights v4.safetensors
    """
    from lidar_perception.data.frame import BOXES, POSES
    from lidar_perception.scoring.run import fill
    from lidar_perception.scoring.tracking.report import TrackingReport, measure_tracking
    from lidar_perception.scoring.tracking.tables import print_tracking_report
    from lidar_perception.tracking.drive_tracker import choose_ego_source

    recording = opened(data, split=split)
    recording.require(BOXES, "evaluate tracking")
    open_ = partial(detector.open, min_score=tracking.min_score,
                    sensor_height=recording.frames[0].sensor_height)
    report, asked, ego = TrackingReport(), ego, choose_ego_source(recording, ego)
    if (asked, ego) == ("auto", "kiss_icp") and POSES in recording.has:
        console.print(Text("no pose", "yellow") + ": the first frames have none, so poses are by "
                      "KISS-ICP; see whether the odometry or TF of the recording has the clock of "
                      "its clouds")
    fill(report, recording, measure_tracking(open_, tracking, ego), limit=limit)
    if not report.frames:
        raise no_labels(recording, report.skipped)
    content = {"source": detector.weights, "ego": ego, **report.compute()}
    print_tracking_report(content, console)
    write_json(json_file, content)
