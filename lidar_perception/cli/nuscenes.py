"""evaluate nuscenes: boxes with scores against the labels of nuScenes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

import click

from lidar_perception.data.nuscenes.boxes import GlobalBoxes
from lidar_perception.data.nuscenes.folder import NuscenesFrame, open_nuscenes
from lidar_perception.data.nuscenes.results import read_results, to_results
from lidar_perception.data.nuscenes.results import write_results as write_result_file
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console, track
from lidar_perception.scoring.nuscenes.report import NuscenesReport
from lidar_perception.scoring.nuscenes.tables import print_nuscenes_report
from lidar_perception.types import InputError


@click.command()
@click.option("--root", type=click.Path(path_type=Path), metavar="DIR", required=True,
              help="nuScenes folder, with samples/ and the folder of the version.")
@click.option("--version", default="v1.0-mini", metavar="NAME",
              help="Folder of the tables: v1.0-mini, v1.0-trainval ... Default: v1.0-mini.")
@click.option("--scenes", type=click.Path(path_type=Path), metavar="FILE",
              help="Score only the scenes named in this file, one a line.")
@click.option("--results", type=click.Path(path_type=Path), metavar="JSON",
              help="Result file of any detector, in the format of nuScenes' detection task.")
@click.option("--weights", type=click.Path(path_type=Path), metavar="FILE",
              help="Run the detector of this checkpoint, PointPillars or PointNet.")
@click.option("--device", default="auto", help="Where --weights run: auto, cpu, cuda. "
              "Default: auto.")
@click.option("--write-results", type=click.Path(path_type=Path), metavar="JSON",
              help="Write the detections of --weights as a result file, also of frames "
              "without labels.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the scores to this file.")
def nuscenes(root: Path, version: str, scenes: Path | None, results: Path | None,
             weights: Path | None, device: str, write_results: Path | None,
             json_file: Path | None) -> None:
    """Boxes by the protocol of nuScenes' detection task.

    Average precision by centre distance at 0.5, 1, 2 and 4 m, the five errors of true positives and
    NDS, over all ten classes, and over the three that our detectors know. Either of a result file,
    or of a checkpoint, which is run on every key frame.

    \b
    Examples:
      lidar-perception evaluate nuscenes --root /data/nuscenes --results results.json
      lidar-perception evaluate nuscenes --root /data/nuscenes --version v1.0-trainval \\
          --scenes val.txt --weights v4.safetensors --json scores.json
    """
    if (results is None) == (weights is None):
        raise click.UsageError("give either --results JSON or --weights FILE")
    if write_results is not None and weights is None:
        raise click.UsageError("--write-results writes what --weights find; --results JSON is such "
                               "a file already")
    frames = open_nuscenes(root, version, None if scenes is None else scene_names(scenes))
    report, found = NuscenesReport(), {}
    if results is not None:
        work = score_results(frames, read_results(results, frames), report)
    else:
        work = score_detector(frames, detector_at(weights, device, frames[0].sensor_height),
                              report, found, write_results is not None)
    for _ in track(work, "evaluating", len(frames)):
        pass
    content = {"source": str(results or weights), "version": version, **report.content()}
    if write_results is not None:
        write_result_file(write_results, found)
        console.print(f"result file: {write_results}")
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))
    if report.frames:
        print_nuscenes_report(content, console)
    elif write_results is None or report.skipped:
        reason = f" ({report.skipped[0]})" if report.skipped else ""
        raise InputError(f"{root}: no frame of {version} with labels{reason}")


def scene_names(path: Path) -> list[str]:
    """The scenes named in a file, each once. InputError where there is none."""
    try:
        names = path.read_text().split()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the scenes of {path}: {error}") from None
    if not names:
        raise InputError(f"{path} names no scene; it needs one a line, such as scene-0103")
    return list(dict.fromkeys(names))


def detector_at(weights: Path, device: str, sensor_height: float) -> Callable:
    """The detector of a checkpoint for a level sensor so many metres above the ground."""
    from lidar_perception.detectors.open import open_detector
    return open_detector(weights, device, sensor_height)


def score_results(frames: list[NuscenesFrame], found: list[GlobalBoxes],
                  report: NuscenesReport) -> Iterator[None]:
    """Add every frame with labels; yields after each frame."""
    for frame, boxes in zip(frames, found):
        if frame.labels() is not None:
            report.add(frame, boxes)
        yield


def score_detector(frames: list[NuscenesFrame], detector: Callable, report: NuscenesReport,
                   found: dict[str, GlobalBoxes], unlabelled: bool) -> Iterator[None]:
    """Run a detector on every frame with labels, or with unlabelled on all, and add it; what is
    found goes into found by sample token. Yields after each frame. A sweep that cannot be read is
    skipped; where the detector refuses one, its objects are missed."""
    for frame in frames:
        labelled, scan = frame.labels() is not None, None
        try:
            scan = frame.load() if labelled or unlabelled else None
        except InputError as error:
            report.skipped.append(str(error))
        if scan is not None:
            found[frame.token] = GlobalBoxes.none()
            begin = perf_counter()
            try:
                detections = detector(scan)
                report.ms.append((perf_counter() - begin) * 1e3)
                found[frame.token] = to_results(detections, frame)
            except InputError as error:
                report.skipped.append(f"{frame.name}: {error}")
            if labelled:
                report.add(frame, found[frame.token])
        yield
