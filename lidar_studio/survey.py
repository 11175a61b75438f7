"""Survey of a drive: detections and candidate clusters of every frame.

It is computed once per drive. A new seed then only has to be compared with these clusters.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from lidar_perception.candidates.confidence import compute_shape_features
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.candidates.silhouette import ROWS, draw_silhouettes
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.groups import group_points
from lidar_perception.runs.processes import run_in_processes
from lidar_perception.tracking.ego import Odometry, choose_recorded_source
from lidar_perception.types import Detections
from lidar_studio.drive import Drive, make_pipeline_params, select_drive

Array = np.ndarray[Any, Any]
MIN_DETECTION_SCORE = 0.1  # low, because the tracker filters uncertain detections
PERSON_HEIGHTS_M = 0.9, 2.4  # minimum and maximum height of a person
MAX_PERSON_DIAGONAL_M = 2.0  # maximum BEV diagonal of a person's cluster
MIN_PERSON_POINTS = 5
OBJECT_HEIGHTS_M = 0.7, 4.5  # minimum and maximum height of other objects
MAX_OBJECT_DIAGONAL_M = 14.0  # maximum BEV diagonal of another object's cluster
MIN_OBJECT_POINTS = 10


@dataclass(frozen=True)
class FrameSurvey:
    """Survey of one frame.

    Attributes:
        boxes: (C, 7) boxes of clusters that may be people, extended down to the ground.
        images: (C, 80) uint32 silhouettes of these clusters.
        features: Features (C,) of these clusters by name; empty if C is 0.
        shapes: (T, 7) L-shapes of clusters that may be other objects, extended down to the ground.
        pose: (4, 4) pose from scan matching, relative to the first frame; None if the drive has poses.
    """

    detections: Detections
    boxes: Array
    images: Array
    features: dict[str, Array]
    shapes: Array
    pose: Array | None = None


def survey_frame(frame: Frame, detector: Detector | None = None, odometry: Odometry | None = None) -> FrameSurvey:
    """Survey a frame.

    Args:
        detector: None for no detections.
        odometry: Scan matching, which must be given all frames in order; None for no pose.

    Raises:
        InputError: The frame cannot be read.
    """
    cloud, params = frame.load(), make_pipeline_params(frame)
    segmented = segment_cloud(cloud, None, params)
    detections = Detections.none() if detector is None else detector(cloud).detections
    pose = None if odometry is None else odometry(cloud.xyz)
    counts = np.bincount(segmented.cluster_ids, minlength=len(segmented.boxes) + 1)[1:]
    people = _find_clusters(segmented.boxes, counts, PERSON_HEIGHTS_M, MAX_PERSON_DIAGONAL_M, MIN_PERSON_POINTS)
    boxes, shapes = segmented.boxes[people], _fit_objects(segmented, counts)
    if len(people) == 0:
        return FrameSurvey(detections, boxes, np.zeros((0, ROWS), np.uint32), {}, shapes, pose)
    images, features = _describe_people(segmented.xyz, segmented.cluster_ids, boxes, people + 1, params)
    return FrameSurvey(detections, boxes, images, features, shapes, pose)


def _find_clusters(
    boxes: Array, counts: Array, heights: tuple[float, float], max_diagonal: float, min_points: int
) -> Array:
    """Return the indices (K,) int of the clusters within these limits."""
    return np.flatnonzero(
        (boxes[:, 5] >= heights[0])
        & (boxes[:, 5] <= heights[1])
        & (np.hypot(boxes[:, 3], boxes[:, 4]) <= max_diagonal)
        & (counts >= min_points)
    )


def _fit_objects(segmented: SegmentedCloud, counts: Array) -> Array:
    """Fit L-shapes (T, 7) float32 to clusters that may be objects."""
    indices = _find_clusters(segmented.boxes, counts, OBJECT_HEIGHTS_M, MAX_OBJECT_DIAGONAL_M, MIN_OBJECT_POINTS)
    numbers = np.zeros(len(segmented.boxes) + 1, np.int32)
    numbers[indices + 1] = np.arange(1, len(indices) + 1)
    labels = numbers[segmented.cluster_ids]
    shapes = fit_boxes(segmented.xyz[labels > 0], labels[labels > 0], "l_shape")
    shapes[:, [2, 5]] = segmented.boxes[indices][:, [2, 5]]  # extended down to the ground
    return shapes


def _describe_people(
    xyz: Array, cluster_ids: Array, boxes: Array, numbers: Array, params: PipelineParams
) -> tuple[Array, dict[str, Array]]:
    points, start = group_points(xyz, cluster_ids, numbers)
    ground_heights = (boxes[:, 2] - boxes[:, 5] / 2).astype(np.float64)
    images = draw_silhouettes(points, start, np.ones((len(boxes), 1)), ground_heights, params)
    return images, compute_shape_features(points, start, boxes, params)


def survey_drive(
    drive: Drive, choice: DetectorChoice | None, first: int = 0
) -> Generator[FrameSurvey | None, None, None]:
    """Yield the surveys of all frames from `first` on, in order.

    The frames are surveyed in a separate process if the recording can be reopened there. Scan
    matching must process earlier frames again, for which this function yields None.

    Raises:
        InputError: A frame or the detector's weights cannot be read.
    """
    reopen = drive.recording.reopen
    frames = list(range(0 if _needs_odometry(drive) else first, len(drive.frames)))
    if reopen is None:
        yield from map(_make_surveyor(drive, choice, first), frames)
        return
    sequence = drive.frames[0].sequence
    make_surveyor = partial(_make_process_surveyor, reopen, choice, sequence, first)
    yield from run_in_processes(make_surveyor, frames, 1, "surveyed frames", separate=True)


def _needs_odometry(drive: Drive) -> bool:
    return choose_recorded_source(drive.motion.poses is not None) == "kiss_icp"


def _make_surveyor(drive: Drive, choice: DetectorChoice | None, first: int) -> Callable[[int], FrameSurvey | None]:
    detector = (
        None
        if choice is None
        else choice.open(sensor_height=drive.frames[0].sensor_height, min_score=MIN_DETECTION_SCORE)
    )
    odometry = Odometry() if _needs_odometry(drive) else None

    def survey(i: int) -> FrameSurvey | None:
        if i >= first:
            return survey_frame(drive.frames[i], detector, odometry)
        if odometry is not None:
            odometry(drive.frames[i].load().xyz)
        return None

    return survey


def _make_process_surveyor(
    reopen: Callable[[], Recording], choice: DetectorChoice | None, sequence: str, first: int
) -> Callable[[int], FrameSurvey | None]:
    os.nice(10)  # keep the page responsive
    return _make_surveyor(select_drive(reopen(), sequence), choice, first)
