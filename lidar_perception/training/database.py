"""Objects cut from scenes, to be put into others: ground-truth sampling (Yan et al. 2018)."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from lidar_perception.files import write_bytes
from lidar_perception.geometry import points_in_box
from lidar_perception.rotated_iou import bev_iou
from lidar_perception.training.augment import BORDER, Scene, grown
from lidar_perception.training.params import AugmentParams
from lidar_perception.types import CLASSES, InputError

NEIGHBOURHOOD = 3.0  # m: the ground under an object is looked for so far around it
GROUND_SHARE = 0.1   # of the points there lie lower
MOST_STEP = 1.0      # m: from further up or down nothing is put there


@dataclass(frozen=True)
class Database:
    """K objects with P points in all: boxes (K, 7) float64, class_ids (K,) int32, points (P, 4)
    float32, those of object i from first[i] to first[i + 1]."""

    boxes: np.ndarray
    class_ids: np.ndarray
    points: np.ndarray
    first: np.ndarray

    def __len__(self) -> int:
        return len(self.boxes)

    def points_of(self, i: int) -> np.ndarray:
        """(N, 4) points of an object, in the frame of its own scene."""
        return self.points[self.first[i]:self.first[i + 1]]

    def save(self, path: Path) -> None:
        """Write an .npz file."""
        content = io.BytesIO()
        np.savez(content, **vars(self))
        write_bytes(path, content.getbuffer())

    @staticmethod
    def load(path: Path) -> Database:
        """The inverse of save. InputError for another file."""
        try:
            with np.load(path) as arrays:
                return Database(**arrays)
        except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
            raise InputError(f"cannot read the objects {path}: {error}; remove it, and it is made "
                             "again") from None


def cut_objects(scenes: Iterable[Scene], classes: tuple[str, ...], least_points: int) -> Database:
    """The wanted objects of some classes that have enough points; where boxes overlap, none."""
    chosen = [CLASSES.index(name) for name in classes]
    boxes, class_ids, points = [np.zeros((0, 7))], [], [np.zeros((0, 4), np.float32)]
    sizes = []
    for scene in scenes:
        overlap = bev_iou(scene.boxes, scene.boxes) > 0
        alone = overlap.sum(axis=1) <= 1
        for i in np.flatnonzero(scene.wanted & alone & np.isin(scene.class_ids, chosen)):
            own = scene.points[points_in_box(scene.points[:, :3], scene.boxes[i])]
            if len(own) >= least_points:
                boxes.append(scene.boxes[i:i + 1])
                class_ids.append(scene.class_ids[i])
                points.append(own)
                sizes.append(len(own))
    return Database(np.concatenate(boxes), np.array(class_ids, np.int32), np.concatenate(points),
                    np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64))


def with_objects(scene: Scene, database: Database, params: AugmentParams,
                 rng: np.random.Generator) -> Scene:
    """The scene with objects of the database until it has as many of each class as params say.

    An object comes to the place where it was in its own scene, on the ground found there; where it
    would touch another box, or there is no ground, it is left out. What was in its box goes.
    """
    drawn = []
    for name, number in (("Car", params.cars), ("Pedestrian", params.pedestrians),
                         ("Cyclist", params.cyclists)):
        kind = CLASSES.index(name)
        known = np.flatnonzero(database.class_ids == kind)
        missing = min(number - int((scene.class_ids == kind).sum()), len(known))
        if missing > 0:
            drawn += rng.choice(known, missing, replace=False).tolist()
    boxes, added, new = scene.boxes, [], []
    for i in drawn:
        box = database.boxes[i]
        if bev_iou(grown(box[None]), grown(boxes)).any():
            continue
        step = _ground_under(scene.points, box) - (box[2] - box[5] / 2)
        if not abs(step) <= MOST_STEP:  # NaN: no ground
            continue
        box = box + [0, 0, step, 0, 0, 0, 0]
        boxes = np.concatenate([boxes, box[None]])
        added.append(database.points_of(i) + np.array([0, 0, step, 0], np.float32))
        new.append(i)
    if not new:
        return scene
    inside = np.zeros(len(scene.points), bool)
    for box in boxes[len(scene.boxes):]:
        inside |= points_in_box(scene.points[:, :3], box, BORDER)
    return replace(scene, points=np.concatenate([scene.points[~inside], *added]), boxes=boxes,
                   class_ids=np.concatenate([scene.class_ids, database.class_ids[new]]),
                   wanted=np.concatenate([scene.wanted, np.ones(len(new), bool)]))


def _ground_under(points: np.ndarray, box: np.ndarray) -> float:
    """Height of the ground around a box, NaN where there are no points."""
    near = ((np.abs(points[:, 0] - box[0]) <= NEIGHBOURHOOD)
            & (np.abs(points[:, 1] - box[1]) <= NEIGHBOURHOOD))
    heights = points[near, 2]
    return float(np.quantile(heights, GROUND_SHARE)) if len(heights) >= 5 else np.nan
