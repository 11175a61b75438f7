"""Objects cut from scenes, to be put into others: ground-truth sampling (Yan et al. 2018)."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numba import njit

from lidar_perception.files import write_bytes
from lidar_perception.geometry import points_in_box
from lidar_perception.rotated_iou import bev_iou
from lidar_perception.training.augment import BORDER, Scene, grown, turned
from lidar_perception.training.params import AugmentParams
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError

NEIGHBOURHOOD = 3.0  # m: the ground under an object is looked for so far around it
GROUND_SHARE = 0.1   # of the points there lie lower
MOST_STEP = 1.0      # m: from further up or down nothing is put there
THINGS = (-1.1, 0.5)  # m from the sensor's height up: what is there is no ground, and hides people
SECTORS = 720        # directions that are told apart
TRIES = 64           # of them drawn for an object
DRAWN = 3
CAR, CYCLIST = CLASSES.index("Car"), CLASSES.index("Cyclist")
HIDDEN = 0.3         # an object is hidden if more points than this share of its own are before it
TOUCH = 1e-3         # m: nothing is nearer to the sensor


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


def with_objects(scene: Scene, database: Database, params: AugmentParams, low: np.ndarray,
                 high: np.ndarray, rng: np.random.Generator) -> Scene:
    """The scene with objects of the database until it has as many of each class as params say, or
    DRAWN times as many as it lacks were tried.

    An object comes as far from the sensor as it was in its own scene, on the ground found there, in
    a direction drawn at random from those in which its centre lies between low and high (2 or
    more,), metres, and nothing stands before it. Where it would touch another box or be hidden, or
    there is no ground, it is left out. What was in its box goes, and what is in its shadow.
    """
    points, boxes, new = scene.points, scene.boxes, []
    free = _free_depths(points)
    for kind, number in ((CAR, params.cars), (PEDESTRIAN, params.pedestrians),
                         (CYCLIST, params.cyclists)):
        known = np.flatnonzero(database.class_ids == kind)
        missing = number - int((scene.class_ids == kind).sum())
        for i in rng.permutation(known)[:max(DRAWN * missing, 0)]:
            if missing == 0:
                break
            put = _put(database.boxes[i], database.points_of(i), points, boxes, free, low, high,
                       rng)
            if put is not None:
                points, boxes = put
                new.append(i)
                missing -= 1
    return replace(scene, points=points, boxes=boxes,
                   class_ids=np.concatenate([scene.class_ids, database.class_ids[new]]),
                   wanted=np.concatenate([scene.wanted, np.ones(len(new), bool)]))


def _put(box, own, points, boxes, free, low, high,
         rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
    """points and boxes of the scene with one more object, or None."""
    turn = _direction(box, free, low, high, rng)
    if turn is None:
        return None
    box, own = _about_sensor(box, own, turn)
    if bev_iou(grown(box[None]), grown(boxes)).any():
        return None
    step = _ground_under(points, box) - (box[2] - box[5] / 2)
    if not abs(step) <= MOST_STEP:  # NaN: no ground
        return None
    box[2] += step
    own[:, 2] += np.float32(step)
    before, behind = _around(points, own, float(np.arctan2(box[1], box[0])))
    if before > HIDDEN * len(own):
        return None
    left = np.flatnonzero(~(behind | points_in_box(points, box, BORDER)))
    return np.concatenate([points.take(left, axis=0), own]), np.concatenate([boxes, box[None]])


def _free_depths(points: np.ndarray) -> np.ndarray:
    """(SECTORS,) m: how far one sees, about, in each direction from -pi on, before something
    stands there."""
    things = points[(points[:, 2] > THINGS[0]) & (points[:, 2] < THINGS[1])]
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
    fits = ((centres >= low[:2]) & (centres < high[:2])).all(axis=1)
    for aside in (-half, 0.0, half):
        fits &= free[_sectors(angles + aside / max(at, half))] > at + half
    return float(turns[fits.argmax()]) if fits.any() else None


def _about_sensor(box: np.ndarray, points: np.ndarray,
                  angle: float) -> tuple[np.ndarray, np.ndarray]:
    """A box and its points (N, 4), turned about the sensor."""
    alone = Scene(points, box[None], np.zeros(1, int), np.ones(1, bool))
    alone = turned(alone, angle)
    return alone.boxes[0], alone.points


@njit(cache=True, nogil=True)
def _around(points, own, bearing):
    """How many points (N, 4) the sensor sees before those of an object (K, 4), which is in this
    direction, and (N,) bool, which behind them."""
    cos, sin = np.cos(bearing), np.sin(bearing)
    least, most = np.full(3, np.inf), np.full(3, -np.inf)  # depth, tangents to the side and upwards
    for i in range(len(own)):
        depth = max(cos * own[i, 0] + sin * own[i, 1], TOUCH)
        for k, value in enumerate((depth, (cos * own[i, 1] - sin * own[i, 0]) / depth,
                                   own[i, 2] / depth)):
            least[k], most[k] = min(least[k], value), max(most[k], value)
    before, behind = 0, np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        depth = cos * points[i, 0] + sin * points[i, 1]
        if depth <= 0.0 or least[0] <= depth <= most[0]:
            continue
        aside = cos * points[i, 1] - sin * points[i, 0]
        if (least[1] * depth <= aside <= most[1] * depth
                and least[2] * depth <= points[i, 2] <= most[2] * depth):
            if depth < least[0]:
                before += 1
            else:
                behind[i] = True
    return before, behind


@njit(cache=True, nogil=True)
def _ground_under(points, box):
    """Height of the ground around a box, NaN where there are no points."""
    heights, count = np.empty(len(points), points.dtype), 0
    for i in range(len(points)):
        if (abs(points[i, 0] - box[0]) <= NEIGHBOURHOOD
                and abs(points[i, 1] - box[1]) <= NEIGHBOURHOOD):
            heights[count] = points[i, 2]
            count += 1
    if count < 5:
        return np.nan
    return np.sort(heights[:count])[int(GROUND_SHARE * count)]
