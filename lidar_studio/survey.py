"""What is looked at once in each frame of a drive, so that proposals for another seed take no
time: what a detector finds, and the clusters that may be people or things."""

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
from lidar_studio.drive import Drive, one_drive, settings

Array = np.ndarray[Any, Any]
LEAST_SCORE = 0.1             # of a detection: tracks make something of weak ones
HEIGHTS = 0.9, 2.4            # metres of a person above the ground
WIDEST = 2.0                  # metres of one's cluster seen from above
FEWEST = 5                    # points of one
THINGS = 0.7, 4.5             # metres above the ground of what else may be a seed's like,
LONGEST = 14.0                # the longest side of its cluster,
FEWEST_OF_THING = 10          # and its points


@dataclass(frozen=True)
class Look:
    """Of one frame: detections; and C clusters that may be people: boxes (C, 7) on the ground,
    silhouettes (C, 80) uint32, and their features by name, (C,) each. things (T, 7): the L-shapes
    of clusters of any kind, on the ground. pose (4, 4) in the first frame, by the scans, where the
    drive has none of its own."""

    detections: Detections
    boxes: Array
    images: Array
    features: dict[str, Array]
    things: Array
    pose: Array | None = None


def look_at(frame: Frame, detector: Detector | None = None,
            odometry: Odometry | None = None) -> Look:
    """See Look; without a detector there are no detections, and without odometry, which is given
    the frames in their order, no pose. InputError where the frame cannot be read."""
    cloud, params = frame.load(), settings(frame)
    found = segment_cloud(cloud, None, params)
    detections = Detections.none() if detector is None else detector(cloud).detections
    pose = None if odometry is None else odometry(cloud.xyz)
    counts = np.bincount(found.cluster_ids, minlength=len(found.boxes) + 1)[1:]
    people = np.flatnonzero((found.boxes[:, 5] >= HEIGHTS[0]) & (found.boxes[:, 5] <= HEIGHTS[1])
                            & (np.hypot(found.boxes[:, 3], found.boxes[:, 4]) <= WIDEST)
                            & (counts >= FEWEST))
    boxes, things = found.boxes[people], _things(found, counts)
    if len(people) == 0:
        return Look(detections, boxes, np.zeros((0, ROWS), np.uint32), {}, things, pose)
    return Look(detections, boxes, *_described(found.xyz, found.cluster_ids, boxes, people + 1,
                                               params), things, pose)


def _things(found: SegmentedCloud, counts: Array) -> Array:
    """(T, 7) float32."""
    height, across = found.boxes[:, 5], np.hypot(found.boxes[:, 3], found.boxes[:, 4])
    chosen = np.flatnonzero((height >= THINGS[0]) & (height <= THINGS[1]) & (across <= LONGEST)
                            & (counts >= FEWEST_OF_THING))
    numbers = np.zeros(len(found.boxes) + 1, np.int32)
    numbers[chosen + 1] = np.arange(1, len(chosen) + 1)
    labels = numbers[found.cluster_ids]
    shapes = fit_boxes(found.xyz[labels > 0], labels[labels > 0], "l_shape")
    shapes[:, [2, 5]] = found.boxes[chosen][:, [2, 5]]  # down to the ground
    return shapes


def _described(xyz: Array, cluster_ids: Array, boxes: Array, numbers: Array,
               params: PipelineParams) -> tuple[Array, dict[str, Array]]:
    points, start = group_points(xyz, cluster_ids, numbers)
    floors = (boxes[:, 2] - boxes[:, 5] / 2).astype(np.float64)
    images = draw_silhouettes(points, start, np.ones((len(boxes), 1)), floors, params)
    return images, compute_shape_features(points, start, boxes, params)


def surveyed(drive: Drive, choice: DetectorChoice | None, here: bool = False,
             first: int = 0) -> Generator[Look | None, None, None]:
    """Yield the looks of all frames from `first` on, in their order.

    Args:
        choice: the detector, or None.
        here: look in this process, not in a separate one that ends with the iterator.
        first: None is yielded for each earlier frame that the poses from the scans need again.

    Raises:
        InputError: a frame or the detector's weights cannot be read.
    """
    reopen = drive.recording.reopen
    frames = list(range(0 if _by_scans(drive) else first, len(drive.frames)))
    if here or reopen is None:
        yield from map(_here(drive, choice, first), frames)
        return
    sequence = drive.frames[0].sequence
    yield from run_in_processes(partial(_elsewhere, reopen, choice, sequence, first), frames, 1,
                                "looked for proposals", apart=True)


def _by_scans(drive: Drive) -> bool:
    return choose_recorded_source(drive.motion.poses is not None) == "kiss_icp"


def _here(drive: Drive, choice: DetectorChoice | None,
          first: int) -> Callable[[int], Look | None]:
    detector = None if choice is None else choice.open(
        sensor_height=drive.frames[0].sensor_height, min_score=LEAST_SCORE)
    odometry = Odometry() if _by_scans(drive) else None

    def look(i: int) -> Look | None:
        if i >= first:
            return look_at(drive.frames[i], detector, odometry)
        if odometry is not None:
            odometry(drive.frames[i].load().xyz)
        return None
    return look


def _elsewhere(reopen: Callable[[], Recording], choice: DetectorChoice | None, sequence: str,
               first: int) -> Callable[[int], Look | None]:
    os.nice(10)  # the page comes first
    return _here(one_drive(reopen(), sequence), choice, first)
