"""Poses as (4, 4) float64 matrices: made, turned round, interpolated.

The pose of frame b in frame a takes points of b to a: a = pose @ b. This is the transform with
header.frame_id a and child_frame_id b.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lidar_perception.geometry import wrap_angle
from lidar_perception.types import InputError

NOT_UNIT = 1e-2  # how far a quaternion's length may be from 1; drivers round


def pose_of(translation: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """(..., 4, 4) of translations (..., 3), metres, and quaternions (..., 4) [x y z w]."""
    translation = np.asarray(translation, np.float64)
    pose = np.zeros((*translation.shape[:-1], 4, 4))
    pose[..., :3, :3] = Rotation.from_quat(np.reshape(quaternion, (-1, 4))).as_matrix().reshape(
        *translation.shape[:-1], 3, 3)
    pose[..., :3, 3], pose[..., 3, 3] = translation, 1.0
    return pose


def checked(translation: ArrayLike, quaternion: ArrayLike,
            what: str) -> tuple[np.ndarray, np.ndarray]:
    """translation (3,) and quaternion (4,) [x y z w] as float64, the latter of length 1. InputError
    that begins with `what` where they are no pose."""
    moved, turned = np.asarray(translation, np.float64), np.asarray(quaternion, np.float64)
    length = np.linalg.norm(turned)
    if not np.isfinite(moved).all() or not abs(length - 1.0) < NOT_UNIT:
        raise InputError(f"{what} has no unit quaternion, or is not finite; its publisher is "
                         "wrong")
    return moved, turned / length


def inverse(pose: np.ndarray) -> np.ndarray:
    """(..., 4, 4): the pose the other way round."""
    back = np.zeros_like(pose)
    turned = np.swapaxes(pose[..., :3, :3], -1, -2)
    back[..., :3, :3] = turned
    back[..., :3, 3] = -(turned @ pose[..., :3, 3, None])[..., 0]
    back[..., 3, 3] = 1.0
    return back


def interpolated(times: np.ndarray, translations: np.ndarray, quaternions: np.ndarray,
                 at: np.ndarray) -> np.ndarray:
    """(M, 4, 4): the poses at times at (M,) int; times (K,) int ascend, K > 0. Straight from one
    translation (K, 3) to the next, on the shorter arc between quaternions (K, 4) (slerp, Shoemake
    1985); before the first and after the last as between the two there."""
    if len(times) == 1:
        return np.broadcast_to(pose_of(translations[0], quaternions[0]), (len(at), 4, 4)).copy()
    first = np.clip(np.searchsorted(times, at, "right") - 1, 0, len(times) - 2)
    # Differences: nanoseconds since 1970 do not fit into a float64.
    share = ((at - times[first]) / (times[first + 1] - times[first]))[:, None]
    moved, turned = np.asarray(translations), Rotation.from_quat(quaternions)
    turns = (turned[:-1].inv() * turned[1:]).as_rotvec()
    return pose_of(moved[first] + share * (moved[first + 1] - moved[first]),
                   (turned[first] * Rotation.from_rotvec(share * turns[first])).as_quat())


def moved_points(xyz: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(N, 3) of the dtype of xyz (N, 3): points of the frame whose pose this is, in the frame of
    the pose."""
    return xyz @ pose[:3, :3].T.astype(xyz.dtype) + pose[:3, 3].astype(xyz.dtype)


def moved_boxes(boxes: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(K, 7) float64 boxes of the frame whose pose this is, in the frame of the pose."""
    moved = np.array(boxes, np.float64).reshape(-1, 7)
    flat = pose[:2, :2] @ np.array([np.cos(moved[:, 6]), np.sin(moved[:, 6])])
    moved[:, :3] = moved[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    moved[:, 6] = wrap_angle(np.arctan2(flat[1], flat[0]))
    return moved
