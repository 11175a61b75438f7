"""Objects cut from scenes to be pasted into others: labelled objects, and background that resembles people.

Examples of such background are posts, poles, tree trunks and bins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.shapes import find_extents
from lidar_perception.detectors.pointnet.clusters import find_ground_heights
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.geometry import bev_iou
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.training.augment import TrainingScene, enlarge_boxes
from lidar_perception.training.cache import load_or_compute, make_cache_path
from lidar_perception.training.database import BACKGROUND_ID, Database
from lidar_perception.training.pasting import find_points_in_box
from lidar_perception.types import CLASSES, PEDESTRIAN, PointCloud

# Limits of background that resembles a standing person:
MAX_WIDTH_M = 1.2  # maximum length of the object's sides
MIN_TOP_M, MAX_TOP_M = 0.6, 4.5  # height of the object's top above the ground
MAX_GAP_M = 0.8  # maximum height of the object's lowest point above the ground
MIN_DISTANCE_M = 0.3  # minimum distance from every labelled box
MAX_BACKGROUND_OBJECTS = 20  # maximum number of background objects from a scene


@dataclass(frozen=True)
class CutObjects:
    """Source whose load_scene(i) is the Database of the objects cut from scene i, see cut_objects.

    Attributes:
        scenes: Source of scenes.
        classes: Names of the classes to cut.
        min_points: Objects with fewer points are ignored.
        cache: Folder of cached objects, or None.
    """

    scenes: Any
    classes: tuple[str, ...]
    min_points: int = 5
    cache: Path | None = None

    def __len__(self) -> int:
        return len(self.scenes)

    def cache_file(self, i: int) -> Path | None:
        """Return the cache file of scene i."""
        return make_cache_path(self.cache, self.scenes.cache_key(i), self.classes, self.min_points)

    def load_scene(self, i: int) -> Database:
        """Return the objects of scene i. Raise InputError if the scene cannot be read."""
        return load_or_compute(
            self.cache_file(i),
            lambda: cut_objects(self.scenes.load_scene(i), self.classes, self.min_points, i),
            lambda arrays: Database(**arrays),
            vars,
        )


def cut_objects(scene: TrainingScene, classes: tuple[str, ...], min_points: int, seed: int = 0) -> Database:
    """Cut the detectable objects of some classes that overlap no other box.

    If Pedestrian is one of the classes, also cut background that resembles people, see
    find_background_objects.

    Args:
        classes: Names of the classes.
        min_points: Objects with fewer points are ignored.
        seed: Seed of the choice of background objects.
    """
    class_indices = [CLASSES.index(name) for name in classes]
    overlap = bev_iou(scene.boxes, scene.boxes) > 0
    is_isolated = overlap.sum(axis=1) <= 1
    boxes, class_ids, points = [np.zeros((0, 7))], [], [np.zeros((0, 4), np.float32)]
    for i in np.flatnonzero(scene.detectable & is_isolated & np.isin(scene.class_ids, class_indices)):
        object_points = scene.points[find_points_in_box(scene.points, scene.boxes[i], 0.0)]
        if len(object_points) >= min_points:
            boxes.append(scene.boxes[i : i + 1])
            class_ids.append(scene.class_ids[i])
            points.append(object_points)
    if PEDESTRIAN in class_indices:
        background_boxes, background_points = find_background_objects(scene, min_points, np.random.default_rng(seed))
        boxes.append(background_boxes)
        class_ids.extend([BACKGROUND_ID] * len(background_boxes))
        points.extend(background_points)
    sizes = [len(object_points) for object_points in points[1:]]
    return Database(
        np.concatenate(boxes),
        np.array(class_ids, np.int32),
        np.concatenate(points),
        np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
    )


def join_databases(parts: Sequence[Database]) -> Database:
    """Concatenate databases. The result is empty if there are none."""
    parts = [
        Database(np.zeros((0, 7)), np.zeros(0, np.int32), np.zeros((0, 4), np.float32), np.zeros(1, np.int64)),
        *parts,
    ]
    ends = np.cumsum([part.first[-1] for part in parts])
    first = [parts[0].first, *(part.first[1:] + end for part, end in zip(parts[1:], ends))]
    return Database(
        np.concatenate([part.boxes for part in parts]),
        np.concatenate([part.class_ids for part in parts]),
        np.concatenate([part.points for part in parts]),
        np.concatenate(first),
    )


def find_background_objects(
    scene: TrainingScene, min_points: int, rng: np.random.Generator
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Find clusters that resemble a standing person and touch no labelled box.

    Args:
        min_points: Minimum number of points of a cluster.
        rng: Random generator that selects MAX_BACKGROUND_OBJECTS if there are more.

    Returns:
        Axis-aligned boxes (K, 7) float64 that stand on the ground, and the points (N, 4) of each.
    """
    xyz = np.ascontiguousarray(scene.points[:, :3])
    ground = segment_ground(PointCloud(xyz), replace(EXPERT_GROUND, sensor_pose=SensorPoseParams(height=scene.height)))
    ids = cluster_obstacles(xyz, ground, EXPERT_CLUSTERING)
    low, high, sizes = find_extents(xyz, ids, int(ids.max(initial=0)))
    boxes = np.zeros((len(sizes), 7))
    boxes[:, :2] = (low[:, :2] + high[:, :2]) / 2
    boxes[:, 3:5] = high[:, :2] - low[:, :2]
    floor = find_ground_heights(xyz[ground], boxes[:, :2])
    boxes[:, 5] = high[:, 2] - floor
    boxes[:, 2] = floor + boxes[:, 5] / 2
    is_candidate = (
        (sizes >= min_points)
        & (boxes[:, 3:5].max(axis=1, initial=0) <= MAX_WIDTH_M)
        & (boxes[:, 5] >= MIN_TOP_M)
        & (boxes[:, 5] <= MAX_TOP_M)
        & (low[:, 2] - floor <= MAX_GAP_M)
    )
    indices = np.flatnonzero(is_candidate)
    overlap = bev_iou(enlarge_boxes(boxes[indices]), enlarge_boxes(scene.boxes, MIN_DISTANCE_M))
    indices = rng.permutation(indices[~overlap.any(axis=1)])[:MAX_BACKGROUND_OBJECTS]
    return boxes[indices], [scene.points[ids == k + 1] for k in indices]
