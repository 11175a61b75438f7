"""Cloud segmented into ground and clusters, the input for seeds and candidates."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.clustering.params import BoxParams
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.ground.params import ThresholdParams
from lidar_perception.ground.threshold import fit_plane, fit_plane_by_ransac
from lidar_perception.types import InputError, PointCloud
from lidar_perception.wire.params import ViewParams


@dataclass(frozen=True)
class SegmentedCloud:
    """Ground, clusters and boxes of the M points of a cloud that are in view.

    Attributes:
        indices: (M,) int64 rows of the points in the cloud.
        xyz: (M, 3) float32 points.
        ground: (M,) bool mask of the ground points.
        cluster_ids: (M,) int32 cluster 1..K of each point, 0 for none.
        boxes: (K, 7) float32 boxes of the clusters, extended down to the ground plane.
        numbers: (K,) int64 ids of these clusters in the cloud; None for 1..K.
        ms: Duration of each step.
    """

    indices: np.ndarray
    xyz: np.ndarray
    ground: np.ndarray
    cluster_ids: np.ndarray
    boxes: np.ndarray
    numbers: np.ndarray | None = None
    ms: dict[str, float] = field(default_factory=dict)


def fit_grounded_boxes(
    xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray, params: BoxParams = BoxParams()
) -> np.ndarray:
    """Fit boxes (K, 7) to clusters 1..K and extend them down to the ground plane."""
    plane = fit_ground_plane(xyz.compress(ground, axis=0), params)
    return snap_to_ground(fit_boxes(xyz, cluster_ids, params.shape), plane)


def snap_to_ground(boxes: np.ndarray, plane: np.ndarray | None) -> np.ndarray:
    """Return boxes (K, 7) extended down to the plane below their centre (Section 3.4).

    Boxes that already reach below the plane are not changed, nor is any box without a plane.
    """
    snapped = boxes.copy()
    if plane is None:
        return snapped
    plane_z = boxes[:, :2].astype(np.float64) @ plane[:2] + plane[2]
    top = boxes[:, 2] + boxes[:, 5] / 2
    bottom = np.minimum(boxes[:, 2] - boxes[:, 5] / 2, plane_z)
    snapped[:, 2] = (top + bottom) / 2
    snapped[:, 5] = top - bottom
    return snapped


def fit_ground_plane(ground: np.ndarray, params: BoxParams) -> np.ndarray | None:
    """Fit a plane (3,) to ground points (M, 3); return None if no plane is found."""
    if params.plane == "ransac":
        return fit_plane_by_ransac(ground, ThresholdParams())
    return fit_plane(ground)


def diagnose_empty(usable: int, ground: np.ndarray, cluster_ids: np.ndarray | None = None) -> str | None:
    """Return the reason, with a remedy, why a cloud has no candidates; None if none is known.

    Args:
        usable: Number of finite points in the cloud.
        ground: (M,) mask of the ground points among the points in view.
        cluster_ids: (M,) cluster of each point in view, 0 for none.
    """
    if usable == 0:
        return "the cloud is empty or has no finite point, or crop.* leaves none"
    if len(ground) == 0:
        return "no point is in the camera's view, or crop.* leaves none there; check the LiDAR-to-camera transform"
    if not ground.any():
        return "no ground found; is the sensor mounted at another height or angle? set ground.sensor_pose"
    if cluster_ids is not None and not cluster_ids.any():
        return "no clusters; are the numbers of clustering.dbscan or clustering.euclidean right for this sensor?"
    return None


def crop_to_view(frame: PointCloud, camera: Camera | None, params: ViewParams) -> tuple[np.ndarray, PointCloud]:
    """Crop a frame to the points in the camera's view, if params.enabled is True.

    Returns:
        Indices (M,) int64 of the points that are kept, and the frame with these points.

    Raises:
        InputError: params.enabled is True but there is no camera.
    """
    if not params.enabled:
        return np.arange(len(frame)), frame
    if camera is None:
        raise InputError(
            "view.enabled is on but there is no camera calibration; give CameraInfo "
            "and the LiDAR-to-camera transform, or set view.enabled to false"
        )
    indices = np.flatnonzero(camera.in_view(frame.xyz))
    return indices, frame.take(indices)
