"""Detection scores: KITTI's average precision, and pedestrian scores by centre distance."""

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

# Row of the JSON file -> metric and overlaps by class.
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
    """Frames to score, reasons for skipped frames, and detector run times.

    See intervals.group_frames for `sequential`.
    """

    frames: list[ComparedFrame] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    pedestrians: CentreScores = field(default_factory=CentreScores)
    ms: list[float] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    with_camera: bool = True
    sequential: bool = False

    def update(self, result: FrameDetections) -> None:
        """Add one frame.

        With a calibration, detections and labels outside the image are ignored, because KITTI has
        no labels there. Without a calibration there are no image scores, and the difficulty depends
        on occlusion only.

        Raises:
            InputError: A box or score is not finite. The message contains the frame name.
        """
        if result.problem is not None:
            self.skipped.append(f"{result.name}: {result.problem}")
        if result.ms is not None:
            self.ms.append(result.ms)
        truth, detections, calibration = result.truth, result.detections, result.calibration
        if truth is None:
            return
        detections = to_scored_labels(detections) if isinstance(detections, Detections) else detections
        try:
            camera_labels, camera_detections = (to_camera_objects(boxes, calibration) for boxes in (truth, detections))
        except InputError as error:
            raise InputError(f"{result.name}: {error}") from None
        self.frames.append(compare_objects(camera_labels, camera_detections))
        self.names.append(result.name)
        self.with_camera &= calibration is not None
        is_pedestrian = (detections.class_ids == PEDESTRIAN) & (camera_detections.pixels_high[: len(detections)] > 0)
        is_labelled_pedestrian = (truth.class_ids == PEDESTRIAN) & (camera_labels.pixels_high[: len(truth)] > 0)
        self.pedestrians.update(
            truth.boxes[is_labelled_pedestrian],
            detections.boxes[is_pedestrian],
            camera_detections.scores[: len(detections)][is_pedestrian],
            result.name,
        )

    def compute(self) -> dict:
        """Return the content of the JSON file. AP is in percent."""
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
            comparison = Comparison.concatenate(self.frames)
            result["ap"] = {name: self._score_class(comparison, name) for name in SCORED}
            result["map_3d"] = average_3d(result["ap"])
            result["matched"] = {name: measure_heights(self.frames, name) for name in SCORED}
            result["diagnosis"] = [
                line for name in SCORED if (line := diagnose_heights(name, result["ap"][name], result["matched"][name]))
            ]
        return result

    def compute_intervals(self, count: int) -> dict[str, dict[str, list[float] | None]]:
        """Compute bootstrap intervals [low, high] of AP (R40, moderate), see intervals.py.

        Args:
            count: Number of bootstrap draws.

        Returns:
            Intervals by class and row of INTERVALS, None without labels.
        """
        draws: dict[tuple[str, str], list[float | None]] = {(name, row): [] for name in SCORED for row in INTERVALS}
        for frames in draw_samples(group_frames(self.names, self.sequential), count):
            comparison = Comparison.concatenate([self.frames[i] for i in frames])
            for (name, row), scores in draws.items():
                metric, overlaps = ROWS[row]
                value = compute_precision(comparison, name, metric, overlaps[name], "moderate")
                scores.append(None if value is None else value.r40)
        return {name: {row: compute_bounds(draws[name, row]) for row in INTERVALS} for name in SCORED}

    def _score_class(self, comparison: Comparison, name: str) -> dict:
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
    return None if value is None else {"objects": value.objects, "r11": value.r11, "r40": value.r40}


def _to_angle_content(value: Precision | None) -> dict | None:
    return (
        None
        if value is None or math.isnan(value.aos_r40)
        else {"objects": value.objects, "r11": value.aos_r11, "r40": value.aos_r40}
    )


def average_3d(ap: dict) -> dict | None:
    """Average the 3D AP over classes and difficulties, as in the EG-PointPillars paper.

    Classes and difficulties without labels are left out.

    Returns:
        r11 and r40, or None without labels.
    """
    rows = [row for name in SCORED for level in DIFFICULTIES if (row := ap[name]["3d"][level])]
    return {key: float(np.mean([row[key] for row in rows])) for key in ("r11", "r40")} if rows else None
