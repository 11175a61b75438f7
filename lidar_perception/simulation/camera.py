"""The camera beside the simulated LiDAR: it takes no pictures, but says what is labelled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar_perception.camera import FORWARD_CAMERA, Calibration
from lidar_perception.data.kitti.labels import DONT_CARE
from lidar_perception.data.kitti.write import keep_visible_objects
from lidar_perception.types import GroundTruth

# People who label leave out what they can hardly see. The least of the 20 pedestrians of the real
# frames at hand has 16 points; of KITTI's they are few that have less than 5.
MIN_VISIBLE = 0.15  # share of the object
MIN_POINTS = 5


def turn_camera(yaw: float) -> Calibration:
    """That camera, turned with its mount about the sensor, counter-clockwise, rad."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    back = np.array([[cos, sin, 0, 0], [-sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return replace(FORWARD_CAMERA, lidar_to_camera=FORWARD_CAMERA.lidar_to_camera @ back)


def find_labelled(truth: GroundTruth) -> np.ndarray:
    """(K,) bool: the simulated objects of which enough is seen."""
    return np.array([e["visible"] >= MIN_VISIBLE and e["num_points"] >= MIN_POINTS
                     for e in truth.extras], bool)


def select_labels_in_view(truth: GroundTruth) -> GroundTruth:
    """The labelled objects whose centre FORWARD_CAMERA sees."""
    seen = FORWARD_CAMERA.camera().in_view(truth.boxes[:, :3]) & find_labelled(truth)
    return _select(truth, seen)


def select_labels(truth: GroundTruth) -> GroundTruth:
    """The labelled objects all around, where no camera says what is labelled."""
    return _select(truth, find_labelled(truth))


def make_kitti_labels(truth: GroundTruth, camera: Calibration = FORWARD_CAMERA) -> GroundTruth:
    """What a KITTI label file has: the labelled objects of which a part is in the image, and as
    notes the regions of the others, DontCare."""
    in_image = keep_visible_objects(truth, camera)
    labelled = find_labelled(in_image)
    notes = [("DontCare", {**DONT_CARE, "bbox": extra["bbox"]})
             for extra, known in zip(in_image.extras, labelled) if not known]
    kept = _select(in_image, labelled)
    return GroundTruth.of(kept.boxes, kept.class_ids, kept.extras, notes)


def _select(truth: GroundTruth, mask: np.ndarray) -> GroundTruth:
    indices = np.flatnonzero(mask)
    return GroundTruth.of(truth.boxes[indices], truth.class_ids[indices],
                          [truth.extras[i] for i in indices])
