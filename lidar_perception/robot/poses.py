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
    """Make poses (..., 4, 4) from translations (..., 3) and quaternions (..., 4) [x y z w]."""
    translation = np.asarray(translation, np.float64)
    pose = np.zeros((*translation.shape[:-1], 4, 4))
    pose[..., :3, :3] = (
        Rotation.from_quat(np.reshape(quaternion, (-1, 4))).as_matrix().reshape(*translation.shape[:-1], 3, 3)
    )
    pose[..., :3, 3], pose[..., 3, 3] = translation, 1.0
    return pose


def check_pose(translation: ArrayLike, quaternion: ArrayLike, noun: str) -> tuple[np.ndarray, np.ndarray]:
    """Check a pose; return translation (3,) and normalised quaternion (4,) [x y z w] as float64.

    Raises:
        InputError: A number is not finite, or the quaternion is not of unit length. The message
            starts with `noun`, which describes the pose.
    """
    vector, rotation = np.asarray(translation, np.float64), np.asarray(quaternion, np.float64)
    norm = np.linalg.norm(rotation)
    if not np.isfinite(vector).all() or not abs(norm - 1.0) < UNIT_TOLERANCE:
        raise InputError(f"{noun} is not finite, or its quaternion is not normalized; fix its publisher")
    return vector, rotation / norm


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
    """Interpolate poses; return (M, 4, 4).

    Translations are interpolated linearly, quaternions on the shorter arc (slerp, Shoemake 1985).
    Before the first and after the last pose, the nearest two poses are extrapolated. A single pose
    applies to all times.

    Args:
        times: (K,) int times of the given poses, ascending, K > 0.
        translations: (K, 3) translations.
        quaternions: (K, 4) quaternions [x y z w].
        at: (M,) int times to interpolate at.
    """
    if len(times) == 1:
        return np.broadcast_to(make_pose(translations[0], quaternions[0]), (len(at), 4, 4)).copy()
    first_index = np.clip(np.searchsorted(times, at, "right") - 1, 0, len(times) - 2)
    # Subtract before dividing: nanoseconds since 1970 do not fit into a float64.
    fraction = ((at - times[first_index]) / (times[first_index + 1] - times[first_index]))[:, None]
    offsets, rotations = np.asarray(translations), Rotation.from_quat(quaternions)
    steps = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    return make_pose(
        offsets[first_index] + fraction * (offsets[first_index + 1] - offsets[first_index]),
        (rotations[first_index] * Rotation.from_rotvec(fraction * steps[first_index])).as_quat(),
    )


def transform_points(xyz: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Transform points (N, 3) from the child frame of a pose to its parent frame.

    The result has the dtype of xyz.
    """
    return xyz @ pose[:3, :3].T.astype(xyz.dtype) + pose[:3, 3].astype(xyz.dtype)


def transform_boxes(boxes: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Transform boxes (K, 7) from the child frame of a pose to its parent frame, as float64.

    Boxes stay upright; only their yaw is rotated.
    """
    transformed_boxes = np.array(boxes, np.float64).reshape(-1, 7)
    heading = pose[:2, :2] @ np.array([np.cos(transformed_boxes[:, 6]), np.sin(transformed_boxes[:, 6])])
    transformed_boxes[:, :3] = transformed_boxes[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    transformed_boxes[:, 6] = wrap_angle(np.arctan2(heading[1], heading[0]))
    return transformed_boxes
