"""A drive past a person, a post, a car and a walker, and what a perfect detector says of it."""

from __future__ import annotations

import numpy as np
from tracking_samples import CAR, CYCLIST, START, TENTH, pose

from lidar_perception.adapting.looking import SOURCES, FrameLook, seen_in
from lidar_perception.robot.poses import inverse, moved_boxes
from lidar_perception.types import PEDESTRIAN, Detections

FRAMES = 16
PERSON, POST, PARKED, WALKER, RIDER = range(5)
KINDS = np.array([PEDESTRIAN, PEDESTRIAN, CAR, PEDESTRIAN, CYCLIST])
FLOOR = -1.73


def boxes_at(t: float) -> np.ndarray:
    """(5, 7) in the fixed frame, t seconds after the first frame."""
    return np.array([[14.0, 4.0, FLOOR + 0.87, 0.7, 0.6, 1.74, 0.3],
                     [15.0, -4.0, FLOOR + 0.87, 0.7, 0.6, 1.74, 0.0],
                     [20.0, 7.0, FLOOR + 0.75, 4.0, 1.7, 1.5, 0.1],
                     [12.0 + 1.4 * t, -7.0, FLOOR + 0.87, 0.7, 0.6, 1.74, 0.0],
                     [25.0 - 4.0 * t, 2.5, FLOOR + 0.87, 1.8, 0.6, 1.74, np.pi]])


def points_in(box: np.ndarray, rng: np.random.Generator, higher: float = 0.0) -> np.ndarray:
    """(200, 3) all over a box, or one that ends so much higher."""
    flat = rng.uniform(-0.49, 0.49, (200, 3)) * (box[3:6] + [0, 0, higher])
    cos, sin = np.cos(box[6]), np.sin(box[6])
    return flat @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + (
        box[:3] + [0, 0, higher / 2])


def drive(scores: float = 0.9, missed: int = -1, noise: float = 0.02,
          start: np.ndarray = np.eye(4)) -> tuple[list[FrameLook], list[int], list[np.ndarray]]:
    """The looks at FRAMES frames, their stamps, and the poses (4, 4) of a sensor that begins at
    `start`; the parked car is missed in one of them."""
    rng = np.random.default_rng(0)
    looks, stamps, poses = [], [], []
    for i in range(FRAMES):
        at = pose(0.8 * i, 0.0, 0.01 * i)
        boxes = moved_boxes(boxes_at(i / 10), inverse(at))
        cloud = np.concatenate([points_in(box, rng, 2.0 * (k == POST))
                                for k, box in enumerate(boxes)]).astype(np.float32)
        boxes[:, :2] += rng.normal(0, noise, (5, 2))
        kept = np.arange(5) != (PARKED if i == missed else -1)
        found = Detections.of(boxes[kept], KINDS[kept], scores)
        found = Detections(found.boxes, found.class_ids, found.scores,
                           {name: found.scores for name in SOURCES})
        looks.append(FrameLook(found, *seen_in(found.boxes, cloud), start @ at))
        stamps.append(START + i * TENTH)
        poses.append(at)
    return looks, stamps, poses
