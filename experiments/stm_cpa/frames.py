"""Labelled frames with pedestrians, and the seed of the paper's protocol."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.candidates.seeds import Seed, seed_from_truth
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.classes import TABLE
from lidar_perception.data.frame import Frame
from lidar_perception.geometry import points_in_box
from lidar_perception.ground.params import set_sensor_height
from lidar_perception.scoring.kitti.camera_objects import select_in_image
from lidar_perception.types import CLASSES, PEDESTRIAN, SENSOR_HEIGHT, GroundTruth, InputError, PointCloud

VEHICLES = [i for i, row in enumerate(TABLE) if row.vehicle]


@dataclass(frozen=True)
class LabelledFrame:
    """A frame with at least one labelled pedestrian.

    Attributes:
        height: Height of the sensor above the ground, metres.
    """

    cloud: PointCloud
    camera: Camera
    truth: GroundTruth
    height: float = SENSOR_HEIGHT

    @property
    def pedestrians(self) -> np.ndarray:
        """True boxes (M, 7) of the pedestrians."""
        return self.truth.select_class(PEDESTRIAN)

    def segment(self, params: PipelineParams) -> SegmentedCloud:
        """Run the pipeline up to the boxes of the clusters."""
        return segment_cloud(self.cloud, self.camera, set_sensor_height(params, self.height))


def load_labelled_frame(frame: Frame) -> LabelledFrame:
    """Load a frame with its labels and camera.

    Raises:
        InputError: A file is missing, empty or unreadable, or there is no Pedestrian label.
    """
    truth = frame.truth()  # checked first, because most frames of KITTI have no pedestrian
    if truth is None:
        raise InputError(f"{frame.points or frame.name} has no labels; put the label files next to the scans")
    if PEDESTRIAN not in truth.class_ids:
        raise InputError("no Pedestrian label; the paper does not use such frames")
    cloud, calibration = frame.load(), frame.calibration()
    if calibration is None:
        raise InputError(f"{frame.name} has no camera calibration; the paper crops clouds to the camera's view")
    truth, camera = select_in_image(truth, calibration), calibration.camera()
    if PEDESTRIAN not in truth.class_ids:
        raise InputError("no Pedestrian label in the image; the paper does not use such frames")
    if not camera.in_view(cloud.xyz).any():
        raise InputError(
            f"{frame.points or frame.name} has no points in the camera's view; download the scan and its calibration "
            "again"
        )
    return LabelledFrame(cloud, camera, truth, frame.sensor_height)


def find_nearest(boxes: np.ndarray) -> np.ndarray:
    """Return the box (7,) that is nearest to the sensor among boxes (M, 7), M >= 1."""
    return boxes[np.argmin(np.hypot(boxes[:, 0], boxes[:, 1]))]


def make_nearest_seed(segmented: SegmentedCloud, labelled: LabelledFrame) -> Seed:
    """Return the seed of the paper's protocol: the nearest labelled pedestrian.

    Raises:
        InputError: The pedestrian has too few points, or is on a vehicle, so that the template would
            contain points of the vehicle.
    """
    nearest = find_nearest(labelled.pedestrians)
    for box, class_id in zip(labelled.truth.boxes, labelled.truth.class_ids):
        if class_id in VEHICLES and points_in_box(nearest[None, :3], box).any():
            x, y = nearest[:2]
            raise InputError(
                f"the seed pedestrian at ({x:.1f}, {y:.1f}) m is inside a labelled {CLASSES[class_id]}; correct the "
                "labels"
            )
    return seed_from_truth(segmented.xyz, segmented.ground, labelled.pedestrians)
