"""A frame cut into ground and clusters: what the seed and the candidates are looked for in."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.boxes import snap_to_ground
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.ground.threshold import fit_plane
from lidar_perception.types import InputError, LidarFrame
from lidar_perception.wire.params import ViewParams


@dataclass(frozen=True)
class Segmented:
    """Ground, clusters and boxes of the M points of a frame that are in view.

    indices (M,) int64 their rows in the frame, xyz (M, 3) float32, ground (M,) bool, cluster_ids
    (M,) int32 with 0 = none, boxes (K, 7) float32 of clusters 1..K down to the ground plane;
    numbers (K,) int64: what the cloud calls these clusters, None for 1..K; ms per step.
    """

    indices: np.ndarray
    xyz: np.ndarray
    ground: np.ndarray
    cluster_ids: np.ndarray
    boxes: np.ndarray
    numbers: np.ndarray | None = None
    ms: dict[str, float] = field(default_factory=dict)


def grounded_boxes(xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray,
                   shape: str) -> np.ndarray:
    """(K, 7) boxes of clusters 1..K, of a shape of params.BOX_SHAPES, down to the plane through
    the ground points."""
    return snap_to_ground(fit_boxes(xyz, cluster_ids, shape),
                          fit_plane(xyz.compress(ground, axis=0)))


def explain_nothing(usable: int, ground: np.ndarray,
                    cluster_ids: np.ndarray | None = None) -> str | None:
    """Why a frame can have no candidates, with the remedy; None if nothing is wrong so far.

    usable is the number of finite points; ground (M,) and cluster_ids (M,) of those in view.
    """
    if usable == 0:
        return "the cloud is empty or has no finite point, or crop.* leaves none"
    if len(ground) == 0:
        return ("no point is in the camera's view, or crop.* leaves none there; check the "
                "LiDAR-to-camera transform")
    if not ground.any():
        return ("no ground found; is the sensor mounted at another height or angle? set "
                "ground.sensor_pose")
    if cluster_ids is not None and not cluster_ids.any():
        return ("no clusters; are the numbers of clustering.dbscan or clustering.euclidean right "
                "for this sensor?")
    return None


def points_in_view(frame: LidarFrame, camera: Camera | None,
                   params: ViewParams) -> tuple[np.ndarray, LidarFrame]:
    """indices (M,) int64 of the points of the frame in the camera's view, and the frame of these;
    all of them while the crop is off. InputError if it is on and there is no camera."""
    if not params.enabled:
        return np.arange(len(frame)), frame
    if camera is None:
        raise InputError("view.enabled is on but there is no camera calibration; give CameraInfo "
                         "and the LiDAR-to-camera transform, or set view.enabled to false")
    indices = np.flatnonzero(camera.in_view(frame.xyz))
    return indices, frame.take(indices)
