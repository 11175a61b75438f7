"""Objects cut from scenes, to be put into others: ground-truth sampling (Yan et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from lidar_perception.classes import CAR, CYCLIST, PEDESTRIAN
from lidar_perception.geometry import bev_iou, within
from lidar_perception.training.augment import BORDER, TrainingScene, grown, turned, varied
from lidar_perception.training.cache import write_arrays
from lidar_perception.training.params import AugmentParams
from lidar_perception.training.putting import floor_under, put_among
from lidar_perception.types import InputError

NEIGHBOURHOOD = 3.0  # m: the ground under an object is looked for so far around it
GROUND_SHARE = 0.1   # of the points there lie lower
MAX_STEP = 1.0      # m: from further up or down nothing is put there
THINGS = (0.63, 2.23)  # m above the ground: what is there is no ground, and hides people
SECTORS = 720        # directions that are told apart
TRIES = 64           # of them drawn for an object
DRAWN = 3
THING = -1           # class of what is no object, see cut_objects.py
HIDDEN = 0.3         # an object is hidden if more points than this share of its own are before it


@dataclass(frozen=True)
class Database:
    """K objects with P points in all: boxes (K, 7) float64, class_ids (K,) int32, THING for what is
    none, points (P, 4) float32, those of object i from first[i] to first[i + 1]."""

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
        write_arrays(path, vars(self))

    @staticmethod
    def load(path: Path) -> Database:
        """The inverse of save. InputError for another file."""
        try:
            with np.load(path) as arrays:
                return Database(**arrays)
        except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
            raise InputError(f"cannot read the objects {path}: {error}; remove it, and it is made "
                             "again") from None


def with_objects(scene: TrainingScene, database: Database, params: AugmentParams, low: np.ndarray,
                 high: np.ndarray, rng: np.random.Generator) -> TrainingScene:
    """The scene with objects of the database until it has as many of each class as params say, or
    DRAWN times as many as it lacks were tried; and with so many things, which are no objects.

    An object comes as far from the sensor as it was in its own scene, on the ground found there, in
    a direction drawn at random from those in which its centre lies between low and high (2 or
    more,), metres, and nothing stands before it. Where it would touch another box or be hidden, or
    there is no ground, it is left out. What was in its box goes, and what is in its shadow.
    """
    points, taken = scene.points, scene.boxes
    class_ids = []
    free = _free_depths(points, scene.height)
    for class_id, number in ((CAR, params.cars), (PEDESTRIAN, params.pedestrians),
                         (CYCLIST, params.cyclists), (THING, params.things)):
        known = np.flatnonzero(database.class_ids == class_id)
        missing = number - int((scene.class_ids == class_id).sum())
        for i in rng.permutation(known)[:max(DRAWN * missing, 0)]:
            if missing == 0:
                break
            box, own = database.boxes[i], database.points_of(i)
            if class_id == THING:
                box, own = varied_thing(box, own, params, rng)
            put = _put(box, own, points, taken, free, low, high, rng)
            if put is not None:
                points, taken = put
                class_ids.append(class_id)
                missing -= 1
    new = np.array(class_ids, scene.class_ids.dtype)
    objects = new != THING
    return replace(scene, points=points,
                   boxes=np.concatenate([scene.boxes, taken[len(scene.boxes):][objects]]),
                   class_ids=np.concatenate([scene.class_ids, new[objects]]),
                   wanted=np.concatenate([scene.wanted, np.ones(objects.sum(), bool)]))


def varied_thing(box: np.ndarray, points: np.ndarray, params: AugmentParams,
                 rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A thing with its box, varied about the middle of its floor, see augment.varied."""
    floor = box[:3] - [0, 0, box[5] / 2]
    points, factors = varied(points, floor, params, rng)
    box = box.copy()
    box[3:6] *= factors
    box[2] = floor[2] + box[5] / 2
    return box, points


def _put(box, own, points, boxes, free, low, high,
         rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
    """points and boxes of the scene with one more object, or None."""
    turn = _direction(box, free, low, high, rng)
    if turn is None:
        return None
    box, own = _about_sensor(box, own, turn)
    if bev_iou(grown(box[None]), grown(boxes)).any():
        return None
    step = floor_under(points, box, NEIGHBOURHOOD, GROUND_SHARE) - (box[2] - box[5] / 2)
    if not abs(step) <= MAX_STEP:  # NaN: no ground
        return None
    box[2] += step
    own[:, 2] += np.float32(step)
    points = put_among(points, own, box, BORDER, HIDDEN * len(own))
    return (points, np.concatenate([boxes, box[None]])) if len(points) else None


def _free_depths(points: np.ndarray, height: float) -> np.ndarray:
    """(SECTORS,) m: how far one sees, about, in each direction from -pi on, before something
    stands there."""
    above = points[:, 2] + height
    things = points[(above > THINGS[0]) & (above < THINGS[1])]
    free = np.full(SECTORS, np.inf)
    np.minimum.at(free, _sectors(np.arctan2(things[:, 1], things[:, 0])),
                  np.hypot(things[:, 0], things[:, 1]))
    return free


def _sectors(angles: np.ndarray) -> np.ndarray:
    return ((angles + np.pi) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS


def _direction(box: np.ndarray, free: np.ndarray, low: np.ndarray, high: np.ndarray,
               rng: np.random.Generator) -> float | None:
    """An angle about the sensor by which a box (7,) comes between low and high, and into sight."""
    at, half = np.hypot(box[0], box[1]), np.hypot(box[3], box[4]) / 2
    turns = rng.uniform(-np.pi, np.pi, TRIES)
    angles = np.arctan2(box[1], box[0]) + turns
    centres = np.stack([at * np.cos(angles), at * np.sin(angles)], axis=1)
    fits = within(centres, low, high)
    for aside in (-half, 0.0, half):
        fits &= free[_sectors(angles + aside / max(at, half))] > at + half
    return float(turns[fits.argmax()]) if fits.any() else None


def _about_sensor(box: np.ndarray, points: np.ndarray,
                  angle: float) -> tuple[np.ndarray, np.ndarray]:
    """A box and its points (N, 4), turned about the sensor."""
    alone = TrainingScene(points, box[None], np.zeros(1, int), np.ones(1, bool))
    alone = turned(alone, angle)
    return alone.boxes[0], alone.points
