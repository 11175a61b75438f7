"""evaluate tracking: score tracks against labels with ids, without ROS."""

from __future__ import annotations

from functools import partial

import click
from rich.text import Text

from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import ScoringOptions, make_no_labels_error, scoring_options
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs.terminal import console
from lidar_perception.tracking.params import RECORDED_EGO, TrackingParams


@click.command(cls=Command)
@scoring_options(parallel=False)
@detector_options(tracking=True)
@click.option(
    "--ego",
    type=Choice(RECORDED_EGO),
    default="auto",
    show_default=True,
    help="The sensor's motion: from the recording's poses; from the scans, by KISS-ICP "
    "(the extra [odometry]); or none: tracks are relative to the sensor. auto: the first of these that is "
    "available; poses count as available if one of the first frames has a pose.",
)
def tracking(options: ScoringOptions, detector: DetectorChoice, tracking: TrackingParams, ego: str) -> None:
    """Score tracks of Car, Pedestrian and Cyclist: HOTA, CLEAR MOT and AB3DMOT.

    Requires labels with track ids. Runs in one process, because tracking needs the frames of a
    drive in order.

    \b
    Examples:
      lidar-perception evaluate tracking /data/kitti/tracking --json tracks.json
      lidar-perception evaluate tracking drive --ego kiss_icp --weights v4.safetensors
    """
    from lidar_perception.data.frame import BOXES, POSES
    from lidar_perception.scoring.tracking.report import TrackingReport, measure_tracking
    from lidar_perception.scoring.tracking.tables import print_tracking_report
    from lidar_perception.tracking.drive_tracker import choose_ego_source

    recording = options.open_recording(BOXES)
    open_detector = partial(
        detector.open, min_score=tracking.min_score, sensor_height=recording.frames[0].sensor_height
    )
    report, source = TrackingReport(), choose_ego_source(recording, ego)
    if (ego, source) == ("auto", "kiss_icp") and POSES in recording.contents:
        console.print(
            Text("no pose", "yellow") + ": the first frames have no poses, so KISS-ICP is used; check that odometry, "
            "TF and clouds of the recording share one clock"
        )
    options.fill(report, recording, partial(measure_tracking, open_detector, tracking, source))
    if not report.frames:
        raise make_no_labels_error(recording, report.skipped)
    content = {"source": detector.weights, "ego": source, **report.compute()}
    print_tracking_report(content, console)
    options.write(content)
