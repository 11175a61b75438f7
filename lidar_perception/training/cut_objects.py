"""What scenes give to others: labelled objects, and what stands upright like a person and is none
(posts, poles, trunks, bins), to be learned from as often as people are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.shapes import find_extents
from lidar_perception.detectors.pointnet.clusters import ground_under
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.geometry import bev_iou
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.training.augment import TrainingScene, grown
from lidar_perception.training.cache import kept, path_in
from lidar_perception.training.database import THING, Database
from lidar_perception.training.putting import inside
from lidar_perception.types import CLASSES, PEDESTRIAN, LidarFrame

WIDEST = 1.2          # m to a side
HEIGHTS = 0.6, 4.5    # m of its top above the ground
MAX_GAP = 0.8        # m between the ground and the lowest point
APART = 0.3           # m from every labelled box
MOST = 20             # of a scene


@dataclass(frozen=True)
class CutObjects:
    """scene(i): what scene i of `scenes` gives to others, see cut. cache: folder for that, or
    None."""

    scenes: Any
    classes: tuple[str, ...]
    min_points: int = 5
    cache: Path | None = None

    def __len__(self) -> int:
        return len(self.scenes)

    def path(self, i: int) -> Path | None:
        """The file that keeps it."""
        return path_in(self.cache, self.scenes.key(i), self.classes, self.min_points)

    def keep(self, i: int) -> None:
        """Put it into the cache."""
        self.scene(i)

    def scene(self, i: int) -> Database:
        """InputError naming the file that cannot be used."""
        return kept(self.path(i),
                    lambda: cut(self.scenes.scene(i), self.classes, self.min_points, i),
                    lambda arrays: Database(**arrays), vars)


def cut(scene: TrainingScene, classes: tuple[str, ...], min_points: int, seed: int = 0) -> Database:
    """The wanted objects of some classes that have enough points; where boxes overlap, none. If
    people are among them, things that look like people, too; which of many, the seed draws."""
    chosen = [CLASSES.index(name) for name in classes]
    overlap = bev_iou(scene.boxes, scene.boxes) > 0
    alone = overlap.sum(axis=1) <= 1
    boxes, class_ids, points = [np.zeros((0, 7))], [], [np.zeros((0, 4), np.float32)]
    for i in np.flatnonzero(scene.wanted & alone & np.isin(scene.class_ids, chosen)):
        own = scene.points[inside(scene.points, scene.boxes[i], 0.0)]
        if len(own) >= min_points:
            boxes.append(scene.boxes[i:i + 1])
            class_ids.append(scene.class_ids[i])
            points.append(own)
    if PEDESTRIAN in chosen:
        things, of_things = things_in(scene, min_points, np.random.default_rng(seed))
        boxes.append(things)
        class_ids.extend([THING] * len(things))
        points.extend(of_things)
    sizes = [len(own) for own in points[1:]]
    return Database(np.concatenate(boxes), np.array(class_ids, np.int32), np.concatenate(points),
                    np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64))


def joined(parts: Sequence[Database]) -> Database:
    """All objects of some databases; with none of them, none."""
    parts = [Database(np.zeros((0, 7)), np.zeros(0, np.int32), np.zeros((0, 4), np.float32),
                      np.zeros(1, np.int64)), *parts]
    ends = np.cumsum([part.first[-1] for part in parts])
    first = [parts[0].first, *(part.first[1:] + end for part, end in zip(parts[1:], ends))]
    return Database(np.concatenate([part.boxes for part in parts]),
                    np.concatenate([part.class_ids for part in parts]),
                    np.concatenate([part.points for part in parts]), np.concatenate(first))


def things_in(scene: TrainingScene, min_points: int,
              rng: np.random.Generator) -> tuple[np.ndarray, list[np.ndarray]]:
    """Boxes (K, 7) float64, from the ground up along the axes, and the points (N, 4) of each: the
    clusters of obstacles of a person's width with so many points that touch no box of the scene; at
    most MOST, drawn by rng."""
    xyz = np.ascontiguousarray(scene.points[:, :3])
    ground = segment_ground(LidarFrame(xyz), replace(
        EXPERT_GROUND, sensor_pose=SensorPoseParams(height=scene.height)))
    ids = cluster_obstacles(xyz, ground, EXPERT_CLUSTERING)
    low, high, sizes = find_extents(xyz, ids, int(ids.max(initial=0)))
    boxes = np.zeros((len(sizes), 7))
    boxes[:, :2] = (low[:, :2] + high[:, :2]) / 2
    boxes[:, 3:5] = high[:, :2] - low[:, :2]
    floor = ground_under(xyz[ground], boxes[:, :2])
    boxes[:, 5] = high[:, 2] - floor
    boxes[:, 2] = floor + boxes[:, 5] / 2
    kept = ((sizes >= min_points) & (boxes[:, 3:5].max(axis=1, initial=0) <= WIDEST)
            & (boxes[:, 5] >= HEIGHTS[0]) & (boxes[:, 5] <= HEIGHTS[1])
            & (low[:, 2] - floor <= MAX_GAP))
    kept = np.flatnonzero(kept)
    kept = kept[~bev_iou(grown(boxes[kept]), grown(scene.boxes, APART)).any(axis=1)]
    kept = rng.permutation(kept)[:MOST]
    return boxes[kept], [scene.points[ids == k + 1] for k in kept]
