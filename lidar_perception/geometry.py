"""Boxes and ranges; frames as in types.py."""

from __future__ import annotations

import numpy as np


def wrap_angle(angle):
    """The same angle in [-pi, pi)."""
    wrapped = (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)[()]  # a hair below -pi rounds to pi


def horizontal_range(xyz: np.ndarray) -> np.ndarray:
    """(N,) distance from the sensor in the x-y plane, dtype of xyz. xyz is (N, >=2)."""
    return np.sqrt(xyz[:, 0] * xyz[:, 0] + xyz[:, 1] * xyz[:, 1])


def to_box_frame(xyz: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(N, 3) points relative to the centre of box (7,), rotated so that x runs along its length."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    dx, dy = xyz[:, 0] - box[0], xyz[:, 1] - box[1]
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, xyz[:, 2] - box[2]], axis=1)


def points_in_box(xyz: np.ndarray, box: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """(N,) bool: points (N, 3 or more) inside box (7,) grown by margin metres on every side; faces
    count."""
    half = np.asarray(box[3:6], np.float64) / 2 + margin
    inside = np.zeros(len(xyz), bool)
    near = np.flatnonzero(np.abs(xyz[:, 0] - np.float32(box[0])) <= np.hypot(*half[:2]) + 1e-3)
    inside[near] = (np.abs(to_box_frame(xyz[near], box)) <= half).all(axis=1)
    return inside


def box_corners(boxes: np.ndarray) -> np.ndarray:
    """(K, 8, 3) corners of boxes (K, 7): four at the bottom, counter-clockwise from front left
    (seen from above), then the four above them."""
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    flat = signs * boxes[:, None, 3:5]
    cos, sin = np.cos(boxes[:, None, 6]), np.sin(boxes[:, None, 6])
    x = boxes[:, None, 0] + cos * flat[..., 0] - sin * flat[..., 1]
    y = boxes[:, None, 1] + sin * flat[..., 0] + cos * flat[..., 1]
    half = boxes[:, None, 5] / 2
    below, above = (np.broadcast_to(boxes[:, None, 2] + s * half, x.shape) for s in (-1, 1))
    return np.concatenate([np.stack([x, y, below], -1), np.stack([x, y, above], -1)], axis=1)
