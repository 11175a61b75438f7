"""Scans and labels into KITTI's object and tracking layouts; folder.py reads them back.

The development kits' readme files define the columns. KITTI labels what its colour camera sees:
here every object of which a part falls into the image. Measured on the 250 labels of 57 frames of
KITTI's: the worst edge of the 2D box is 0.35 pixels from the file's (median; 90 %: 1.6), and the
truncation 0.06 at most.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.kitti.labels import OTHER_NAMES, format_label, to_labels
from lidar_perception.geometry import box_corners
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import GroundTruth

NEAR = 0.1         # metres before the camera; what is nearer is not in the picture
FEWEST_PIXELS = 2  # width and height of the smallest 2D box
TRACKING_NAMES = {ours: theirs for theirs, ours in OTHER_NAMES.items()}

# The twelve edges of box_corners: around the bottom, around the top, upright.
EDGES = np.array([(i + up, (i + 1) % 4 + up) for up in (0, 4) for i in range(4)]
                 + [(i, i + 4) for i in range(4)])
# The IMU of KITTI's car, 0.81 m behind the LiDAR; nothing here is measured in its frame.
IMU_TO_LIDAR = np.column_stack([np.eye(3), [-0.81, 0.32, -0.80]])


def image_boxes(boxes: np.ndarray,
                calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """(K, 4) 2D boxes [left top right bottom] in pixels, clipped to the image, of LiDAR boxes
    (K, 7), and (K,) the share of each whole 2D box that is outside. NaN and 1 for a box that is
    not in the image."""
    corners = np.concatenate([box_corners(boxes), np.ones((len(boxes), 8, 1))], axis=2)
    ends = (corners @ calibration.lidar_to_camera.T)[:, EDGES]  # (K, 12, 2, 4)
    others = ends[..., ::-1, :]
    depth, other = ends[..., 2], others[..., 2]
    crosses = (depth < NEAR) & (other > NEAR)
    to_plane = (NEAR - depth) / np.where(crosses, other - depth, 1.0)
    cut = np.where(crosses[..., None], ends + to_plane[..., None] * (others - ends), ends)
    before = ((depth >= NEAR) | crosses)[..., None]
    pixels = cut @ calibration.intrinsics.T
    pixels = pixels[..., :2] / np.where(before, pixels[..., 2:], 1.0)
    low = np.where(before, pixels, np.inf).min(axis=(1, 2))
    high = np.where(before, pixels, -np.inf).max(axis=(1, 2))
    last = np.array([calibration.width, calibration.height]) - 1
    seen_low, seen_high = np.clip(low, 0, last), np.clip(high, 0, last)
    seen = ((seen_high - seen_low) >= FEWEST_PIXELS).all(axis=1)
    with np.errstate(invalid="ignore"):
        outside = 1 - np.prod(seen_high - seen_low, axis=1) / np.prod(high - low, axis=1)
    found = np.concatenate([seen_low, seen_high], axis=1)
    return np.where(seen[:, None], found, np.nan), np.where(seen, outside, 1.0)


def seen_by_camera(truth: GroundTruth, calibration: Calibration) -> GroundTruth:
    """The objects of which a part is in the image, with bbox and truncated as in KITTI."""
    boxes, outside = image_boxes(truth.boxes, calibration)
    seen = np.flatnonzero(np.isfinite(boxes[:, 0]))
    extras = [dict(truth.extras[i], bbox=boxes[i].tolist(), truncated=float(outside[i]))
              for i in seen]
    return GroundTruth.of(truth.boxes[seen], truth.class_ids[seen], extras)


def object_label_text(truth: GroundTruth, calibration: Calibration) -> str:
    """A label_2 file: numbers with two decimals."""
    return "".join(f"{format_label(label)}\n"
                   for label in to_labels(truth, calibration.lidar_to_camera))


def tracking_label_text(number: int, truth: GroundTruth, calibration: Calibration) -> str:
    """The lines of frame number in a label_02 file, six decimals; every extra has a track_id.

    Truncation is a level here: 0, 1, 2 for a share nearest to none, half, all."""
    return "".join(tracking_line(number, label["track_id"], {
        **label, "truncated": str(max(-1, round(2 * label["truncated"])))})
        for label in to_labels(truth, calibration.lidar_to_camera))


def tracking_line(number: int, track: int, label: dict) -> str:
    """A label of frame number as a line of the tracking benchmark's files, six decimals."""
    name = TRACKING_NAMES.get(label["class"], label["class"])
    return f"{number} {track} {format_label({**label, 'class': name}, 6, whole=False)}\n"


def calibration_text(calibration: Calibration) -> str:
    """A calib file of the object and tracking layouts. All four cameras are the same one, already
    rectified."""
    matrices = {**{f"P{i}": calibration.intrinsics for i in range(4)}, "R0_rect": np.eye(3),
                "Tr_velo_to_cam": calibration.lidar_to_camera[:3],
                "Tr_imu_to_velo": IMU_TO_LIDAR}
    return "".join(f"{name}: {numbers(matrix)}\n" for name, matrix in matrices.items())


def numbers(matrix: np.ndarray) -> str:
    """The numbers of a matrix, row by row, as KITTI writes them."""
    return " ".join(f"{value:.12e}" for value in np.ravel(matrix))


def write_velodyne(path: Path, cloud: np.ndarray) -> None:
    """cloud (N, 4) [x y z reflectance] as a .bin file. InputError where it cannot be written."""
    write_bytes(path, np.ascontiguousarray(cloud, np.float32).tobytes())


def write_object(root: Path, number: int, cloud: np.ndarray, truth: GroundTruth,
                 calibration: Calibration) -> None:
    """velodyne, calib and label_2 of one frame of an object data set at root/training."""
    write_object_text(root, number, cloud, object_label_text(truth, calibration), calibration)


def write_object_text(root: Path, number: int, cloud: np.ndarray, labels: str,
                      calibration: Calibration) -> None:
    """As write_object, with the text of the label_2 file."""
    folder, name = root / "training", f"{number:06}"
    write_velodyne(folder / f"velodyne/{name}.bin", cloud)
    write_bytes(folder / f"calib/{name}.txt", calibration_text(calibration).encode())
    write_bytes(folder / f"label_2/{name}.txt", labels.encode())
