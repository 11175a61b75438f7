"""Simple objects, detections and poses for tests of tracking."""

from __future__ import annotations

import numpy as np

from lidar_perception.types import CLASSES, PEDESTRIAN, Detections

CAR, CYCLIST = CLASSES.index("Car"), CLASSES.index("Cyclist")
TENTH = 100_000_000
START = 10**18


def car(x, y=0.0, yaw=0.0):
    return [x, y, -1.0, 4.0, 1.8, 1.5, yaw]


def person(x, y=0.0):
    return [x, y, -0.8, 0.8, 0.6, 1.75, 0.0]


def cars(*rows, scores=0.9, kind=CAR):
    return Detections.of(np.reshape(rows, (-1, 7)), kind, scores)


def pose(x, y=0.0, yaw=0.0):
    result = np.eye(4)
    result[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    result[:2, 3] = x, y
    return result


def crowd(seed=0, frames=20):
    """Yield noisy detections of objects on straight lines, in the fixed frame."""
    rng = np.random.default_rng(seed)
    kinds = np.array([CAR, CAR, CYCLIST, PEDESTRIAN, PEDESTRIAN, PEDESTRIAN])
    start = np.array([car(10), car(20, 8, np.pi), car(15, -8), person(8, 4), person(12, -4), person(25, 5)])
    velocity = np.array([[8, 0], [-5, 0], [4, 0], [1, 0.5], [0, 0], [-1, 0]])
    for i in range(frames):
        boxes = start.copy()
        boxes[:, :2] += velocity * i / 10 + rng.normal(0, 0.05, (6, 2))
        yield Detections.of(boxes, kinds, rng.uniform(0.7, 0.95, 6))
