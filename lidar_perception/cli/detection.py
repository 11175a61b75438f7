"""evaluate detection: boxes with scores against labels, without ROS."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

import click

from lidar_perception.data.kitti.folder import KittiFrame, open_kitti
from lidar_perception.data.kitti.results import read_results
from lidar_perception.data.kitti.results import write_results as write_result_file
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console, track
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.scoring.kitti.tables import print_detection_report
from lidar_perception.scoring.thinning import thinned
from lidar_perception.types import Detections, InputError


@click.command()
@click.option("--kitti", type=click.Path(path_type=Path), metavar="ROOT", required=True,
              help="KITTI folder: 3D object, tracking or raw.")
@click.option("--results", type=click.Path(path_type=Path), metavar="DIR",
              help="Result files of any detector, in KITTI's format: DIR/000000.txt ...")
@click.option("--weights", type=click.Path(path_type=Path), metavar="FILE",
              help="Run the detector of this checkpoint, PointPillars or PointNet.")
@click.option("--device", default="auto", help="Where --weights run: auto, cpu, cuda. "
              "Default: auto.")
@click.option("--split", type=click.Path(path_type=Path), metavar="FILE",
              help="Score only the frames named in this file, one a line.")
@click.option("--least-score", type=click.FloatRange(0, 1), default=0.05, show_default=True,
              help="Leave out boxes of --weights with a lower score. AP needs low scores too, "
              "because it averages precision over all recalls.")
@click.option("--keep", type=click.FloatRange(0, 1), default=1.0, metavar="SHARE",
              help="Keep only this share of the points of each scan, 0..1, drawn with a "
              "fixed seed. Default: 1.")
@click.option("--write-results", type=click.Path(path_type=Path), metavar="DIR",
              help="Write the detections of --weights as KITTI result files, also of frames "
              "without labels.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the scores to this file.")
def detection(kitti: Path, results: Path | None, weights: Path | None, device: str,
              split: Path | None, least_score: float, keep: float, write_results: Path | None,
              json_file: Path | None) -> None:
    """Boxes of Car, Pedestrian and Cyclist by the protocol of KITTI's object benchmark.

    Average precision in the image, from above and in space, and of orientation, at 40 and 11
    recall points; pedestrians by centre distance as in the STM-CPA paper. Either of a detector's
    result files, or of a checkpoint, which is run on every scan.

    \b
    Examples:
      lidar-perception evaluate detection --kitti /data/kitti/object --results out/data
      lidar-perception evaluate detection --kitti /data/kitti/object --weights v4.safetensors \\
          --split val.txt --json scores.json --write-results out/data
      lidar-perception evaluate detection --kitti /data/kitti/object --weights v4.safetensors \\
          --keep 0.1
    """
    if (results is None) == (weights is None):
        raise click.UsageError("give either --results DIR or --weights FILE")
    if write_results is not None and weights is None:
        raise click.UsageError("--write-results writes what --weights find; --results DIR has its "
                               "files already")
    if keep != 1 and weights is None:
        raise click.UsageError("--keep thins the scans that --weights see; --results DIR sees none")
    frames = open_kitti(kitti, scans=weights is not None)
    if split is not None:
        frames = frames_of_split(frames, split, kitti)
    report = DetectionReport()
    if results is not None:
        if not results.is_dir():
            raise InputError(f"{results} is not a folder; give the folder of the result files")
        work = score_results(frames, results, report)
    else:
        from lidar_perception.detectors.open import open_detector
        work = score_detector(frames, open_detector(
            weights, device, least_score=least_score), write_results, report, keep)
    for _ in track(work, "evaluating", len(frames)):
        pass
    content = {"source": str(results or weights), "keep": keep, **report.content()}
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))
    if write_results is not None:
        console.print(f"result files: {write_results}")
    if report.frames:
        print_detection_report(content, console)
    elif write_results is None or report.skipped:
        reason = f" ({report.skipped[0]})" if report.skipped else ""
        raise InputError(f"{kitti}: no frame with labels{reason}")


def frames_of_split(frames: list[KittiFrame], split: Path, root: Path) -> list[KittiFrame]:
    """The frames named in a file, in its order. InputError names what is not there."""
    try:
        names = split.read_text().split()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the frames of {split}: {error}") from None
    by_name = {frame.name: frame for frame in frames}
    if unknown := [name for name in names if name not in by_name]:
        raise InputError(f"{split} names the frame {unknown[0]} ({len(unknown)} such), which is "
                         f"not in {root}")
    if not names:
        raise InputError(f"{split} names no frame; it needs one a line, such as {frames[0].name}")
    return [by_name[name] for name in dict.fromkeys(names)]


def score_results(frames: list[KittiFrame], folder: Path,
                  report: DetectionReport) -> Iterator[None]:
    """Add every frame with labels; yields after each frame. A label file that cannot be read is
    skipped, a result file that cannot is an InputError: it is what is to be judged."""
    for frame in frames:
        try:
            truth, calibration = frame.truth(), frame.calibration()
        except InputError as error:
            report.skipped.append(str(error))
            truth = None
        if truth is not None:
            found = read_results(folder / f"{frame.name}.txt", calibration.lidar_to_camera)
            report.add(frame.name, truth, found, calibration)
        yield


def score_detector(frames: list[KittiFrame], detector: Callable, folder: Path | None,
                   report: DetectionReport, keep: float = 1.0) -> Iterator[None]:
    """Run a detector on every frame with labels, and add it; with a folder on all frames, and
    write what is found. Of each scan it sees a share `keep` of the points. Yields after each frame.
    A scan that cannot be read is skipped; where the detector refuses one, its objects are missed.
    """
    for frame in frames:
        try:
            truth, calibration = frame.truth(), frame.calibration()
            scan = frame.load() if truth is not None or folder is not None else None
        except InputError as error:
            report.skipped.append(str(error))
            scan = None
        if scan is not None:
            scan = thinned(scan, keep, frame.name)
            begin = perf_counter()
            try:
                found = detector(scan)
                report.ms.append((perf_counter() - begin) * 1e3)
            except InputError as error:
                report.skipped.append(f"{frame.name}: {error}")
                found = Detections.none()
            if folder is not None:
                write_result_file(folder / f"{frame.name}.txt", found, calibration)
            if truth is not None:
                report.add(frame.name, truth, found, calibration)
        yield
