"""evaluate nuscenes: boxes with scores against the labels of nuScenes."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import Walk, a_path, no_labels, out_file, walk_options
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.runs.terminal import console
from lidar_perception.types import InputError


@click.command(cls=Command)
@walk_options()
@a_path("--results", "Result file of any detector, in the format of nuScenes' detection task.",
        "JSON")
@detector_options(default=None)
@out_file("--write-results", "Write the detections of --weights as a result file, also for frames "
                             "without labels.")
def nuscenes(walk: Walk, results: Path | None, detector: DetectorChoice | None,
             write_results: Path | None) -> None:
    """Score boxes by the protocol of nuScenes' detection task.

    Average precision by centre distance at 0.5, 1, 2 and 4 m, the five errors of true positives and
    NDS, over all ten classes, and over the three that our detectors know. Scores either a result
    file, or a checkpoint, which is run on every key frame. DATA is the folder of nuScenes, or that
    of one version in it; --split names scenes.

    \b
    Examples:
      lidar-perception evaluate nuscenes /data/nuscenes --results results.json
      lidar-perception evaluate nuscenes /data/nuscenes/v1.0-trainval \\
          --split val.txt --weights v4.safetensors --json scores.json
    """
    from lidar_perception.data.nuscenes.folder import KeyFrame
    from lidar_perception.data.nuscenes.results import write_results as write_result_file
    from lidar_perception.scoring.nuscenes.report import (
        NuscenesReport,
        measure_key_frames,
        measure_result_file,
    )
    from lidar_perception.scoring.nuscenes.tables import print_nuscenes_report

    if (results is None) == (detector is None):
        raise click.UsageError("give either --results JSON or --weights FILE")
    if write_results is not None and detector is None:
        raise click.UsageError("--write-results writes the detections of --weights; --results "
                               "JSON is such a file already")
    recording = walk.opened(None)
    first = recording.frames[0]
    if not isinstance(first.native, KeyFrame):
        raise InputError(f"{walk.data} ({recording.layout}) is not nuScenes; use evaluate "
                         "detection")
    if results is not None:
        start = partial(measure_result_file, results)
    else:
        assert detector is not None  # as there are no --results
        open_ = partial(detector.open, min_score=MIN_SCORE, sensor_height=first.sensor_height)
        start = partial(measure_key_frames, open_, write_results is not None)
    report = NuscenesReport()
    walk.fill(report, recording, start)
    if write_results is not None:
        write_result_file(write_results, report.boxes)
        console.print(f"result file: {write_results}")
    if not report.frames and (write_results is None or report.skipped):
        raise no_labels(recording, report.skipped)
    content = {"source": str(results if detector is None else detector.weights),
               "version": recording.layout.split()[-1], **report.compute()}
    if report.frames:
        print_nuscenes_report(content, console)
    walk.write(content)
