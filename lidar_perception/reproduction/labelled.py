"""One labelled frame as the experiments take it, and the seed of the paper's protocol."""

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
from lidar_perception.types import (
    CLASSES,
    PEDESTRIAN,
    SENSOR_HEIGHT,
    GroundTruth,
    InputError,
    PointCloud,
)

VEHICLES = [i for i, row in enumerate(TABLE) if row.vehicle]


@dataclass(frozen=True)
class Labelled:
    """A frame with at least one pedestrian: pedestrians (M, 7) are their true boxes; height: of
    the sensor above the ground, metres."""

    frame: PointCloud
    camera: Camera
    truth: GroundTruth
    height: float = SENSOR_HEIGHT

    @property
    def pedestrians(self) -> np.ndarray:
        return self.truth.of_class(PEDESTRIAN)

    def segmented(self, params: PipelineParams, scan: PointCloud | None = None) -> SegmentedCloud:
        """The frame, or another scan of the same sensor, up to the boxes."""
        return segment_cloud(self.frame if scan is None else scan, self.camera,
                             set_sensor_height(params, self.height))


def load_labelled(frame: Frame) -> Labelled:
    """The frame read. InputError, naming the file, where one cannot be read, is empty or not
    there, or where no Pedestrian is labelled."""
    truth = frame.truth()  # first: most frames of KITTI end here
    if truth is None:
        raise InputError(f"{frame.points or frame.name} has no labels; put them beside the scans")
    if PEDESTRIAN not in truth.class_ids:
        raise InputError("no Pedestrian is labelled; the paper leaves such frames out")
    scan, calibration = frame.load(), frame.calibration()
    if calibration is None:
        raise InputError(f"{frame.name} has no camera calibration, to whose view the paper crops")
    truth, camera = select_in_image(truth, calibration), calibration.camera()
    if PEDESTRIAN not in truth.class_ids:
        raise InputError("no Pedestrian is labelled in the image; the paper leaves such frames out")
    if not camera.in_view(scan.xyz).any():
        raise InputError(f"{frame.points or frame.name} has no point in the camera's view; "
                         "download it and its calibration again")
    return Labelled(scan, camera, truth, frame.sensor_height)


def nearest_seed(segmented: SegmentedCloud, labelled: Labelled) -> Seed:
    """The seed of the paper's protocol: the nearest labelled pedestrian. InputError where it has
    too few points, or is on a vehicle, whose points would make the template."""
    pedestrians = labelled.pedestrians
    nearest = pedestrians[np.argmin(np.hypot(pedestrians[:, 0], pedestrians[:, 1]))]
    for box, class_id in zip(labelled.truth.boxes, labelled.truth.class_ids):
        if class_id in VEHICLES and points_in_box(nearest[None, :3], box).any():
            x, y = nearest[:2]
            raise InputError(f"the seed pedestrian at ({x:.1f}, {y:.1f}) m stands in a labelled "
                             f"{CLASSES[class_id]}; mend the labels")
    return seed_from_truth(segmented.xyz, segmented.ground, pedestrians)
