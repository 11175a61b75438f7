"""Augmentation of labelled scenes.

All functions are pure and take the random generator as an argument. Points in a box stay in it,
except for noise and slopes. A scene is in the frame of a level sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.geometry import bev_iou, elevation_angles, is_within, to_box_frame, wrap_angle
from lidar_perception.training.params import AugmentParams, BackgroundParams, IntensityParams, NoiseParams
from lidar_perception.training.pasting import MIN_RANGE_M, find_points_in_box
from lidar_perception.types import SENSOR_HEIGHT

BEAM_STEP = np.radians(0.4)  # spacing of the beams in elevation
REFLECTOR_INTENSITY = 0.99
FADE_RANGE_M = 15.0  # range at which the fading of the intensity has no effect
BOX_MARGIN_M = 0.01  # points within this margin belong to a box, since labels are rounded


@dataclass(frozen=True)
class TrainingScene:
    """A labelled scene.

    Attributes:
        points: (N, 4) float32, x y z intensity.
        boxes: (M, 7) float64, x y z l w h yaw.
        class_ids: (M,) int into CLASSES.
        detectable: (M,) bool, False for objects that are too hidden to be detected.
        all_around: True if objects in all directions are labelled, not only those ahead.
        height: Height of the sensor above the ground in metres.
    """

    points: np.ndarray
    boxes: np.ndarray
    class_ids: np.ndarray
    detectable: np.ndarray
    all_around: bool = False
    height: float = SENSOR_HEIGHT


def augment_scene(scene: TrainingScene, params: AugmentParams, rng: np.random.Generator) -> TrainingScene:
    """Apply all random changes except those of rotate_and_crop and database.paste_objects."""
    scene = move_objects(scene, params.object_turn, params.object_shift, rng)
    if rng.random() < params.flip:
        scene = flip_scene(scene)
    scene = replace(scene, points=add_range_noise(scene.points, params, rng))
    scene = scale_scene(scene, 1 + rng.uniform(-params.scale, params.scale))
    scene = drop_points(scene, rng.uniform(0, params.dropout), rng)
    scene = change_intensity(
        scene,
        1 + rng.uniform(-params.intensity, params.intensity),
        rng.uniform(-params.intensity, params.intensity) / 2,
    )
    scene = replace(scene, points=distort_intensity(scene.points, params, rng))
    return raise_scene(scene, rng.uniform(-params.height, params.height), rng.uniform(-params.tilt, params.tilt, 2))


def rotate_and_crop(
    scene: TrainingScene, params: AugmentParams, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> TrainingScene:
    """Rotate the scene at random, and crop it to the region between low and high (3,) in m.

    The crop leaves a margin for the other changes. This step runs first, because it removes most
    points.
    """
    max_angle = np.pi if scene.all_around and params.turn else params.turn
    scene = rotate_scene(scene, rng.uniform(-max_angle, max_angle))
    margin = 1 + params.height + params.scale / (1 - params.scale) * np.abs([low, high])
    margin[:, 2] += 2 * params.tilt * np.abs([low[:2], high[:2]]).max()
    return crop_scene(scene, low - margin[0], high + margin[1])


def crop_scene(scene: TrainingScene, low: np.ndarray, high: np.ndarray) -> TrainingScene:
    """Keep the points between low and high (3,) in m, and the boxes whose centre is between them in x and y."""
    point_mask = np.ones(len(scene.points), bool)
    for axis in range(3):
        point_mask &= (scene.points[:, axis] >= low[axis]) & (scene.points[:, axis] < high[axis])
    box_mask = is_within(scene.boxes, low, high)
    return replace(
        scene,
        points=scene.points[point_mask],
        boxes=scene.boxes[box_mask],
        class_ids=scene.class_ids[box_mask],
        detectable=scene.detectable[box_mask],
    )


def flip_scene(scene: TrainingScene) -> TrainingScene:
    """Swap left and right."""
    points = scene.points * np.array([1, -1, 1, 1], np.float32)
    boxes = scene.boxes * [1, -1, 1, 1, 1, 1, -1]
    return replace(scene, points=points, boxes=boxes)


def rotate_scene(scene: TrainingScene, angle: float) -> TrainingScene:
    """Rotate the scene counter-clockwise about the sensor by an angle in rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.array([[cos, sin], [-sin, cos]])
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, :2] = scene.points[:, :2] @ matrix.astype(np.float32)
    boxes[:, :2] = scene.boxes[:, :2] @ matrix
    boxes[:, 6] = wrap_angle(boxes[:, 6] + angle)
    return replace(scene, points=points, boxes=boxes)


