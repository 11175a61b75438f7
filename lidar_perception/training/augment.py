"""Changes of labelled scenes that a detector should not mind; pure, with the rng given.

But for noise and slopes, points in a box stay in it. A scene is a cloud with its boxes, in the
frame of a level sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.geometry import bev_iou, elevations, to_box_frame, within, wrap_angle
from lidar_perception.training.params import AugmentParams, NoiseParams, ThingParams
from lidar_perception.training.putting import TOUCH, inside
from lidar_perception.types import SENSOR_HEIGHT

STEP = np.radians(0.4)  # of elevation between two beams
SHINING = 0.99  # intensity of a reflector
BORDER = 0.01  # m: points so near to a box are taken for its own, as labels are rounded


@dataclass(frozen=True)
class TrainingScene:
    """points (N, 4) float32 [x y z intensity]; boxes (M, 7) float64 [x y z l w h yaw], class_ids
    (M,) int into CLASSES. wanted (M,) bool: not so hidden that nobody would label it. around: the
    labels are all around, not ahead only. height: of the sensor above the ground, metres."""

    points: np.ndarray
    boxes: np.ndarray
    class_ids: np.ndarray
    wanted: np.ndarray
    around: bool = False
    height: float = SENSOR_HEIGHT


def augmented(scene: TrainingScene, params: AugmentParams,
              rng: np.random.Generator) -> TrainingScene:
    """All changes but the turn and the objects of other scenes, see database.with_objects."""
    scene = with_moved_objects(scene, params.object_turn, params.object_shift, rng)
    if rng.random() < params.flip:
        scene = flipped(scene)
    scene = replace(scene, points=noisy(scene.points, params, rng))
    scene = scaled(scene, 1 + rng.uniform(-params.scale, params.scale))
    scene = thinned(scene, rng.uniform(0, params.dropout), rng)
    scene = brightened(scene, 1 + rng.uniform(-params.intensity, params.intensity),
                       rng.uniform(-params.intensity, params.intensity) / 2)
    return raised(scene, rng.uniform(-params.height, params.height),
                  rng.uniform(-params.tilt, params.tilt, 2))


def faced(scene: TrainingScene, params: AugmentParams, low: np.ndarray, high: np.ndarray,
          rng: np.random.Generator) -> TrainingScene:
    """The scene turned, and what can come between low and high (3,) by all other changes, metres:
    first, since most of a scan lies elsewhere."""
    turn = np.pi if scene.around and params.turn else params.turn
    scene = turned(scene, rng.uniform(-turn, turn))
    margin = 1 + params.height + params.scale / (1 - params.scale) * np.abs([low, high])
    margin[:, 2] += 2 * params.tilt * np.abs([low[:2], high[:2]]).max()
    return cropped(scene, low - margin[0], high + margin[1])


def cropped(scene: TrainingScene, low: np.ndarray, high: np.ndarray) -> TrainingScene:
    """The points between low and high (3,), and the boxes whose centre is, seen from above."""
    kept = np.ones(len(scene.points), bool)
    for axis in range(3):
        kept &= (scene.points[:, axis] >= low[axis]) & (scene.points[:, axis] < high[axis])
    here = within(scene.boxes, low, high)
    return replace(scene, points=scene.points[kept], boxes=scene.boxes[here],
                   class_ids=scene.class_ids[here], wanted=scene.wanted[here])


def flipped(scene: TrainingScene) -> TrainingScene:
    """Left and right swapped."""
    points = scene.points * np.array([1, -1, 1, 1], np.float32)
    boxes = scene.boxes * [1, -1, 1, 1, 1, 1, -1]
    return replace(scene, points=points, boxes=boxes)


def turned(scene: TrainingScene, angle: float) -> TrainingScene:
    """Turned about the sensor, counter-clockwise."""
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.array([[cos, sin], [-sin, cos]])
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, :2] = scene.points[:, :2] @ matrix.astype(np.float32)
    boxes[:, :2] = scene.boxes[:, :2] @ matrix
    boxes[:, 6] = wrap_angle(boxes[:, 6] + angle)
    return replace(scene, points=points, boxes=boxes)


def scaled(scene: TrainingScene, factor: float) -> TrainingScene:
    """Every length times factor."""
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, :3] *= np.float32(factor)
    boxes[:, :6] *= factor
    return replace(scene, points=points, boxes=boxes)


def thinned(scene: TrainingScene, share: float, rng: np.random.Generator) -> TrainingScene:
    """About this share of the points left out."""
    return replace(scene, points=scene.points[rng.random(len(scene.points)) >= share])


def brightened(scene: TrainingScene, factor: float, offset: float) -> TrainingScene:
    """Intensities times factor, plus offset, within 0 .. 1. Those of 0 stay: that is what sensors
    report of the weakest returns, however bright the others are."""
    points = scene.points.copy()
    read = points[:, 3] > 0
    points[read, 3] = np.clip(points[read, 3] * factor + offset, 0, 1)
    return replace(scene, points=points)


def with_reflector(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 4) of one thing, N at least 1, of which those between two heights shine."""
    points = points.copy()
    height = points[:, 2]
    low, high = np.sort(rng.uniform(height.min(), height.max(), 2))
    points[(height >= low) & (height <= high), 3] = SHINING
    return points


