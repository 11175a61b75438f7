"""evaluate detection: boxes with scores against labels, without ROS."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from lidar_perception.cli.command import Command, refuse_given
from lidar_perception.cli.data import (
    Walk,
    a_path,
    intervals_option,
    no_labels,
    out_folder,
    walk_options,
)
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.runs.terminal import console
from lidar_perception.runs.terminal import errors as terminal_errors
from lidar_perception.types import InputError


@click.command(cls=Command)
@walk_options()
@a_path("--results", "Result files of any detector, in KITTI's format: DIR/000000.txt ...; "
        "or the folder that `detect --format kitti` wrote.", "DIR")
@detector_options()
@click.option("--min-score", type=click.FloatRange(0, 1), default=MIN_SCORE, show_default=True,
              help="Leave out boxes of --weights with a lower score. Average precision needs "
                   "precision at every recall, so keep this lower than a robot would.")
@click.option("--keep", type=click.FloatRange(0, 1), default=1.0, metavar="SHARE",
              help="Keep only this share of the points of each scan, 0..1, drawn at random but "
              "always the same. Default: 1.")
@click.option("--mount-height", type=click.FloatRange(0, 10), default=0.0, metavar="M",
              help="Height of the sensor above the ground. Default: what the recording says, or "
              "else what its first clouds show.")
@out_folder("Write the detections of --weights as KITTI result files, also for frames without "
            "labels.", "--write-results")
@click.option("--errors", is_flag=True, help="Also print how found boxes differ from the true "
              "ones, by class and range, what each difference costs, and whether scores are "
              "probabilities.")
@click.option("--errors-from", type=click.FloatRange(0, 1), default=0.2, show_default=True,
              metavar="SCORE", help="With --errors: look at boxes from this score on.")
@intervals_option
def detection(walk: Walk, results: Path | None, detector: DetectorChoice | None, min_score: float,
              keep: float, mount_height: float, write_results: Path | None, errors: bool,
              errors_from: float, intervals: int) -> None:
    """Score boxes of Car, Pedestrian and Cyclist by the protocol of KITTI's object benchmark.

    Prints average precision of 2D, BEV and 3D boxes and of orientation at 40 and 11 recall points,
    and pedestrians by centre distance as in the STM-CPA paper. Scores the result files of any
    detector, or runs one on every scan: by default fused.

    \b
    Examples:
      lidar-perception evaluate detection /data/kitti/object --errors
      lidar-perception evaluate detection /data/kitti/object --results out/data
      lidar-perception evaluate detection /data/kitti/object --weights v4.safetensors \\
          --split val.txt --json scores.json --write-results out/data
      lidar-perception evaluate detection drive --weights v4.safetensors --keep 0.1
    """
    from lidar_perception.data.frame import BOXES, CAMERA
    from lidar_perception.detectors.open import check_weights
    from lidar_perception.scoring.detections import measure_detector, measure_result_files
    from lidar_perception.scoring.kitti.box_errors import measure_box_errors, print_box_errors
    from lidar_perception.scoring.kitti.protocol import SCORED, Comparison
    from lidar_perception.scoring.kitti.reliability import measure_reliability, print_reliability
    from lidar_perception.scoring.kitti.report import DetectionReport
    from lidar_perception.scoring.kitti.tables import print_detection_report, print_intervals
    from lidar_perception.scoring.run import Start

    if detector is None:
        refuse_given(("min_score", "device"), "is for a detector that runs; --results DIR has its "
                     "boxes already")
    if not errors:
        refuse_given(("errors_from",), "goes with --errors")
    if write_results is not None and detector is None:
        raise click.UsageError("--write-results writes the detections of a detector; --results DIR "
                               "has its files already")
    if write_results is not None and write_results.is_dir() and any(write_results.iterdir()):
        raise InputError(f"{write_results} has files already; give another name")
    if keep != 1 and detector is None:
        raise click.UsageError("--keep thins the scans that a detector sees; --results DIR sees "
                               "none")
    recording = walk.opened(BOXES if write_results is None else None, scans=detector is not None,
                            sensor_height=mount_height or None)
    start: Start
    if results is not None:
        if not results.is_dir():
            raise InputError(f"{results} is not a folder; give the folder of the result files")
        start = partial(measure_result_files, results)
    else:
        assert detector is not None  # as there are no --results
        height = recording.frames[0].sensor_height
        for doubt in check_weights(Path(detector.weights), height):
            terminal_errors.print(doubt)
        start = measure_detector(
            partial(detector.open, min_score=min_score, sensor_height=height), keep, write_results
        )
    if CAMERA not in recording.has and (results is not None or write_results is not None):
        terminal_errors.print(f"{recording.path} has no camera calibration: result files are in "
                              "the frame of a nominal camera, as detect writes them", style="dim")
    report = DetectionReport(follow=recording.is_sequential)
    walk.fill(report, recording, start)
    if write_results is not None:
        console.print(f"result files: {write_results}")
    if not report.frames and (write_results is None or report.skipped):
        raise no_labels(recording, report.skipped)
    content = {"source": str(results if detector is None else detector.weights), "keep": keep,
               **report.compute()}
    if errors and report.frames:
        concatenate = Comparison.of(report.frames)
        content["errors"] = {
            name: measure_box_errors(report.frames, name, errors_from) for name in SCORED
        }
        content["reliability"] = {name: measure_reliability(concatenate, name) for name in SCORED}
    if intervals and report.frames:
        content["intervals"] = report.intervals(intervals)
    if report.frames:
        print_detection_report(content, console)
        if errors:
            print_box_errors(content["errors"], console)
            print_reliability(content["reliability"], console)
        if intervals:
            print_intervals(content["intervals"], console)
    walk.write(content)
