"""KITTI's average precision of several detectors on the same frames, with bootstrap intervals.

While an experiment measures, it stores the objects of each frame with to_record(). The report reads
these records and resamples the frames (bootstrap; Efron, 1979). All detectors are resampled in the
same way, so that differences are paired.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidar_perception.scoring.intervals import draw_samples, group_frames
from lidar_perception.scoring.kitti.camera_objects import CameraObjects
from lidar_perception.scoring.kitti.protocol import (
    DIFFICULTIES,
    RELAXED,
    SCORED,
    STRICT,
    ComparedFrame,
    Comparison,
    compare_objects,
    compute_precision,
)

CELLS = tuple((name, level) for name in SCORED for level in DIFFICULTIES)
STRICT_3D, RELAXED_BEV = ("3d", STRICT), ("bev", RELAXED)
PROTOCOLS = (STRICT_3D, RELAXED_BEV)  # (metric, minimum overlap of a match by class)
REPLICATES = 200
NO_CAMERA = (-np.inf, -np.inf, np.inf, np.inf)
COLUMNS = ("class_ids", "boxes", "truncated", "occluded", "scores", "regions")
WIDTHS = {"boxes": 7, "regions": 4}


def to_record(objects: CameraObjects) -> dict[str, Any]:
    """Convert objects to a JSON-serialisable dict. Observation angles are not stored."""
    record = {name: np.round(getattr(objects, name), 4).tolist() for name in COLUMNS}
    if np.isfinite(objects.image_boxes).all():
        record["image_boxes"] = np.round(objects.image_boxes, 2).tolist()
    return record


def from_record(record: Mapping[str, Any]) -> CameraObjects:
    """Convert a record to objects, whose observation angles are NaN."""
    count = len(record["class_ids"])
    columns = {
        name: np.array(record[name], float).reshape(-1, WIDTHS[name])
        if name in WIDTHS
        else np.array(record[name], float)
        for name in COLUMNS
    }
    image_boxes = record.get("image_boxes")
    return CameraObjects(
        columns["class_ids"].astype(np.int32),
        columns["boxes"],
        np.tile(NO_CAMERA, (count, 1)) if image_boxes is None else np.array(image_boxes, float).reshape(-1, 4),
        np.full(count, np.nan),
        columns["truncated"],
        columns["occluded"].astype(int),
        columns["scores"],
        columns["regions"],
    )


def compare_records(
    label_records: Sequence[Mapping[str, Any]], detection_records: Sequence[Mapping[str, Any]]
) -> list[ComparedFrame]:
    """Compare the detections of each frame with its labels. Both arguments have one record per frame."""
    return [
        compare_objects(from_record(labels), from_record(detections))
        for labels, detections in zip(label_records, detection_records)
    ]


def compute_cells(frames: list[ComparedFrame]) -> np.ndarray:
    """Compute the average precision (R40, percent) by PROTOCOLS and CELLS, and its mean.

    Returns:
        (2, 10), with one column per cell and the mean in the last column; NaN for cells without
        labels.
    """
    cells = np.full((len(PROTOCOLS), len(CELLS) + 1), np.nan)
    if not frames:
        return cells
    comparison = Comparison.concatenate(frames)
    for i, (metric, overlaps) in enumerate(PROTOCOLS):
        for j, (name, level) in enumerate(CELLS):
            curve = compute_precision(comparison, name, metric, overlaps[name], level)
            cells[i, j] = np.nan if curve is None else curve.r40
        if not np.isnan(cells[i]).all():
            cells[i, -1] = np.nanmean(cells[i])
    return cells


def resample_cells(
    names: Sequence[str], detectors: Mapping[str, list[ComparedFrame]], replicates: int = REPLICATES
) -> dict[str, np.ndarray]:
    """Compute the cells of each detector for all frames and for random samples of the frames.

    Args:
        names: Names of the frames. Frames of one drive are drawn together.
        detectors: Compared frames of each detector, in the order of `names`.

    Returns:
        {detector: (1 + R, 2, 10)}, see compute_cells() and statistics.estimate(). R is 0 for frames
        that cannot be divided into groups.
    """
    samples = [np.arange(len(names)), *draw_samples(group_frames(names), replicates)]
    return {
        name: np.stack([compute_cells([frames[i] for i in sample]) for sample in samples])
        for name, frames in detectors.items()
    }