def varied(points: np.ndarray, foot: np.ndarray, params: ThingParams,
           rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 4) of one thing, N at least 1, that is wider, higher and brighter, or less so, and
    the factors (3,) of its lengths about its foot (3,): up to exp(things_stretch) or its inverse,
    the same along x and y; intensities likewise by things_intensity. With the chance things_shine
    it shines between two heights."""
    wide, high = np.exp(rng.uniform(-params.things_stretch, params.things_stretch, 2))
    factors = np.array([wide, wide, high])
    points = points.copy()
    points[:, :3] = (points[:, :3] - foot) * factors + foot
    factor = np.exp(rng.uniform(-params.things_intensity, params.things_intensity))
    points[:, 3] = np.clip(points[:, 3] * factor, 0, 1)
    if rng.random() < params.things_shine:
        points = with_reflector(points, rng)
    return points, factors


def noisy(points: np.ndarray, params: NoiseParams, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 4) blurred by up to what params say."""
    return blurred(points, rng.uniform(0, params.beam_noise), rng.uniform(0, params.range_noise),
                   rng)


def blurred(points: np.ndarray, beam: float, point: float, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 4) nearer or farther along their rays, metres: by what all points of an elevation,
    to STEP, have in common, and by something of its own; standard deviations.

    Real beams do not agree: on KITTI the points of one pole scatter by 0.07 to 0.1 m in depth, the
    means of its beams by 0.035 to 0.07; a pole that was simulated is as thin as it is.
    """
    ranges = np.maximum(np.linalg.norm(points[:, :3], axis=1), TOUCH)
    beams = np.floor(elevations(points) / STEP).astype(np.int64)
    first = beams.min(initial=0)
    offsets = rng.normal(0, beam, int(beams.max(initial=0) - first) + 1)
    shift = offsets[beams - first] + rng.normal(0, point, len(points))
    moved = points.copy()
    moved[:, :3] *= (1 + shift / ranges)[:, None]
    return moved


def raised(scene: TrainingScene, height: float,
           slopes: ArrayLike = (0.0, 0.0)) -> TrainingScene:
    """As from a sensor mounted lower by height, metres, on ground that rises by slopes, along x and
    y (2,). Boxes stay upright, so that points in a box stay in it if the slopes are 0."""
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, 2] += (height + scene.points[:, :2] @ np.asarray(slopes)).astype(np.float32)
    boxes[:, 2] += height + scene.boxes[:, :2] @ np.asarray(slopes)
    return replace(scene, points=points, boxes=boxes)


def with_moved_objects(scene: TrainingScene, turn: float, shift: float,
                       rng: np.random.Generator) -> TrainingScene:
    """Each object, with its points, turned about its middle by up to `turn` and shifted along x and
    y by about `shift`; not where it would touch another one, nor if it touches one already."""
    points, boxes = scene.points.copy(), scene.boxes.copy()
    if not (turn or shift):
        return scene
    angles = rng.uniform(-turn, turn, len(boxes))
    ways = rng.normal(0, shift, (len(boxes), 2)) if shift else np.zeros((len(boxes), 2))
    for i in range(len(boxes)):
        others = np.delete(grown(boxes), i, axis=0)
        goal = boxes[i].copy()
        goal[:2] += ways[i]
        goal[6] = wrap_angle(goal[6] + angles[i])
        if bev_iou(grown(np.stack([boxes[i], goal])), others).any():
            continue
        own = inside(points, boxes[i], BORDER)
        points[own, :3] = carried(points[own, :3], boxes[i], goal)
        boxes[i] = goal
    return replace(scene, points=points, boxes=boxes)


def carried(xyz: np.ndarray, box: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Points (N, 3) that move with a box (7,) to another place and heading; float32."""
    relative = to_box_frame(xyz.astype(np.float64), box)
    about = np.array([0.0, 0, 0, 0, 0, 0, -goal[6]])
    return (to_box_frame(relative, about) + goal[:3]).astype(np.float32)


def grown(boxes: np.ndarray, margin: float = BORDER) -> np.ndarray:
    """Boxes (M, 7) with a margin on every side."""
    return boxes + [0, 0, 0, 2 * margin, 2 * margin, 2 * margin, 0]
