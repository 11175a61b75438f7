"""Result files of KITTI's object benchmark: one a frame, a label line with a score a detection."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.kitti.labels import (
    format_label,
    parsed_lines,
    to_ground_truth,
    to_labels,
)
from lidar_perception.data.kitti.write import image_boxes
from lidar_perception.runs.files import write_text
from lidar_perception.types import Detections, GroundTruth, InputError

DECIMALS = 4  # of a score, so that the order stays, and of metres, so that overlaps do


def read_results(path: Path, lidar_to_camera: np.ndarray) -> GroundTruth:
    """Detections of one file, score in extras; lidar_to_camera (4, 4). InputError names the file,
    and the line that is no result."""
    if not path.exists():
        raise InputError(f"there is no result file {path}; a frame without detections needs an "
                         "empty one, and --split says which frames to score")
    labels = []
    for number, label in parsed_lines(path):
        if "score" not in label:
            raise InputError(f"{path}:{number} is no result: a class and 14 numbers, and no score "
                             "as the 15th")
        labels.append(label)
    return to_ground_truth(labels, lidar_to_camera)


def write_results(path: Path, detections: Detections, calibration: Calibration) -> None:
    """Write the result file of one frame: truncation and occlusion -1, the 2D box projected (0
    outside the image). InputError where it cannot be written."""
    pixels = np.nan_to_num(image_boxes(detections.boxes, calibration)[0])
    extras = [{"score": float(score), "bbox": box.tolist()}
              for score, box in zip(detections.scores, pixels)]
    found = GroundTruth.of(detections.boxes, detections.class_ids, extras)
    write_text(path, "".join(
        format_label({**label, "truncated": "-1", "occluded": -1}, DECIMALS) + "\n"
        for label in to_labels(found, calibration.lidar_to_camera)))
