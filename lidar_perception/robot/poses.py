"""Poses as (4, 4) float64 matrices: construction, inverse, interpolation, transforms.

The pose of frame b in frame a transforms points of b to a: a = pose @ b. This is the transform with
header.frame_id a and child_frame_id b.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lidar_perception.geometry import wrap_angle
from lidar_perception.types import InputError

UNIT_TOLERANCE = 1e-2  # max deviation of a quaternion's norm from 1, because drivers round


def make_pose(translation: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Make poses (..., 4, 4) of translations (..., 3) and quaternions (..., 4) [x y z w]."""
    translation = np.asarray(translation, np.float64)
    pose = np.zeros((*translation.shape[:-1], 4, 4))
    pose[..., :3, :3] = (
        Rotation.from_quat(np.reshape(quaternion, (-1, 4))).as_matrix().reshape(*translation.shape[:-1], 3, 3)
    )
    pose[..., :3, 3], pose[..., 3, 3] = translation, 1.0
    return pose


def check_pose(translation: ArrayLike, quaternion: ArrayLike, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return translation (3,) and quaternion (4,) [x y z w] as float64, normalised.

    Raises:
        InputError: beginning with `what`, if they are not a pose.
    """
    offset, rotation = np.asarray(translation, np.float64), np.asarray(quaternion, np.float64)
    length = np.linalg.norm(rotation)
    if not np.isfinite(offset).all() or not abs(length - 1.0) < UNIT_TOLERANCE:
        raise InputError(f"{what} has no unit quaternion, or is not finite; its publisher is wrong")
    return offset, rotation / length


def invert_pose(pose: np.ndarray) -> np.ndarray:
    """Return the inverses of poses (..., 4, 4)."""
    inverse = np.zeros_like(pose)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ pose[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def interpolate_poses(
    times: np.ndarray, translations: np.ndarray, quaternions: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """Interpolate poses (M, 4, 4) at times at (M,) int.

    Translations are interpolated linearly, quaternions on the shorter arc (slerp, Shoemake 1985).
    Before the first and after the last pose, the nearest two are extrapolated; a single pose
    applies to all times.

    Args:
        times: (K,) int, ascending, K > 0.
        translations, quaternions: (K, 3) and (K, 4) [x y z w].
    """
    if len(times) == 1:
        return np.broadcast_to(make_pose(translations[0], quaternions[0]), (len(at), 4, 4)).copy()
    first = np.clip(np.searchsorted(times, at, "right") - 1, 0, len(times) - 2)
    # Subtract before dividing: nanoseconds since 1970 do not fit into a float64.
    share = ((at - times[first]) / (times[first + 1] - times[first]))[:, None]
    offsets, rotations = np.asarray(translations), Rotation.from_quat(quaternions)
    steps = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    return make_pose(
        offsets[first] + share * (offsets[first + 1] - offsets[first]),
        (rotations[first] * Rotation.from_rotvec(share * steps[first])).as_quat(),
    )


def transform_points(xyz: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Transform points (N, 3) by a pose, from its child frame to its parent frame.

    The result has the dtype of xyz.
    """
    return xyz @ pose[:3, :3].T.astype(xyz.dtype) + pose[:3, 3].astype(xyz.dtype)


def transform_boxes(boxes: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Transform boxes by a pose: (K, 7) float64, from its child frame to its parent frame.

    Boxes stay upright: only the yaw is rotated.
    """
    transformed = np.array(boxes, np.float64).reshape(-1, 7)
    flat = pose[:2, :2] @ np.array([np.cos(transformed[:, 6]), np.sin(transformed[:, 6])])
    transformed[:, :3] = transformed[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    transformed[:, 6] = wrap_angle(np.arctan2(flat[1], flat[0]))
    return transformed
