"""evaluate nuscenes: score detections against the labels of nuScenes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import (
    ScoringOptions,
    make_no_labels_error,
    out_file_option,
    path_option,
    scoring_options,
)
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.runs.terminal import console
from lidar_perception.types import InputError


@dataclass(frozen=True)
class NuscenesRequest:
    """Options of `evaluate nuscenes`; exactly one of `results` and `detector` is not None."""

    options: ScoringOptions
    results: Path | None
    detector: DetectorChoice | None
    write_results: Path | None

    @property
    def source(self) -> str:
        """Origin of the boxes: a result file, or weights."""
        return str(self.results if self.detector is None else self.detector.weights)

    def check(self) -> None:
        """Raise a UsageError for options that cannot be combined."""
        if (self.results is None) == (self.detector is None):
            raise click.UsageError("give either --results JSON or --weights FILE")
        if self.write_results is not None and self.detector is None:
            raise click.UsageError("--write-results requires --weights; --results JSON already is a result file")

    def open_recording(self) -> Any:
        """Open the recording, which must be nuScenes."""
        from lidar_perception.data.nuscenes.folder import KeyFrame

        recording = self.options.open_recording(None)
        if not isinstance(recording.frames[0].native, KeyFrame):
            raise InputError(f"{self.options.data} ({recording.layout}) is not nuScenes; use evaluate detection")
        return recording

    def make_measurement(self, recording: Any) -> Any:
        """Return the function that scores a frame, see scoring.run.StartMeasurement."""
        from lidar_perception.scoring.nuscenes.report import measure_key_frames, measure_result_file

        if self.detector is None:
            assert self.results is not None
            return partial(measure_result_file, self.results)
        open_detector = partial(
            self.detector.open, min_score=MIN_SCORE, sensor_height=recording.frames[0].sensor_height
        )
        return partial(measure_key_frames, open_detector, self.write_results is not None)


@click.command(cls=Command)
@scoring_options()
@path_option("--results", "Result file of any detector, in the format of nuScenes' detection task.", "JSON")
@detector_options(default=None)
@out_file_option(
    "--write-results", "Write the detections of --weights as a result file, also for frames without labels."
)
def nuscenes(options: ScoringOptions, **choices: Any) -> None:
    """Score boxes by the protocol of nuScenes' detection task.

    Average precision by centre distance at 0.5, 1, 2 and 4 m, the five errors of true positives and
    NDS, over all ten classes, and over the three that the detectors of this package support. Scores
    either a result file, or a checkpoint, which is run on every key frame. DATA is the folder of
    nuScenes, or of one of its versions; --split names scenes.

    \b
    Examples:
      lidar-perception evaluate nuscenes /data/nuscenes --results results.json
      lidar-perception evaluate nuscenes /data/nuscenes/v1.0-trainval \\
          --split val.txt --weights v4.safetensors --json scores.json
    """
    from lidar_perception.data.nuscenes.results import write_results
    from lidar_perception.scoring.nuscenes.report import NuscenesReport
    from lidar_perception.scoring.nuscenes.tables import print_nuscenes_report

    request = NuscenesRequest(options, **choices)
    request.check()
    recording = request.open_recording()
    report = NuscenesReport()
    options.fill(report, recording, request.make_measurement(recording))
    if request.write_results is not None:
        write_results(request.write_results, report.boxes)
        console.print(f"result file: {request.write_results}")
    if not report.frames and (request.write_results is None or report.skipped):
        raise make_no_labels_error(recording, report.skipped)
    content = {"source": request.source, "version": recording.layout.split()[-1], **report.compute()}
    if report.frames:
        print_nuscenes_report(content, console)
    options.write(content)
