"""Changes of labelled scenes that a detector should not mind; pure, with the rng given.

Points in a box stay in it. A scene is a cloud with its boxes, in the frame of a level sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar_perception.geometry import points_in_box, to_box_frame, wrap_angle
from lidar_perception.rotated_iou import bev_iou
from lidar_perception.training.params import AugmentParams

BORDER = 0.01  # m: points so near to a box are taken for its own, as labels are rounded


@dataclass(frozen=True)
class Scene:
    """points (N, 4) float32 [x y z intensity]; boxes (M, 7) float64 [x y z l w h yaw], class_ids
    (M,) int into CLASSES. wanted (M,) bool: not so hidden that nobody would label it. around: the
    labels are all around, not ahead only."""

    points: np.ndarray
    boxes: np.ndarray
    class_ids: np.ndarray
    wanted: np.ndarray
    around: bool = False


def augmented(scene: Scene, params: AugmentParams, rng: np.random.Generator) -> Scene:
    """All changes but the objects of other scenes, see database.with_objects."""
    scene = with_moved_objects(scene, params.object_turn, params.object_shift, rng)
    if rng.random() < params.flip:
        scene = flipped(scene)
    turn = np.pi if scene.around and params.turn else params.turn
    scene = turned(scene, rng.uniform(-turn, turn))
    scene = scaled(scene, 1 + rng.uniform(-params.scale, params.scale))
    scene = thinned(scene, rng.uniform(0, params.dropout), rng)
    scene = brightened(scene, 1 + rng.uniform(-params.intensity, params.intensity),
                       rng.uniform(-params.intensity, params.intensity) / 2)
    return raised(scene, rng.uniform(-params.height, params.height))


def flipped(scene: Scene) -> Scene:
    """Left and right swapped."""
    points = scene.points * np.array([1, -1, 1, 1], np.float32)
    boxes = scene.boxes * [1, -1, 1, 1, 1, 1, -1]
    return replace(scene, points=points, boxes=boxes)


def turned(scene: Scene, angle: float) -> Scene:
    """Turned about the sensor, counter-clockwise."""
    back = np.array([0.0, 0, 0, 0, 0, 0, -angle])  # into the frame of a sensor turned the other way
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, :3] = to_box_frame(scene.points.astype(np.float64), back)
    boxes[:, :3] = to_box_frame(scene.boxes, back)
    boxes[:, 6] = wrap_angle(boxes[:, 6] + angle)
    return replace(scene, points=points, boxes=boxes)


def scaled(scene: Scene, factor: float) -> Scene:
    """Every length times factor."""
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, :3] *= np.float32(factor)
    boxes[:, :6] *= factor
    return replace(scene, points=points, boxes=boxes)


def thinned(scene: Scene, share: float, rng: np.random.Generator) -> Scene:
    """About this share of the points left out."""
    return replace(scene, points=scene.points[rng.random(len(scene.points)) >= share])


def brightened(scene: Scene, factor: float, offset: float) -> Scene:
    """Intensities times factor, plus offset, within 0 .. 1."""
    points = scene.points.copy()
    points[:, 3] = np.clip(points[:, 3] * factor + offset, 0, 1)
    return replace(scene, points=points)


def raised(scene: Scene, height: float) -> Scene:
    """As from a sensor mounted lower by height, metres."""
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, 2] += np.float32(height)
    boxes[:, 2] += height
    return replace(scene, points=points, boxes=boxes)


def with_moved_objects(scene: Scene, turn: float, shift: float, rng: np.random.Generator) -> Scene:
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
        inside = np.flatnonzero(points_in_box(points[:, :3], boxes[i], BORDER))
        points[inside, :3] = carried(points[inside, :3], boxes[i], goal)
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
