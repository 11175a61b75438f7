"""Reader and writer of result files of KITTI's object and tracking benchmarks.

The object benchmark has one file per frame, with a label line and score per detection. The tracking
benchmark has one file per sequence, with frame number and track id before the label.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidar_perception.camera import FORWARD_CAMERA, Calibration
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import format_label, parse_lines, to_ground_truth, to_labels
from lidar_perception.data.kitti.write import format_tracking_line, project_boxes
from lidar_perception.runs import journal
from lidar_perception.runs.files import write_text
from lidar_perception.types import Detections, GroundTruth, InputError

RESULT_FOLDER = "kitti"  # subfolder for result files in the folder of a run
DECIMALS = 6  # number of decimals; fewer would change the order of low scores and overlaps


def find_result_folder(folder: Path) -> Path:
    """Return the folder of result files: `folder`, or its kitti/ if `detect` wrote it."""
    return (
        folder / RESULT_FOLDER
        if (folder / journal.JOURNAL_NAME).is_file() and (folder / RESULT_FOLDER).is_dir()
        else folder
    )


def choose_calibration(frame: Frame) -> tuple[Calibration, bool]:
    """Return the calibration for the result file of a frame, and True if it is the nominal camera."""
    try:
        calibration = frame.calibration()
    except InputError:
        calibration = None
    return (FORWARD_CAMERA, True) if calibration is None else (calibration, False)


def read_results(path: Path, lidar_to_camera: np.ndarray) -> GroundTruth:
    """Read the detections of a result file; scores are in extras.

    Args:
        lidar_to_camera: transform (4, 4).

    Raises:
        InputError: the file is missing, or a line is not a result.
    """
    if not path.exists():
        raise InputError(
            f"the result file {path} does not exist; add an empty file if the frame has no detections, "
            "or choose the frames to score with --split"
        )
    labels = []
    for number, label in parse_lines(path, known_only=True):
        if "score" not in label:
            raise InputError(f"{path}:{number} has no score, the 15th number after the class; add it")
        labels.append(label)
    return to_ground_truth(labels, lidar_to_camera)


def write_results(path: Path, detections: Detections, calibration: Calibration) -> None:
    """Write the result file of one frame. Raises InputError if it cannot be written.

    Truncation and occlusion are -1. The 2D box is the projection of the 3D box, or 0 if it is
    outside the image.
    """
    write_text(
        path, "".join(format_label(label, DECIMALS) + "\n" for label in _to_result_labels(detections, calibration))
    )


def write_tracking_results(
    path: Path, frames: Iterable[tuple[int, np.ndarray, Detections]], calibration: Calibration
) -> None:
    """Write the result file of one sequence of the tracking benchmark.

    Args:
        frames: frame number, track ids (K,) int and detections of each frame.

    Raises:
        InputError: the file cannot be written.
    """
    lines = []
    for number, ids, detections in frames:
        lines += [
            format_tracking_line(number, int(track), label)
            for track, label in zip(ids, _to_result_labels(detections, calibration))
        ]
    write_text(path, "".join(lines))


def _to_result_labels(detections: Detections, calibration: Calibration) -> list[dict]:
    pixels = np.nan_to_num(project_boxes(detections.boxes, calibration)[0])
    extras = [
        {"score": float(score), "bbox": box.tolist(), "truncated": "-1", "occluded": -1}
        for score, box in zip(detections.scores, pixels)
    ]
    return to_labels(GroundTruth.of(detections.boxes, detections.class_ids, extras), calibration.lidar_to_camera)