def scale_scene(scene: TrainingScene, factor: float) -> TrainingScene:
    """Multiply all coordinates and sizes by factor."""
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, :3] *= np.float32(factor)
    boxes[:, :6] *= factor
    return replace(scene, points=points, boxes=boxes)


def drop_points(scene: TrainingScene, fraction: float, rng: np.random.Generator) -> TrainingScene:
    """Drop a random fraction of the points."""
    return replace(scene, points=scene.points[rng.random(len(scene.points)) >= fraction])


def change_intensity(scene: TrainingScene, factor: float, offset: float) -> TrainingScene:
    """Multiply intensities by factor and add offset, clipped to 0 .. 1; an intensity of 0 stays 0."""
    points = scene.points.copy()
    positive = points[:, 3] > 0
    points[positive, 3] = np.clip(points[positive, 3] * factor + offset, 0, 1)
    return replace(scene, points=points)


def distort_intensity(points: np.ndarray, params: IntensityParams, rng: np.random.Generator) -> np.ndarray:
    """Change the intensities of points (N, 4) as if another sensor had measured them, or set all to 0.

    An intensity of 0 stays 0. Gain and gamma are not changed, because normalize_intensity removes
    them.
    """
    points = points.copy()
    if rng.random() < params.no_intensity:
        points[:, 3] = 0
        return points
    exponent = rng.uniform(-params.fade, params.fade)
    speckle = rng.uniform(0, params.speckle)
    levels = np.exp(rng.uniform(np.log(max(params.quantize, 1)), np.log(255)))
    positive = np.flatnonzero(points[:, 3] > 0)
    ranges = np.linalg.norm(points[positive, :3], axis=1) / FADE_RANGE_M
    intensity = points[positive, 3] * np.maximum(ranges, 0.1) ** exponent
    intensity += rng.normal(0, speckle, len(positive))
    if params.quantize:
        intensity = np.round(intensity * levels) / levels
    points[positive, 3] = np.maximum(intensity, 0)
    return points


