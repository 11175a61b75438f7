"""Calibrate the scores of checkpoints to probabilities, on scans that were not used for training.

Only the calibration in the header of a file changes, not the order of the scores. A file is not
changed if the scans have too few objects of one of its classes.

    lidar-perception simulate --format kitti --frames 360 --people 2.5 --seed 700000 --out scans
    python scripts/calibrate_weights.py scans v4.safetensors pointnet.safetensors
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import click

from lidar_perception.data.open import open_recording
from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.checkpoint import read_header, save_header
from lidar_perception.detectors.open import open_detector
from lidar_perception.runs.terminal import console
from lidar_perception.scoring.detections import measure_detector
from lidar_perception.scoring.kitti.protocol import Comparison
from lidar_perception.scoring.kitti.reliability import fit_calibrations
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.scoring.run import fill_report

MIN_SCORE = 0.02  # minimum score of detections to calibrate with


def open_uncalibrated_detector(weights: Path) -> NetworkDetector:
    """Open the detector of a checkpoint with the raw scores of its network."""
    detector = open_detector(weights, "cpu")
    assert isinstance(detector, NetworkDetector)
    return detector.with_raw_scores().with_min_score(MIN_SCORE)


@click.command()
@click.argument("scans", type=click.Path(exists=True, path_type=Path))
@click.argument("weights", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--jobs", default=1)
@click.option("--limit", type=int, help="Maximum number of scans.")
def main(scans: Path, weights: tuple[Path, ...], jobs: int, limit: int | None) -> None:
    """Calibrate checkpoints, in place."""
    for path in weights:
        report = DetectionReport()
        fill_report(
            report,
            open_recording(scans),
            partial(measure_detector, partial(open_uncalibrated_detector, path), 1.0, None),
            jobs=jobs,
            limit=limit,
        )
        calibrations = fit_calibrations(Comparison.concatenate(report.frames)) if report.frames else {}
        header = read_header(path)
        if missing_classes := sorted({*header.calibration} - {*calibrations}):
            raise click.ClickException(
                f"{path} is not changed: {scans} has too few correct or wrong detections of "
                + ", ".join(missing_classes)
            )
        save_header(path, replace(header, calibration=calibrations))
        console.print(f"{path.name}: {calibrations}")


if __name__ == "__main__":
    main()
