"""Conversion between labels and lines of KITTI's label files.

The readme files of the development kits define the columns: location is the centre of the bottom
face in the rectified camera's frame (x right, y down, z forward), and rotation_y is the rotation
about its y axis, 0 for a box whose length points to the right. A box that has not changed since it
was read is written with all its original columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import COLUMNS, DONT_CARE, to_camera_box, to_lidar_box
from lidar_perception.data.kitti.write import project_boxes
from lidar_perception.labels.drive_labels import (
    NO_TRACK,
    FrameLabels,
    Row,
    get_id_and_score,
    is_unchanged,
    make_frame_labels,
)
from lidar_perception.types import InputError

MIN_PARTLY = 0.1  # minimum hidden fraction of the 2D box of a partly occluded object (level 1)
MIN_LARGELY = 0.5  # minimum hidden fraction of the 2D box of a largely occluded object (level 2)
TRUNCATION_LEVELS = (-1, 0, 1, 2)  # levels of truncation in the tracking layout


def require_calibration(frame: Frame) -> Calibration:
    """Return the calibration of a frame. Raise InputError if it has none."""
    calibration = frame.calibration()
    if calibration is None:
        raise InputError(
            f"frame {frame.name} has no camera calibration, but KITTI's labels are in "
            "the camera frame; use labelcloud, sustech or openlabel, whose labels are in "
            "the LiDAR frame"
        )
    return calibration


def find_label_folder(path: Path, name: str) -> Path:
    """Find the folder `name` (label_2 or label_02) in a folder with KITTI's layout.

    Returns `path` itself if the folder is not found.
    """
    for subfolder in (f"training/{name}", name):
        path = path / subfolder if (path / subfolder).is_dir() else path
    return path


def parse_frame_labels(frame: Frame, lines: Sequence[dict[str, Any]], source: object) -> FrameLabels:
    """Convert the parsed lines of a frame (see data.kitti.labels.parse_label) to its labels."""
    if not lines:
        return make_frame_labels(frame, ())
    to_lidar = np.linalg.inv(require_calibration(frame).lidar_to_camera)
    rows: list[Row] = []
    notes: list[tuple[str, dict[str, Any]]] = []
    for line in lines:
        box = to_lidar_box(line, to_lidar)
        extra = {key: value for key, value in line.items() if key != "class"}
        if box is None:
            notes.append((line["class"], extra))
        else:
            rows.append((box, line["class"], extra.pop("track_id", NO_TRACK), extra.pop("score", np.nan), extra))
    return make_frame_labels(frame, rows, notes, source)


def make_lines(labels: FrameLabels, frame: Frame, levels: bool) -> list[dict[str, Any]]:
    """Convert labels to columns for data.kitti.labels.format_label: boxes first, then notes.

    For new and changed boxes, alpha, the 2D box (zero outside the image), the truncation and, if it
    is missing, the level of occlusion by other boxes are computed.

    Args:
        levels: True to write truncation as a level, as in the tracking layout; False to write it as
            a fraction.

    Raises:
        InputError: There are boxes but no calibration.
    """
    notes = [_make_note_line(name, extra) for name, extra in labels.notes]
    if len(labels):
        calibration = require_calibration(frame)
        to_lidar = np.linalg.inv(calibration.lidar_to_camera)
        pixels, outside_fractions = project_boxes(labels.boxes, calibration)
        to_camera = calibration.lidar_to_camera
        depths = labels.boxes[:, :3] @ to_camera[2, :3] + to_camera[2, 3]
        occlusion = compute_occlusion_levels(pixels, depths)
    lines = []
    for k, (box, name, extra) in enumerate(zip(labels.boxes, labels.class_names, labels.extra)):
        line = {
            "class": "_".join(name.split()) or "Misc",
            **to_camera_box(box, calibration.lidar_to_camera),
            "bbox": np.nan_to_num(pixels[k]).tolist(),
            "truncated": float(outside_fractions[k]),
            "occluded": level if isinstance(level := extra.get("occluded"), int) else int(occlusion[k]),
        }
        if _is_unchanged_line(box, extra, to_lidar):
            line |= {column: extra[column] for column in COLUMNS}
            if not levels and _is_level(extra["truncated"], labels.track_ids[k]):
                line["truncated"] = float(outside_fractions[k])
        lines.append({**line, **get_id_and_score(labels, k)})
    for line, track in zip(lines + notes, [*labels.track_ids, *[0] * len(notes)]) if levels else ():
        value = line["truncated"]
        line["truncated"] = str(int(value) if _is_level(value, track) else max(-1, round(2 * value)))
    return lines + notes


def _make_note_line(name: str, extra: dict[str, Any]) -> dict[str, Any]:
    """Return the original columns of an object without a 3D box, or if incomplete those of DontCare."""
    shapes = {"bbox": (4,), "dimensions": (3,), "location": (3,)}
    with suppress(KeyError, TypeError, ValueError):
        if all(np.array(extra[c], np.float64).shape == shapes.get(c, ()) for c in COLUMNS):
            return {"class": name, **extra}
    return {"class": "_".join(name.split()) or "Misc", **DONT_CARE, "bbox": [0.0] * 4}


def _is_unchanged_line(box: np.ndarray, extra: dict[str, Any], to_lidar: np.ndarray) -> bool:
    """Return True if `extra` has all columns of the box and the box has not changed."""
    try:
        original = to_lidar_box(extra, to_lidar)
        return (
            original is not None
            and is_unchanged(box, original)
            and np.shape([extra[c] for c in ("truncated", "occluded", "alpha")]) == (3,)
            and np.shape(extra["bbox"]) == (4,)
        )
    except (KeyError, TypeError, ValueError):  # columns are missing, or have other contents
        return False


def _is_level(truncated: float, track: int) -> bool:
    """Return True if a truncation is a level, as in the tracking layout, and not a fraction."""
    return isinstance(truncated, int) or (track != NO_TRACK and truncated in TRUNCATION_LEVELS)


def compute_occlusion_levels(pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Compute the level of occlusion of each 2D box by closer boxes.

    Unlabelled objects are not taken into account.

    Args:
        pixels: (K, 4) boxes [left top right bottom].
        depths: (K,) depth of each box.

    Returns:
        (K,) int: 0 visible, 1 partly occluded, 2 largely occluded.
    """
    levels = np.zeros(len(pixels), int)
    for k, (left, top, right, bottom) in enumerate(pixels):
        closer_boxes = pixels[(depths < depths[k]) & np.isfinite(pixels[:, 0])]
        if not np.isfinite(left) or len(closer_boxes) == 0:
            continue
        # Test a grid of 32 x 32 points in the box, so that areas hidden by several boxes count once.
        u = left + (np.arange(32) + 0.5) / 32 * (right - left)
        v = top + (np.arange(32) + 0.5) / 32 * (bottom - top)
        inside_columns = (u >= closer_boxes[:, :1]) & (u < closer_boxes[:, 2:3])
        inside_rows = (v >= closer_boxes[:, 1:2]) & (v < closer_boxes[:, 3:])
        hidden_fraction = (inside_columns[:, None, :] & inside_rows[:, :, None]).any(axis=0).mean()
        levels[k] = int(hidden_fraction >= MIN_PARTLY) + int(hidden_fraction >= MIN_LARGELY)
    return levels
