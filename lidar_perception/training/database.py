"""Database of objects cut from scenes, which are pasted into other scenes (Yan 2018)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from lidar_perception.classes import CAR, CYCLIST, PEDESTRIAN
from lidar_perception.geometry import bev_iou, is_within
from lidar_perception.training.augment import BOX_MARGIN_M, TrainingScene, enlarge_boxes, rotate_scene, vary_background
from lidar_perception.training.cache import write_arrays
from lidar_perception.training.params import AugmentParams
from lidar_perception.training.pasting import estimate_floor, paste_object
from lidar_perception.types import InputError

# The ground below an object is this quantile of the heights of the points in a square around it.
FLOOR_HALF_SIZE_M, FLOOR_QUANTILE = 3.0, 0.1
MAX_STEP_M = 1.0  # maximum difference in ground height between the two scenes
BLOCKING_HEIGHTS_M = (0.63, 2.23)  # heights above the ground of points that can hide people
SECTORS = 720  # horizontal sectors of 0.5 degrees
MAX_DIRECTIONS = 64  # number of directions drawn for each object
MAX_TRIES = 3  # maximum number of objects to try for each one to paste
BACKGROUND_ID = -1  # class id of background objects, see cut_objects.py
MAX_HIDDEN_FRACTION = 0.3  # maximum number of scene points in front of an object, relative to its own points


@dataclass(frozen=True)
class Database:
    """K objects with P points in total.

    Attributes:
        boxes: (K, 7) float64.
        class_ids: (K,) int32, BACKGROUND_ID for background.
        points: (P, 4) float32; object i has points[first[i]:first[i + 1]].
        first: (K + 1,) int64, where each object starts in points.
    """

    boxes: np.ndarray
    class_ids: np.ndarray
    points: np.ndarray
    first: np.ndarray

    def __len__(self) -> int:
        return len(self.boxes)

    def get_points(self, i: int) -> np.ndarray:
        """Return the points (N, 4) of object i in the frame of its scene."""
        return self.points[self.first[i] : self.first[i + 1]]

    def save(self, path: Path) -> None:
        """Write an .npz file."""
        write_arrays(path, vars(self))

    @staticmethod
    def load(path: Path) -> Database:
        """Read a file written by save. Raise InputError if the file is not valid."""
        try:
            with np.load(path) as arrays:
                return Database(**arrays)
        except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
            raise InputError(f"cannot read the objects {path}: {error}; remove the file to recreate it") from None


def paste_objects(
    scene: TrainingScene,
    database: Database,
    params: AugmentParams,
    low: np.ndarray,
    high: np.ndarray,
    rng: np.random.Generator,
) -> TrainingScene:
    """Paste objects into a scene until it has the numbers of objects of each class in `params`.

    An object keeps its distance from the sensor and is put on the ground in a random direction
    with a free line of sight. It is not pasted if it would touch another box, be hidden or have no
    ground below it. Scene points in its box and in its shadow are dropped. At most MAX_TRIES objects
    are tried for each one to paste.

    Args:
        scene: Scene, which is not changed.
        database: Objects and background objects. Background objects get no box.
        params: Number of objects by class, and the augmentation of background.
        low, high: (2 or more,) limits of the centres of pasted objects, m.
    """
    points, boxes = scene.points, scene.boxes
    class_ids = []
    free_depths = _compute_free_depths(points, scene.height)
    for class_id, number in (
        (CAR, params.cars),
        (PEDESTRIAN, params.pedestrians),
        (CYCLIST, params.cyclists),
        (BACKGROUND_ID, params.things),
    ):
        candidates = np.flatnonzero(database.class_ids == class_id)
        missing_count = number - int((scene.class_ids == class_id).sum())
        for i in rng.permutation(candidates)[: max(MAX_TRIES * missing_count, 0)]:
            if missing_count == 0:
                break
            box, object_points = database.boxes[i], database.get_points(i)
            if class_id == BACKGROUND_ID:
                box, object_points = vary_background_box(box, object_points, params, rng)
            result = _paste(box, object_points, points, boxes, free_depths, low, high, rng)
            if result is not None:
                points, boxes = result
                class_ids.append(class_id)
                missing_count -= 1
    pasted_ids = np.array(class_ids, scene.class_ids.dtype)
    is_object = pasted_ids != BACKGROUND_ID
    return replace(
        scene,
        points=points,
        boxes=np.concatenate([scene.boxes, boxes[len(scene.boxes) :][is_object]]),
        class_ids=np.concatenate([scene.class_ids, pasted_ids[is_object]]),
        detectable=np.concatenate([scene.detectable, np.ones(is_object.sum(), bool)]),
    )


def vary_background_box(
    box: np.ndarray, points: np.ndarray, params: AugmentParams, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Vary the box (7,) and points (N, 4) of a background object, see vary_background."""
    foot = box[:3] - [0, 0, box[5] / 2]
    points, factors = vary_background(points, foot, params, rng)
    box = box.copy()
    box[3:6] *= factors
    box[2] = foot[2] + box[5] / 2
    return box, points


