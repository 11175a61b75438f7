"""KITTI's average precision of a detector with recorded, distorted and missing intensity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.contract import Detector
from lidar_perception.scoring.detections import run_detector
from lidar_perception.scoring.kitti.report import DetectionReport

MIN_SCORE = 0.05  # minimum score of boxes used for the average precision

Change = Callable[[np.ndarray], np.ndarray | None]


def quantize_dark(intensity: np.ndarray) -> np.ndarray:
    """Return the intensity of a sensor with a fifth of the gain, a gamma of 1.5 and a resolution of 6 bits."""
    return np.round(0.2 * intensity**1.5 * 63) / np.float32(63)


CHANGES: dict[str, Change] = {
    "as recorded": lambda intensity: intensity,
    "times 0.4": lambda intensity: np.float32(0.4) * intensity,
    "dark, gamma, 6 bits": quantize_dark,
    "without": lambda intensity: None,
}


def evaluate_kitti(detector: Detector, folder: Path, change: Change, every: int = 1) -> dict[str, float]:
    """Return the AP (R40, moderate, percent) on KITTI object frames with changed intensity."""
    report, recording = DetectionReport(), open_recording(folder)
    detector = detector.with_min_score(MIN_SCORE)
    for frame in recording.frames[::every]:
        cloud = frame.load()
        assert cloud.intensity is not None  # KITTI clouds have an intensity
        truth, calibration = frame.truth(), frame.calibration()
        changed_frame = Frame.of(frame.name, replace(cloud, intensity=change(cloud.intensity)), truth, calibration)
        report.update(run_detector(detector, changed_frame, truth, calibration))
    ap = report.compute()["ap"]

    def get_ap(name: str, row: str) -> float:
        value = ap[name][row]["moderate"]
        return float("nan") if value is None else value["r40"]

    return {
        "Car 3D .7": get_ap("Car", "3d"),
        "Car BEV .7": get_ap("Car", "bev"),
        "Pedestrian BEV .25": get_ap("Pedestrian", "bev_relaxed"),
        "Cyclist BEV .25": get_ap("Cyclist", "bev_relaxed"),
        "mean BEV .5/.25/.25": float(
            np.mean([get_ap(name, "bev_relaxed") for name in ("Car", "Pedestrian", "Cyclist")])
        ),
    }
