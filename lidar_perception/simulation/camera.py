"""The camera of the simulated car, which takes no pictures but limits the labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar_perception.camera import FORWARD_CAMERA, Calibration
from lidar_perception.data.kitti.labels import DONT_CARE
from lidar_perception.data.kitti.write import keep_visible_objects
from lidar_perception.types import GroundTruth

# Annotators skip objects that are hardly visible. The smallest of 20 pedestrians in real
# frames has 16 points; few in KITTI have fewer than 5.
MIN_VISIBLE = 0.15  # minimum visible fraction of an object
MIN_POINTS = 5


def turn_camera(yaw: float) -> Calibration:
    """Return FORWARD_CAMERA turned with its mount about the sensor, counter-clockwise, rad."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    back = np.array([[cos, sin, 0, 0], [-sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return replace(FORWARD_CAMERA, lidar_to_camera=FORWARD_CAMERA.lidar_to_camera @ back)


def find_labelled(truth: GroundTruth) -> np.ndarray:
    """Return (K,) bool: enough of the simulated object is visible for a label."""
    return np.array([e["visible"] >= MIN_VISIBLE and e["num_points"] >= MIN_POINTS for e in truth.extras], bool)


def select_labels_in_view(truth: GroundTruth) -> GroundTruth:
    """Return the labelled objects whose centre is in the image of FORWARD_CAMERA."""
    seen = FORWARD_CAMERA.camera().in_view(truth.boxes[:, :3]) & find_labelled(truth)
    return _select(truth, seen)


def select_labels(truth: GroundTruth) -> GroundTruth:
    """Return the labelled objects all around, for scenes without a camera."""
    return _select(truth, find_labelled(truth))


def make_kitti_labels(truth: GroundTruth, camera: Calibration = FORWARD_CAMERA) -> GroundTruth:
    """Return the content of a KITTI label file.

    It has the labelled objects that are partly in the image, and DontCare regions of the others as
    notes.
    """
    in_image = keep_visible_objects(truth, camera)
    labelled = find_labelled(in_image)
    notes = [
        ("DontCare", {**DONT_CARE, "bbox": extra["bbox"]})
        for extra, known in zip(in_image.extras, labelled)
        if not known
    ]
    kept = _select(in_image, labelled)
    return GroundTruth.of(kept.boxes, kept.class_ids, kept.extras, notes)


def _select(truth: GroundTruth, mask: np.ndarray) -> GroundTruth:
    indices = np.flatnonzero(mask)
    return GroundTruth.of(truth.boxes[indices], truth.class_ids[indices], [truth.extras[i] for i in indices])
