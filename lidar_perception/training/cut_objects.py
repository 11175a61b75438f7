"""Objects cut from scenes for pasting: labelled ones, and things that resemble a standing person.

Such things (posts, poles, trunks, bins) are pasted as background as often as people.
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
from lidar_perception.training.cache import cache_path, load_or_make
from lidar_perception.training.database import THING, Database
from lidar_perception.training.pasting import find_points_in_box
from lidar_perception.types import CLASSES, PEDESTRIAN, PointCloud

# An object resembles a standing person under these conditions:
MAX_WIDTH_M = 1.2  # maximum length of its sides
MIN_TOP_M, MAX_TOP_M = 0.6, 4.5  # height of its top above the ground
MAX_GAP_M = 0.8  # maximum height of its lowest point above the ground
MIN_DISTANCE_M = 0.3  # minimum distance from every labelled box
MAX_THINGS = 20  # maximum number of such objects from a scene


@dataclass(frozen=True)
class CutObjects:
    """A source whose scene(i) is the Database of objects cut from scene i, see cut_objects.

    Attributes:
        min_points: Objects with fewer points are left out.
        cache: Folder that keeps the objects, or None.
    """

    scenes: Any
    classes: tuple[str, ...]
    min_points: int = 5
    cache: Path | None = None

    def __len__(self) -> int:
        return len(self.scenes)

    def path(self, i: int) -> Path | None:
        """Return the cache file of scene i."""
        return cache_path(self.cache, self.scenes.key(i), self.classes, self.min_points)

    def keep(self, i: int) -> None:
        """Put the objects of scene i into the cache."""
        self.scene(i)

    def scene(self, i: int) -> Database:
        """Return the objects of scene i. Raise InputError, naming the file, for a broken scene."""
        return load_or_make(
            self.path(i),
            lambda: cut_objects(self.scenes.scene(i), self.classes, self.min_points, i),
            lambda arrays: Database(**arrays),
            vars,
        )


def cut_objects(scene: TrainingScene, classes: tuple[str, ...], min_points: int, seed: int = 0) -> Database:
    """Cut the wanted objects of some classes that have min_points and overlap no other box.

    With pedestrians also things that resemble people, see find_things. The seed draws among many.
    """
    chosen = [CLASSES.index(name) for name in classes]
    overlap = bev_iou(scene.boxes, scene.boxes) > 0
    isolated = overlap.sum(axis=1) <= 1
    boxes, class_ids, points = [np.zeros((0, 7))], [], [np.zeros((0, 4), np.float32)]
    for i in np.flatnonzero(scene.wanted & isolated & np.isin(scene.class_ids, chosen)):
        own = scene.points[find_points_in_box(scene.points, scene.boxes[i], 0.0)]
        if len(own) >= min_points:
            boxes.append(scene.boxes[i : i + 1])
            class_ids.append(scene.class_ids[i])
            points.append(own)
    if PEDESTRIAN in chosen:
        things, thing_points = find_things(scene, min_points, np.random.default_rng(seed))
        boxes.append(things)
        class_ids.extend([THING] * len(things))
        points.extend(thing_points)
    sizes = [len(own) for own in points[1:]]
    return Database(
        np.concatenate(boxes),
        np.array(class_ids, np.int32),
        np.concatenate(points),
        np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
    )


def join_databases(parts: Sequence[Database]) -> Database:
    """Return one database with the objects of all parts, empty without any."""
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


def find_things(scene: TrainingScene, min_points: int, rng: np.random.Generator) -> tuple[np.ndarray, list[np.ndarray]]:
    """Find clusters that resemble a standing person and touch no labelled box.

    Args:
        min_points: Smallest number of points of a thing.
        rng: Draws MAX_THINGS if there are more.

    Returns:
        Boxes (K, 7) float64, along the axes and from the ground up, and the points (N, 4) of each.
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
    kept = (
        (sizes >= min_points)
        & (boxes[:, 3:5].max(axis=1, initial=0) <= MAX_WIDTH_M)
        & (boxes[:, 5] >= MIN_TOP_M)
        & (boxes[:, 5] <= MAX_TOP_M)
        & (low[:, 2] - floor <= MAX_GAP_M)
    )
    kept = np.flatnonzero(kept)
    kept = kept[~bev_iou(enlarge_boxes(boxes[kept]), enlarge_boxes(scene.boxes, MIN_DISTANCE_M)).any(axis=1)]
    kept = rng.permutation(kept)[:MAX_THINGS]
    return boxes[kept], [scene.points[ids == k + 1] for k in kept]
