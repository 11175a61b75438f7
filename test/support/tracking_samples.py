"""Simple objects, detections and poses for tests of tracking."""

from __future__ import annotations

import numpy as np

from lidar_perception.types import CLASSES, PEDESTRIAN, Detections

CAR, CYCLIST = CLASSES.index("Car"), CLASSES.index("Cyclist")
TENTH = 100_000_000
START = 10**18


def make_car(x, y=0.0, yaw=0.0):
    return [x, y, -1.0, 4.0, 1.8, 1.5, yaw]


def make_person(x, y=0.0):
    return [x, y, -0.8, 0.8, 0.6, 1.75, 0.0]


def make_detections(*rows, scores=0.9, kind=CAR):
    return Detections.of(np.reshape(rows, (-1, 7)), kind, scores)


def make_flat_pose(x, y=0.0, yaw=0.0):
    result = np.eye(4)
    result[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    result[:2, 3] = x, y
    return result


def make_crowd_detections(seed=0, frames=20):
    """Yield noisy detections of objects on straight lines, in the fixed frame."""
    rng = np.random.default_rng(seed)
    kinds = np.array([CAR, CAR, CYCLIST, PEDESTRIAN, PEDESTRIAN, PEDESTRIAN])
    start = np.array(
        [
            make_car(10),
            make_car(20, 8, np.pi),
            make_car(15, -8),
            make_person(8, 4),
            make_person(12, -4),
            make_person(25, 5),
        ]
    )
    velocity = np.array([[8, 0], [-5, 0], [4, 0], [1, 0.5], [0, 0], [-1, 0]])
    for i in range(frames):
        boxes = start.copy()
        boxes[:, :2] += velocity * i / 10 + rng.normal(0, 0.05, (6, 2))
        yield Detections.of(boxes, kinds, rng.uniform(0.7, 0.95, 6))
