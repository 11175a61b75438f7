"""Writer of scans and labels in KITTI's object and tracking layouts.

The readme files of the development kits define the columns. KITTI labels the objects that its
colour camera sees; here, these are all objects that are at least partly in the image. On the 250
labels of 57 KITTI frames, the worst edge of a computed 2D box differs from the label by 0.35 pixels
(median; 90th percentile 1.6), and the truncation by at most 0.06.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.kitti.labels import NAME_BY_TRACKING_NAME, format_label, to_labels
from lidar_perception.geometry import box_corners
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import GroundTruth

MIN_DEPTH_M = 0.1  # minimum distance from the camera of points in the image
MIN_PIXELS = 2  # minimum width and height of a 2D box
TRACKING_NAME_BY_NAME = {name: alias for alias, name in NAME_BY_TRACKING_NAME.items()}

# Twelve edges as pairs of corners (see box_corners): bottom, top, vertical.
EDGES = np.array([(i + up, (i + 1) % 4 + up) for up in (0, 4) for i in range(4)] + [(i, i + 4) for i in range(4)])
# Pose of the IMU in KITTI's car, 0.81 m behind the LiDAR, which calibration files must contain.
IMU_TO_LIDAR = np.column_stack([np.eye(3), [-0.81, 0.32, -0.80]])


def project_boxes(boxes: np.ndarray, calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Project LiDAR boxes (K, 7) to 2D boxes.

    Returns:
        2D boxes (K, 4) [left top right bottom] in pixels, clipped to the image, and the fraction
        (K,) of each unclipped 2D box that is outside the image. For a box that is not in the image,
        they are NaN and 1.
    """
    corners = np.concatenate([box_corners(boxes), np.ones((len(boxes), 8, 1))], axis=2)
    ends = (corners @ calibration.lidar_to_camera.T)[:, EDGES]  # (K, 12, 2, 4)
    other_ends = ends[..., ::-1, :]
    depth, other_depth = ends[..., 2], other_ends[..., 2]
    is_crossing = (depth < MIN_DEPTH_M) & (other_depth > MIN_DEPTH_M)
    fraction = (MIN_DEPTH_M - depth) / np.where(is_crossing, other_depth - depth, 1.0)
    clipped_ends = np.where(is_crossing[..., None], ends + fraction[..., None] * (other_ends - ends), ends)
    is_in_front = ((depth >= MIN_DEPTH_M) | is_crossing)[..., None]
    pixels = clipped_ends @ calibration.intrinsics.T
    pixels = pixels[..., :2] / np.where(is_in_front, pixels[..., 2:], 1.0)
    min_pixel = np.where(is_in_front, pixels, np.inf).min(axis=(1, 2))
    max_pixel = np.where(is_in_front, pixels, -np.inf).max(axis=(1, 2))
    last_pixel = np.array([calibration.width, calibration.height]) - 1
    clipped_min, clipped_max = np.clip(min_pixel, 0, last_pixel), np.clip(max_pixel, 0, last_pixel)
    is_in_image = ((clipped_max - clipped_min) >= MIN_PIXELS).all(axis=1)
    with np.errstate(invalid="ignore"):
        outside_fraction = 1 - np.prod(clipped_max - clipped_min, axis=1) / np.prod(max_pixel - min_pixel, axis=1)
    boxes_2d = np.concatenate([clipped_min, clipped_max], axis=1)
    return np.where(is_in_image[:, None], boxes_2d, np.nan), np.where(is_in_image, outside_fraction, 1.0)


def keep_visible_objects(truth: GroundTruth, calibration: Calibration) -> GroundTruth:
    """Return the objects that are at least partly in the image, with bbox and truncated as in KITTI."""
    boxes_2d, outside_fractions = project_boxes(truth.boxes, calibration)
    indices = np.flatnonzero(np.isfinite(boxes_2d[:, 0]))
    extras = [dict(truth.extras[i], bbox=boxes_2d[i].tolist(), truncated=float(outside_fractions[i])) for i in indices]
    return GroundTruth.of(truth.boxes[indices], truth.class_ids[indices], extras)


def format_object_labels(truth: GroundTruth, calibration: Calibration) -> str:
    """Format the text of a label_2 file, with two decimals."""
    return "".join(f"{format_label(label)}\n" for label in to_labels(truth, calibration.lidar_to_camera))


def format_tracking_labels(number: int, truth: GroundTruth, calibration: Calibration) -> str:
    """Format the lines of a frame in a label_02 file, with six decimals.

    Each dict in truth.extras must have a track_id. Truncation is written as a level: 0, 1 or 2 for
    fractions near 0, 0.5 and 1.
    """
    return "".join(
        format_tracking_line(
            number, label["track_id"], {**label, "truncated": str(max(-1, round(2 * label["truncated"])))}
        )
        for label in to_labels(truth, calibration.lidar_to_camera)
    )


def format_tracking_line(number: int, track: int, label: dict) -> str:
    """Format a label as a line in the files of the tracking benchmark, with six decimals."""
    name = TRACKING_NAME_BY_NAME.get(label["class"], label["class"])
    return f"{number} {track} {format_label({**label, 'class': name}, 6, object_layout=False)}\n"


def format_calibration(calibration: Calibration) -> str:
    """Format the text of a calib file, with four identical rectified cameras."""
    to_camera = calibration.lidar_to_camera[:3]
    return format_matrices(calibration, R0_rect=np.eye(3), Tr_velo_to_cam=to_camera, Tr_imu_to_velo=IMU_TO_LIDAR)


def format_matrices(calibration: Calibration, **matrices: np.ndarray) -> str:
    """Format the projections of four identical cameras and further matrices, one per line."""
    matrices = {f"P{i}": calibration.intrinsics for i in range(4)} | matrices
    return "".join(f"{name}: {format_numbers(matrix)}\n" for name, matrix in matrices.items())


def format_numbers(matrix: np.ndarray) -> str:
    """Format the numbers of a matrix row by row, as in KITTI."""
    return " ".join(f"{value:.12e}" for value in np.ravel(matrix))


def write_velodyne(path: Path, cloud: np.ndarray) -> None:
    """Write a cloud (N, 4) [x y z reflectance] to a .bin file. Raises InputError if that fails."""
    write_bytes(path, np.ascontiguousarray(cloud, np.float32).tobytes())


def write_object(root: Path, number: int, cloud: np.ndarray, truth: GroundTruth, calibration: Calibration) -> None:
    """Write the files of one frame in velodyne/, calib/ and label_2/ of root/training."""
    write_object_text(root, number, cloud, format_object_labels(truth, calibration), calibration)


def write_object_text(root: Path, number: int, cloud: np.ndarray, labels: str, calibration: Calibration) -> None:
    """Write the same files as write_object, with `labels` as the text of the label_2 file."""
    folder, name = root / "training", f"{number:06}"
    write_velodyne(folder / f"velodyne/{name}.bin", cloud)
    write_bytes(folder / f"calib/{name}.txt", format_calibration(calibration).encode())
    write_bytes(folder / f"label_2/{name}.txt", labels.encode())
