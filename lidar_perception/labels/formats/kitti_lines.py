"""Labels as the lines of KITTI's label files, and back.

The development kits' readme files define the columns: location is the centre of the bottom face in
the rectified camera's frame (x right, y down, z forward), rotation_y the turn about its y axis, 0
where the length points to the right. A box that was read and not changed keeps every column.
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
    ids_and_score,
    of_rows,
    unchanged,
)
from lidar_perception.types import InputError

# From these shares of its 2D box behind nearer labelled boxes on, an object is partly (1) or
# largely (2) occluded.
PARTLY, LARGELY = 0.1, 0.5
LEVELS = (-1, 0, 1, 2)  # of truncation in the tracking layout


def calibration_of(frame: Frame) -> Calibration:
    """InputError if the frame has none."""
    calibration = frame.calibration()
    if calibration is None:
        raise InputError(f"frame {frame.name} has no camera calibration, and KITTI's labels are in "
                         "the camera's frame; take labelcloud, sustech or openlabel, which are in "
                         "the LiDAR's")
    return calibration


def label_folder(path: Path, name: str) -> Path:
    """The folder of that name, label_2 or label_02, in a folder of KITTI's layout; path itself
    where there is none."""
    for inner in (f"training/{name}", name):
        path = path / inner if (path / inner).is_dir() else path
    return path


def frame_labels(frame: Frame, lines: Sequence[dict[str, Any]], where: object) -> FrameLabels:
    """The labels of a frame from parsed lines, see data.kitti.labels.parse."""
    if not lines:
        return of_rows(frame, ())
    to_lidar = np.linalg.inv(calibration_of(frame).lidar_to_camera)
    rows: list[Row] = []
    notes: list[tuple[str, dict[str, Any]]] = []
    for line in lines:
        box = to_lidar_box(line, to_lidar)
        extra = {key: value for key, value in line.items() if key != "class"}
        if box is None:
            notes.append((line["class"], extra))
        else:
            rows.append((box, line["class"], extra.pop("track_id", NO_TRACK),
                         extra.pop("score", np.nan), extra))
    return of_rows(frame, rows, notes, where)


def lines_of(labels: FrameLabels, frame: Frame, levels: bool) -> list[dict[str, Any]]:
    """What data.kitti.labels.format_label takes, of each box, then of the notes. levels: truncated
    is a level, as in the tracking layout, and not a share.

    Computed for boxes that are new or were changed: alpha, the 2D box (zero outside of the image),
    the share of it outside of the image, and, where nobody said it, the level of occlusion by the
    other boxes. InputError without a calibration.
    """
    notes = [_note(name, extra) for name, extra in labels.notes]
    if len(labels):
        calibration = calibration_of(frame)
        to_lidar = np.linalg.inv(calibration.lidar_to_camera)
        pixels, outside = project_boxes(labels.boxes, calibration)
        occlusion = occlusion_levels(pixels, _depths(labels.boxes, calibration))
    lines = []
    for k, (box, name, extra) in enumerate(zip(labels.boxes, labels.class_names, labels.extra)):
        line = {"class": "_".join(name.split()) or "Misc",
                **to_camera_box(box, calibration.lidar_to_camera),
                "bbox": np.nan_to_num(pixels[k]).tolist(), "truncated": float(outside[k]),
                "occluded": said if isinstance(said := extra.get("occluded"), int)
                else int(occlusion[k])}
        if _as_read(box, extra, to_lidar):
            line |= {column: extra[column] for column in COLUMNS}
            if not levels and _is_level(extra["truncated"], labels.track_ids[k]):
                line["truncated"] = float(outside[k])
        lines.append({**line, **ids_and_score(labels, k)})
    for line, track in zip(lines + notes, [*labels.track_ids, *[0] * len(notes)]) if levels else ():
        value = line["truncated"]
        line["truncated"] = str(int(value) if _is_level(value, track)
                                else max(-1, round(2 * value)))
    return lines + notes


def _note(name: str, extra: dict[str, Any]) -> dict[str, Any]:
    """The line of an object without a box: as KITTI's it was read, or as DontCare has it, without
    a place in the image."""
    kinds = {"bbox": (4,), "dimensions": (3,), "location": (3,)}
    with suppress(KeyError, TypeError, ValueError):
        if all(np.array(extra[c], np.float64).shape == kinds.get(c, ()) for c in COLUMNS):
            return {"class": name, **extra}
    return {"class": "_".join(name.split()) or "Misc", **DONT_CARE, "bbox": [0.0] * 4}


def _as_read(box: np.ndarray, extra: dict[str, Any], to_lidar: np.ndarray) -> bool:
    try:
        kept = to_lidar_box(extra, to_lidar)
        return (kept is not None and unchanged(box, kept)
                and np.shape([extra[c] for c in ("truncated", "occluded", "alpha")]) == (3,)
                and np.shape(extra["bbox"]) == (4,))
    except (KeyError, TypeError, ValueError):  # not all columns, or others of these names
        return False


def _is_level(truncated: float, track: int) -> bool:
    """Whether it is one of the levels of the tracking layout, none, half and all; the layouts have
    one column for either."""
    return isinstance(truncated, int) or (track != NO_TRACK and truncated in LEVELS)


def _depths(boxes: np.ndarray, calibration: Calibration) -> np.ndarray:
    return boxes[:, :3] @ calibration.lidar_to_camera[2, :3] + calibration.lidar_to_camera[2, 3]


def occlusion_levels(pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """(K,) int 0 visible, 1 partly, 2 largely occluded by nearer boxes: 2D boxes (K, 4) and depths
    (K,). What is not labelled occludes nothing here, so a person may know better."""
    levels = np.zeros(len(pixels), int)
    for k, (left, top, right, bottom) in enumerate(pixels):
        nearer = pixels[(depths < depths[k]) & np.isfinite(pixels[:, 0])]
        if not np.isfinite(left) or len(nearer) == 0:
            continue
        # As on a grid of 32 x 32 points of the box, so that overlapping boxes count once.
        u = left + (np.arange(32) + 0.5) / 32 * (right - left)
        v = top + (np.arange(32) + 0.5) / 32 * (bottom - top)
        across = (u >= nearer[:, :1]) & (u < nearer[:, 2:3])
        down = (v >= nearer[:, 1:2]) & (v < nearer[:, 3:])
        share = (across[:, None, :] & down[:, :, None]).any(axis=0).mean()
        levels[k] = int(share >= PARTLY) + int(share >= LARGELY)
    return levels
