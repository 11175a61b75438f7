"""Camera of the simulated car. It takes no pictures, but only objects in its image are labelled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar_perception.camera import FORWARD_CAMERA, Calibration
from lidar_perception.data.kitti.labels import DONT_CARE
from lidar_perception.data.kitti.write import keep_visible_objects
from lidar_perception.types import GroundTruth

# Minimum visible fraction and number of points of a labelled object: annotators skip objects that are
# hardly visible, and few labels in KITTI have fewer than 5 points.
MIN_VISIBLE, MIN_POINTS = 0.15, 5


def rotate_camera(yaw: float) -> Calibration:
    """Rotate FORWARD_CAMERA about the sensor's z axis by yaw (rad, counter-clockwise)."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[cos, sin, 0, 0], [-sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return replace(FORWARD_CAMERA, lidar_to_camera=FORWARD_CAMERA.lidar_to_camera @ rotation)


def find_labelled(truth: GroundTruth) -> np.ndarray:
    """Return (K,) bool, True for objects that are visible enough for a label."""
    return np.array([e["visible"] >= MIN_VISIBLE and e["num_points"] >= MIN_POINTS for e in truth.extras], bool)


def select_labels_in_view(truth: GroundTruth) -> GroundTruth:
    """Return the labelled objects whose centre is in the image of FORWARD_CAMERA."""
    return truth.take(FORWARD_CAMERA.camera().in_view(truth.boxes[:, :3]) & find_labelled(truth))


def select_labels(truth: GroundTruth) -> GroundTruth:
    """Return the objects in all directions that are visible enough for a label."""
    return truth.take(find_labelled(truth))


def make_kitti_labels(truth: GroundTruth, camera: Calibration = FORWARD_CAMERA) -> GroundTruth:
    """Make the content of a KITTI label file.

    It has the objects that are at least partly in the image. Those that are not visible enough for a
    label become DontCare regions, as notes.
    """
    objects = keep_visible_objects(truth, camera)
    is_labelled = find_labelled(objects)
    notes = [("DontCare", {**DONT_CARE, "bbox": extra["bbox"]}) for extra in objects.take(~is_labelled).extras]
    return replace(objects.take(is_labelled), notes=tuple(notes))