def add_reflector(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Make the points (N, 4), N >= 1, of an object retroreflective between two random heights."""
    points = points.copy()
    height = points[:, 2]
    low, high = np.sort(rng.uniform(height.min(), height.max(), 2))
    points[(height >= low) & (height <= high), 3] = REFLECTOR_INTENSITY
    return points


def vary_background(
    points: np.ndarray, foot: np.ndarray, params: BackgroundParams, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Stretch a background object about its foot and change its intensity, at random.

    Args:
        points: (N, 4) points of the object, N >= 1.
        foot: (3,) point on the ground that does not move.

    Returns:
        (N, 4) changed points, and the factors (3,) of the sizes, equal along x and y.
    """
    width_factor, height_factor = np.exp(rng.uniform(-params.things_stretch, params.things_stretch, 2))
    factors = np.array([width_factor, width_factor, height_factor])
    points = points.copy()
    points[:, :3] = (points[:, :3] - foot) * factors + foot
    gain = np.exp(rng.uniform(-params.things_intensity, params.things_intensity))
    points[:, 3] = np.clip(points[:, 3] * gain, 0, 1)
    if rng.random() < params.things_shine:
        points = add_reflector(points, rng)
    return points, factors


def add_range_noise(points: np.ndarray, params: NoiseParams, rng: np.random.Generator) -> np.ndarray:
    """Add range noise with random standard deviations to points (N, 4), see blur_ranges."""
    return blur_ranges(points, rng.uniform(0, params.beam_noise), rng.uniform(0, params.range_noise), rng)


def blur_ranges(points: np.ndarray, beam: float, point: float, rng: np.random.Generator) -> np.ndarray:
    """Add range noise to points (N, 4): an error for each beam and one for each point.

    The beams of real sensors have different range biases: on a pole in KITTI, points scatter by
    0.07 to 0.1 m in depth, and the means of the beams by 0.035 to 0.07 m.

    Args:
        points: (N, 4).
        beam: Standard deviation of the error of a beam (the points of one elevation), m.
        point: Standard deviation of the error of a point, m.
    """
    ranges = np.maximum(np.linalg.norm(points[:, :3], axis=1), MIN_RANGE_M)
    beams = np.floor(elevation_angles(points) / BEAM_STEP).astype(np.int64)
    first = beams.min(initial=0)
    offsets = rng.normal(0, beam, int(beams.max(initial=0) - first) + 1)
    shift = offsets[beams - first] + rng.normal(0, point, len(points))
    points = points.copy()
    points[:, :3] *= (1 + shift / ranges)[:, None]
    return points


def raise_scene(scene: TrainingScene, height: float, slopes: ArrayLike = (0.0, 0.0)) -> TrainingScene:
    """Raise the scene, as if the sensor were lower, and tilt the ground.

    Boxes stay upright, so points may leave their box if the slopes are not 0.

    Args:
        scene: Scene, which is not changed.
        height: Shift along z, m.
        slopes: (2,) slopes of the ground along x and y, m/m.
    """
    points, boxes = scene.points.copy(), scene.boxes.copy()
    points[:, 2] += (height + scene.points[:, :2] @ np.asarray(slopes)).astype(np.float32)
    boxes[:, 2] += height + scene.boxes[:, :2] @ np.asarray(slopes)
    return replace(scene, points=points, boxes=boxes)


def move_objects(scene: TrainingScene, max_angle: float, shift: float, rng: np.random.Generator) -> TrainingScene:
    """Rotate and shift each object with its points at random, unless it touches another box before or after.

    Args:
        scene: Scene, which is not changed.
        max_angle: Maximum rotation about the object's centre, rad.
        shift: Standard deviation of the shift along x and along y, m.
    """
    points, boxes = scene.points.copy(), scene.boxes.copy()
    if not (max_angle or shift):
        return scene
    angles = rng.uniform(-max_angle, max_angle, len(boxes))
    shifts = rng.normal(0, shift, (len(boxes), 2)) if shift else np.zeros((len(boxes), 2))
    for i in range(len(boxes)):
        other_boxes = np.delete(enlarge_boxes(boxes), i, axis=0)
        goal = boxes[i].copy()
        goal[:2] += shifts[i]
        goal[6] = wrap_angle(goal[6] + angles[i])
        if bev_iou(enlarge_boxes(np.stack([boxes[i], goal])), other_boxes).any():
            continue
        indices = find_points_in_box(points, boxes[i], BOX_MARGIN_M)
        points[indices, :3] = move_with_box(points[indices, :3], boxes[i], goal)
        boxes[i] = goal
    return replace(scene, points=points, boxes=boxes)


def move_with_box(xyz: np.ndarray, box: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Move the points (N, 3) of a box (7,) to the pose of another box, goal (7,). Return float32."""
    relative = to_box_frame(xyz.astype(np.float64), box)
    rotation = np.array([0.0, 0, 0, 0, 0, 0, -goal[6]])  # box at the origin that is rotated by -yaw
    return (to_box_frame(relative, rotation) + goal[:3]).astype(np.float32)


def enlarge_boxes(boxes: np.ndarray, margin: float = BOX_MARGIN_M) -> np.ndarray:
    """Add a margin in metres to all sides of boxes (M, 7)."""
    return boxes + [0, 0, 0, 2 * margin, 2 * margin, 2 * margin, 0]
