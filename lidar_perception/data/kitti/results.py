"""Result files of KITTI's object benchmark, one a frame, a label line with a score a detection; and
of its tracking benchmark, one a sequence, with the frame's number and the track's id before it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidar_perception.camera import FORWARD_CAMERA, Calibration
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import (
    format_label,
    parsed_lines,
    read_tracking_labels,
    to_ground_truth,
    to_labels,
)
from lidar_perception.data.kitti.write import image_boxes, tracking_line
from lidar_perception.runs import journal
from lidar_perception.runs.files import write_text
from lidar_perception.types import Detections, GroundTruth, InputError

FOLDER = "kitti"  # of result files in the folder of a run
DECIMALS = 6  # of a score, so that the order of weak ones stays, and of metres, so that overlaps do


def result_files(folder: Path) -> Path:
    """Return the folder of result files: `folder`, or its kitti/ where it is that of a run of
    `detect`."""
    return folder / FOLDER if (folder / journal.NAME).is_file() and (
        folder / FOLDER).is_dir() else folder


def result_calibration(frame: Frame) -> tuple[Calibration, bool]:
    """Return the calibration in whose camera's frame the result file of a frame is, and True where
    that is a nominal camera, as the frame has none or its own cannot be read."""
    try:
        own = frame.calibration()
    except InputError:
        own = None
    return (FORWARD_CAMERA, True) if own is None else (own, False)


def read_results(path: Path, lidar_to_camera: np.ndarray) -> GroundTruth:
    """Detections of one file, score in extras; lidar_to_camera (4, 4). InputError names the file,
    and the line that is no result."""
    if not path.exists():
        raise InputError(f"there is no result file {path}; a frame without detections needs an "
                         "empty one, and --split says which frames to score")
    labels = []
    for number, label in parsed_lines(path, known_only=True):
        if "score" not in label:
            raise InputError(f"{path}:{number} is no result: a class and 14 numbers, and no score "
                             "as the 15th")
        labels.append(label)
    return to_ground_truth(labels, lidar_to_camera)


def write_results(path: Path, detections: Detections, calibration: Calibration) -> None:
    """Write the result file of one frame: truncation and occlusion -1, the 2D box projected (0
    outside the image). InputError where it cannot be written."""
    write_text(path, "".join(format_label(label, DECIMALS) + "\n"
                             for label in _labels(detections, calibration)))


def write_tracking_results(path: Path, frames: Iterable[tuple[int, np.ndarray, Detections]],
                           calibration: Calibration) -> None:
    """Write the result file of one sequence of the tracking benchmark: of each frame its number,
    track ids (K,) int and the boxes. Other columns as in write_results. InputError where it cannot
    be written."""
    lines = []
    for number, ids, detections in frames:
        lines += [tracking_line(number, int(track), label)
                  for track, label in zip(ids, _labels(detections, calibration))]
    write_text(path, "".join(lines))


def _labels(detections: Detections, calibration: Calibration) -> list[dict]:
    """The detections as labels of a result file, see write_results."""
    pixels = np.nan_to_num(image_boxes(detections.boxes, calibration)[0])
    extras = [{"score": float(score), "bbox": box.tolist(), "truncated": "-1", "occluded": -1}
              for score, box in zip(detections.scores, pixels)]
    return to_labels(GroundTruth.of(detections.boxes, detections.class_ids, extras),
                     calibration.lidar_to_camera)


def read_tracking_results(path: Path, lidar_to_camera: np.ndarray) -> dict[int, GroundTruth]:
    """Frame number -> tracks, track_id and score in extras, of a result file of the tracking
    benchmark; frames without tracks are left out. InputError as of read_tracking_labels, and for a
    line without a score."""
    frames = read_tracking_labels(path, lidar_to_camera, known_only=True)
    for number, tracks in frames.items():
        if not all("score" in extra for extra in tracks.extras):
            raise InputError(f"{path}: frame {number} has a track without a score as the 18th "
                             "column")
    return frames
