"""evaluate detection: score detected boxes against labels, without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click

from lidar_perception.cli.command import Command, refuse_options
from lidar_perception.cli.data import (
    ScoringOptions,
    intervals_option,
    make_no_labels_error,
    mount_height_option,
    out_folder_option,
    path_option,
    scoring_options,
)
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.runs.terminal import console
from lidar_perception.runs.terminal import errors as terminal_errors
from lidar_perception.types import InputError


@dataclass(frozen=True)
class DetectionRequest:
    """Options of `evaluate detection`; exactly one of `results` and `detector` is not None."""

    options: ScoringOptions
    results: Path | None
    detector: DetectorChoice | None
    min_score: float
    keep: float
    mount_height: float
    write_results: Path | None
    errors: bool
    intervals: int

    @property
    def source(self) -> str:
        """Origin of the boxes: a folder of result files, or weights."""
        return str(self.results if self.detector is None else self.detector.weights)

    def check(self) -> None:
        """Raise a UsageError or InputError for options that cannot be combined."""
        if self.detector is None:
            refuse_options(("min_score", "device"), "requires --weights; --results DIR already contains the boxes")
            if self.write_results is not None:
                raise click.UsageError(
                    "--write-results requires --weights; --results DIR already contains result files"
                )
            if self.keep != 1:
                raise click.UsageError("--keep requires --weights; --results DIR does not run a detector")
        elif self.write_results is not None and self.write_results.is_dir() and any(self.write_results.iterdir()):
            raise InputError(f"{self.write_results} already contains files; give another folder")

    def open_recording(self) -> Any:
        """Open the recording. Labels are required unless detections are written."""
        from lidar_perception.data.frame import BOXES, CAMERA

        recording = self.options.open_recording(
            BOXES if self.write_results is None else None,
            scans=self.detector is not None,
            sensor_height=self.mount_height or None,
        )
        if self.results is not None and not self.results.is_dir():
            raise InputError(f"{self.results} is not a folder; give the folder of the result files")
        if self.detector is not None:
            from lidar_perception.detectors.open import check_weights

            for warning in check_weights(Path(self.detector.weights), recording.frames[0].sensor_height):
                terminal_errors.print(warning)
        if CAMERA not in recording.contents and (self.results or self.write_results) is not None:
            terminal_errors.print(
                f"{recording.path} has no camera calibration: result files are "
                "in the frame of a nominal camera, as detect writes them",
                style="dim",
            )
        return recording

    def make_measurement(self, recording: Any) -> Any:
        """Return the function that scores a frame, see scoring.run.StartMeasurement."""
        from lidar_perception.scoring.detections import measure_detector, measure_result_files

        if self.detector is None:
            assert self.results is not None
            return partial(measure_result_files, self.results)
        open_detector = partial(
            self.detector.open, min_score=self.min_score, sensor_height=recording.frames[0].sensor_height
        )
        return partial(measure_detector, open_detector, self.keep, self.write_results)

    def compute(self, report: Any) -> dict[str, Any]:
        """Return the scores of a report as a JSON-serialisable dict."""
        from lidar_perception.scoring.kitti.box_errors import measure_box_errors
        from lidar_perception.scoring.kitti.protocol import SCORED, Comparison
        from lidar_perception.scoring.kitti.reliability import measure_reliability

        content = {"source": self.source, "keep": self.keep, **report.compute()}
        if self.errors and report.frames:
            comparison = Comparison.concatenate(report.frames)
            content["errors"] = {name: measure_box_errors(report.frames, name) for name in SCORED}
            content["reliability"] = {name: measure_reliability(comparison, name) for name in SCORED}
        if self.intervals and report.frames:
            content["intervals"] = report.compute_intervals(self.intervals)
        return content


def _print_scores(content: dict[str, Any]) -> None:
    """Print the tables of the scores in `content`."""
    from lidar_perception.scoring.kitti.box_errors import print_box_errors
    from lidar_perception.scoring.kitti.reliability import print_reliability
    from lidar_perception.scoring.kitti.tables import print_detection_report, print_intervals

    print_detection_report(content, console)
    if "errors" in content:
        print_box_errors(content["errors"], console)
        print_reliability(content["reliability"], console)
    if "intervals" in content:
        print_intervals(content["intervals"], console)


@click.command(cls=Command)
@scoring_options()
@path_option(
    "--results",
    "Result files of any detector, in KITTI's format: DIR/000000.txt ...; "
    "or the folder that `detect --format kitti` wrote.",
    "DIR",
)
@detector_options()
@click.option(
    "--min-score",
    type=click.FloatRange(0, 1),
    default=MIN_SCORE,
    show_default=True,
    help="Minimum score of boxes of --weights. Average precision needs boxes with low scores too, so keep this below "
    "the threshold that is used on the robot.",
)
@click.option(
    "--keep",
    type=click.FloatRange(0, 1),
    default=1.0,
    metavar="FRACTION",
    help="Keep only this fraction (0 to 1) of the points of each scan, drawn with a fixed seed. Default: 1.",
)
@mount_height_option
@out_folder_option(
    "Write the detections of --weights as KITTI result files, also for frames without labels.", "--write-results"
)
@click.option(
    "--errors", is_flag=True, help="Also print the box errors by class and range, and whether scores are calibrated."
)
@intervals_option
def detection(options: ScoringOptions, **choices: Any) -> None:
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
    from lidar_perception.scoring.kitti.report import DetectionReport

    request = DetectionRequest(options, **choices)
    request.check()
    recording = request.open_recording()
    report = DetectionReport(sequential=recording.is_sequential)
    options.fill(report, recording, request.make_measurement(recording))
    if request.write_results is not None:
        console.print(f"result files: {request.write_results}")
    if not report.frames and (request.write_results is None or report.skipped):
        raise make_no_labels_error(recording, report.skipped)
    content = request.compute(report)
    if report.frames:
        _print_scores(content)
    options.write(content)
