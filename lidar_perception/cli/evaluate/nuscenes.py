"""evaluate nuscenes: boxes with scores against the labels of nuScenes."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from lidar_perception.cli.data import (
    Walk,
    a_path,
    device_option,
    no_labels,
    out_file,
    range_option,
    walk_options,
    weights_option,
)
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.runs.terminal import console
from lidar_perception.types import InputError


@click.command()
@walk_options()
@a_path("--results", "Result file of any detector, in the format of nuScenes' detection task.",
        "JSON")
@weights_option
@range_option
@device_option
@out_file("--write-results", "Write the detections of --weights as a result file, also for frames "
                             "without labels.")
def nuscenes(walk: Walk, results: Path | None, weights: Path | None, where: str, device: str,
             write_results: Path | None) -> None:
    """Boxes by the protocol of nuScenes' detection task.

    Average precision by centre distance at 0.5, 1, 2 and 4 m, the five errors of true positives and
    NDS, over all ten classes, and over the three that our detectors know. Scores either a result
    file, or a checkpoint, which is run on every key frame. PATH is the folder of nuScenes, or that
    of one version in it; --split names scenes.

    \b
    Examples:
      lidar-perception evaluate nuscenes --data /data/nuscenes --results results.json
      lidar-perception evaluate nuscenes --data /data/nuscenes/v1.0-trainval \\
          --split val.txt --weights v4.safetensors --json scores.json
    """
    from lidar_perception.data.nuscenes.folder import KeyFrame
    from lidar_perception.data.nuscenes.results import write_results as write_result_file
    from lidar_perception.detectors.open import open_detector
    from lidar_perception.scoring.nuscenes.report import NuscenesReport, by_detector, by_file
    from lidar_perception.scoring.nuscenes.tables import print_nuscenes_report

    if (results is None) == (weights is None):
        raise click.UsageError("give either --results JSON or --weights FILE")
    if write_results is not None and weights is None:
        raise click.UsageError("--write-results writes the detections of --weights; --results "
                               "JSON is "
                               "such a file already")
    recording = walk.opened(None)
    first = recording.frames[0]
    if not isinstance(first.native, KeyFrame):
        raise InputError(f"{walk.data} ({recording.layout}) is not nuScenes; use evaluate "
                         "detection")
    if results is not None:
        start = partial(by_file, results)
    else:
        assert weights is not None  # as there are no --results
        open_ = partial(open_detector, weights, device, min_score=MIN_SCORE,
                        sensor_height=first.sensor_height, where=where)
        start = partial(by_detector, open_, write_results is not None)
    report = NuscenesReport()
    walk.fill(report, recording, start)
    if write_results is not None:
        write_result_file(write_results, report.boxes)
        console.print(f"result file: {write_results}")
    if not report.frames and (write_results is None or report.skipped):
        raise no_labels(recording, report.skipped)
    content = {"source": str(results or weights), "version": recording.layout.split()[-1],
               **report.compute()}
    if report.frames:
        print_nuscenes_report(content, console)
    walk.write(content)