def _paste(
    box, object_points, points, boxes, free_depths, low, high, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the points and boxes of the scene with the object, or None if it does not fit."""
    angle = _draw_rotation(box, free_depths, low, high, rng)
    if angle is None:
        return None
    box, object_points = _rotate_about_sensor(box, object_points, angle)
    if bev_iou(enlarge_boxes(box[None]), enlarge_boxes(boxes)).any():
        return None
    step = estimate_floor(points, box, FLOOR_HALF_SIZE_M, FLOOR_QUANTILE) - (box[2] - box[5] / 2)
    if not abs(step) <= MAX_STEP_M:  # also if step is NaN: there is no ground
        return None
    box[2] += step
    object_points[:, 2] += np.float32(step)
    points = paste_object(points, object_points, box, BOX_MARGIN_M, MAX_HIDDEN_FRACTION * len(object_points))
    return (points, np.concatenate([boxes, box[None]])) if len(points) else None


def _compute_free_depths(points: np.ndarray, height: float) -> np.ndarray:
    """Return the distance (SECTORS,) in m of the nearest obstacle in each sector. Sector 0 starts at -pi."""
    heights = points[:, 2] + height
    obstacles = points[(heights > BLOCKING_HEIGHTS_M[0]) & (heights < BLOCKING_HEIGHTS_M[1])]
    x, y = obstacles[:, 0], obstacles[:, 1]
    depths = np.full(SECTORS, np.inf)
    np.minimum.at(depths, _to_sectors(np.arctan2(y, x)), np.hypot(x, y))
    return depths


def _to_sectors(angles: np.ndarray) -> np.ndarray:
    return ((angles + np.pi) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS


def _draw_rotation(
    box: np.ndarray, free_depths: np.ndarray, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> float | None:
    """Draw a rotation about the sensor (rad) after which a box (7,) is within the limits and not hidden.

    Returns None if no such rotation is drawn.
    """
    distance, radius = np.hypot(box[0], box[1]), np.hypot(box[3], box[4]) / 2
    rotations = rng.uniform(-np.pi, np.pi, MAX_DIRECTIONS)
    angles = np.arctan2(box[1], box[0]) + rotations
    centres = np.stack([distance * np.cos(angles), distance * np.sin(angles)], axis=1)
    fits = is_within(centres, low, high)
    for offset in (-radius, 0.0, radius):
        fits &= free_depths[_to_sectors(angles + offset / max(distance, radius))] > distance + radius
    return float(rotations[fits.argmax()]) if fits.any() else None


def _rotate_about_sensor(box: np.ndarray, points: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotate a box (7,) and its points (N, 4) about the sensor by an angle in rad."""
    scene = TrainingScene(points, box[None], np.zeros(1, int), np.ones(1, bool))
    scene = rotate_scene(scene, angle)
    return scene.boxes[0], scene.points
