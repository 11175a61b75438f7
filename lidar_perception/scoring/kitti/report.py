"""Scores of detections against labels: KITTI's average precision, and pedestrians by centre."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidar_perception.scoring.centres.scores import CentreScores
from lidar_perception.scoring.detections import FrameDetections
from lidar_perception.scoring.intervals import compute_bounds, draw_samples, group_frames
from lidar_perception.scoring.kitti.box_errors import diagnose_heights, measure_heights
from lidar_perception.scoring.kitti.camera_objects import to_camera_objects, to_scored_labels
from lidar_perception.scoring.kitti.protocol import (
    DIFFICULTIES,
    RELAXED,
    SCORED,
    STRICT,
    ComparedFrame,
    Comparison,
    Precision,
    compare_objects,
    compute_precision,
)
from lidar_perception.types import PEDESTRIAN, Detections, InputError

# Row of the JSON file -> metric and overlap.
ROWS = {
    "image": ("image", STRICT),
    "bev": ("bev", STRICT),
    "3d": ("3d", STRICT),
    "bev_relaxed": ("bev", RELAXED),
    "3d_relaxed": ("3d", RELAXED),
}

INTERVALS = "bev_relaxed", "bev", "3d"


@dataclass
class DetectionReport:
    """Frames to score, reasons for skipped frames, and durations of the detector.

    follow: see intervals.group_frames.
    """

    frames: list[ComparedFrame] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    pedestrians: CentreScores = field(default_factory=CentreScores)
    ms: list[float] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    with_camera: bool = True
    follow: bool = False

    def update(self, result: FrameDetections) -> None:
        """Add one frame.

        With a calibration, detections and labels outside the image are ignored, as KITTI labels
        nothing there. Without one there are no image scores, and difficulty depends on occlusion
        only.

        Raises InputError with the name of the frame for a number that is not finite.
        """
        if result.problem is not None:
            self.skipped.append(f"{result.name}: {result.problem}")
        if result.ms is not None:
            self.ms.append(result.ms)
        truth, found, calibration = result.truth, result.detections, result.calibration
        if truth is None:
            return
        found = to_scored_labels(found) if isinstance(found, Detections) else found
        try:
            true_objects, objects = (to_camera_objects(x, calibration) for x in (truth, found))
        except InputError as error:
            raise InputError(f"{result.name}: {error}") from None
        self.frames.append(compare_objects(true_objects, objects))
        self.names.append(result.name)
        self.with_camera &= calibration is not None
        chosen = (found.class_ids == PEDESTRIAN) & (objects.pixels_high[: len(found)] > 0)
        people = (truth.class_ids == PEDESTRIAN) & (true_objects.pixels_high[: len(truth)] > 0)
        self.pedestrians.update(
            truth.boxes[people], found.boxes[chosen], objects.scores[: len(found)][chosen], result.name
        )

    def compute(self) -> dict:
        """Return the content of the JSON file; ap in percent."""
        result: dict[str, Any] = {
            "frames": len(self.frames),
            "ap": {},
            "map_3d": None,
            "matched": {},
            "diagnosis": [],
            "pedestrian_centres": self.pedestrians.compute(),
            "ms": float(np.median(self.ms)) if self.ms else None,
            "skipped": self.skipped,
        }
        if self.frames:
            comparison = Comparison.of(self.frames)
            result["ap"] = {name: self._class_content(comparison, name) for name in SCORED}
            result["map_3d"] = average_3d(result["ap"])
            result["matched"] = {name: measure_heights(self.frames, name) for name in SCORED}
            result["diagnosis"] = [
                line for name in SCORED if (line := diagnose_heights(name, result["ap"][name], result["matched"][name]))
            ]
        return result

    def compute_intervals(self, count: int) -> dict[str, dict[str, list[float] | None]]:
        """Return intervals [low, high] of AP (R40, moderate) by class and row of INTERVALS.

        They come from `count` draws of the drives, see intervals.py. None without labels.
        """
        found: dict[tuple[str, str], list[float | None]] = {(name, row): [] for name in SCORED for row in INTERVALS}
        for frames in draw_samples(group_frames(self.names, self.follow), count):
            comparison = Comparison.of([self.frames[i] for i in frames])
            for (name, row), scores in found.items():
                metric, overlaps = ROWS[row]
                value = compute_precision(comparison, name, metric, overlaps[name], "moderate")
                scores.append(None if value is None else value.r40)
        return {name: {row: compute_bounds(found[name, row]) for row in INTERVALS} for name in SCORED}

    def _class_content(self, comparison: Comparison, name: str) -> dict:
        rows = {
            row: {level: compute_precision(comparison, name, metric, overlaps[name], level) for level in DIFFICULTIES}
            for row, (metric, overlaps) in ROWS.items()
            if self.with_camera or metric != "image"
        }
        content = {
            row: {"overlap": ROWS[row][1][name], **{level: _to_content(value) for level, value in levels.items()}}
            for row, levels in rows.items()
        }
        if "image" in rows:
            content["aos"] = {level: _to_angle_content(value) for level, value in rows["image"].items()}
        return content


def _to_content(value: Precision | None) -> dict | None:
    return (
        None
        if value is None
        else {
            "objects": value.objects,
            "r11": value.r11,
            "r40": value.r40,
            "official_r11": value.official_r11,
            "official_r40": value.official_r40,
        }
    )


def _to_angle_content(value: Precision | None) -> dict | None:
    return (
        None
        if value is None or math.isnan(value.aos_r40)
        else {"objects": value.objects, "r11": value.aos_r11, "r40": value.aos_r40}
    )


def average_3d(ap: dict) -> dict | None:
    """Average 3D AP over classes and difficulties with labels, as in the EG-PointPillars paper.

    Returns r11 and r40, or None without labels.
    """
    rows = [row for name in SCORED for level in DIFFICULTIES if (row := ap[name]["3d"][level])]
    return {key: float(np.mean([row[key] for row in rows])) for key in ("r11", "r40")} if rows else None
