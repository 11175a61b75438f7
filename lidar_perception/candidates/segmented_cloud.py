"""Clouds segmented into ground and clusters, the input for seeds and candidates."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.clustering.params import BoxParams
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.ground.params import ThresholdParams
from lidar_perception.ground.threshold import fit_plane, fit_plane_by_ransac
from lidar_perception.types import EMPTY_CLOUD, InputError, PointCloud
from lidar_perception.wire.params import ViewParams

# Size limits of clusters that may be a pedestrian or a cyclist.
MIN_HEIGHT_M, MAX_HEIGHT_M, MAX_LENGTH_M = 0.8, 2.6, 2.8


@dataclass(frozen=True)
class SegmentedCloud:
    """Ground, clusters and boxes of the M points of a cloud that are in view.

    Attributes:
        indices: (M,) int64 indices of the points in the cloud.
        xyz: (M, 3) float32 points.
        ground: (M,) bool mask of the ground points.
        cluster_ids: (M,) int32 cluster 1..K of each point, 0 for none.
        boxes: (K, 7) float32 boxes of the clusters, extended down to the ground plane.
        original_ids: (K,) int64 ids of the clusters in the input; None if they are 1..K.
        intensity: (M,) float32 intensities 0..1 of the points, or None.
        ms: Duration of each step in milliseconds.
    """

    indices: np.ndarray
    xyz: np.ndarray
    ground: np.ndarray
    cluster_ids: np.ndarray
    boxes: np.ndarray
    original_ids: np.ndarray | None = None
    intensity: np.ndarray | None = None
    ms: dict[str, float] = field(default_factory=dict)


def fit_grounded_boxes(
    xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray, params: BoxParams = BoxParams()
) -> np.ndarray:
    """Fit boxes (K, 7) to clusters 1..K and extend them down to the ground plane."""
    plane = fit_ground_plane(xyz.compress(ground, axis=0), params)
    return snap_to_ground(fit_boxes(xyz, cluster_ids, params.shape), plane)


def is_person_sized(boxes: np.ndarray) -> np.ndarray:
    """Return a mask (K,) bool of the boxes (K, 7) that are not too large or too small for a person."""
    return (
        (boxes[:, 5] >= MIN_HEIGHT_M)
        & (boxes[:, 5] <= MAX_HEIGHT_M)
        & (boxes[:, 3:5].max(axis=1, initial=0.0) <= MAX_LENGTH_M)
    )


def snap_to_ground(boxes: np.ndarray, plane: np.ndarray | None) -> np.ndarray:
    """Return boxes (K, 7) extended down to the plane below their centres (Section 3.4).

    Boxes that already reach below the plane are not changed. Without a plane (None), no box is changed.
    """
    extended_boxes = boxes.copy()
    if plane is None:
        return extended_boxes
    plane_z = boxes[:, :2].astype(np.float64) @ plane[:2] + plane[2]
    top = boxes[:, 2] + boxes[:, 5] / 2
    bottom = np.minimum(boxes[:, 2] - boxes[:, 5] / 2, plane_z)
    extended_boxes[:, 2] = (top + bottom) / 2
    extended_boxes[:, 5] = top - bottom
    return extended_boxes


def fit_ground_plane(ground: np.ndarray, params: BoxParams) -> np.ndarray | None:
    """Fit a plane (3,) to ground points (M, 3); return None if no plane is found."""
    if params.plane == "ransac":
        return fit_plane_by_ransac(ground, ThresholdParams())
    return fit_plane(ground)


def diagnose_empty(point_count: int, ground: np.ndarray, cluster_ids: np.ndarray | None = None) -> str | None:
    """Return the reason why a cloud has no candidates, with a remedy, or None.

    Args:
        point_count: Number of finite points in the cloud.
        ground: (M,) mask of the ground points among the points in view.
        cluster_ids: (M,) cluster of each point in view, 0 for none.
    """
    if point_count == 0:
        return EMPTY_CLOUD
    if len(ground) == 0:
        return "no points in the camera's view; check the LiDAR-to-camera transform and crop.*"
    if not ground.any():
        return "no ground found; set ground.sensor_pose to the sensor's actual height and tilt"
    if cluster_ids is not None and not cluster_ids.any():
        return "no clusters found; adapt clustering.dbscan or clustering.euclidean to this sensor"
    return None


def crop_to_view(frame: PointCloud, camera: Camera | None, params: ViewParams) -> tuple[np.ndarray, PointCloud]:
    """Crop a frame to the camera's view if params.enabled is True.

    Returns:
        Indices (M,) int64 of the remaining points, and the frame with these points.

    Raises:
        InputError: params.enabled is True but there is no camera.
    """
    if not params.enabled:
        return np.arange(len(frame)), frame
    if camera is None:
        raise InputError(
            "view.enabled is true but there is no camera calibration; provide CameraInfo "
            "and the LiDAR-to-camera transform, or set view.enabled to false"
        )
    indices = np.flatnonzero(camera.in_view(frame.xyz))
    return indices, frame.take(indices)
