"""Synthetic scene of people and other objects on flat ground, for the tests of candidates."""

from __future__ import annotations

import numpy as np

GROUND_Z = -1.7
PEOPLE = np.array([[7, 2], [12, -5], [20, 4]])


def make_person(x, y, count=400, seed=0, height=1.75):
    """Return points of a person at x, y facing the sensor: a head, a torso and two legs."""
    rng = np.random.default_rng(seed)
    part = rng.choice(4, count, p=[0.15, 0.45, 0.2, 0.2])
    low = np.array([[-0.12, 1.45], [-0.25, 0.8], [-0.2, 0.06], [0.05, 0.06]])[part]
    high = np.array([[0.12, height], [0.25, 1.45], [-0.05, 0.8], [0.2, 0.8]])[part]
    across, up = (low + rng.random((count, 2)) * (high - low)).T
    return np.column_stack([x + rng.uniform(0, 0.1, count), y + across, GROUND_Z + up])


def make_block(x, y, size, count=600, seed=0):
    """Return points that fill a box whose bottom is 0.06 m above the ground."""
    low = [x, y, GROUND_Z + 0.06]
    return low + np.random.default_rng(seed).random((count, 3)) * size


def make_floor(seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-40, 40, (6000, 2)), rng.normal(GROUND_Z, 0.01, 6000)])


def make_people_scene():
    """Return a floor, three people and two other objects, one of them as tall as a person."""
    parts = [
        make_floor(),
        *(make_person(*at, seed=i) for i, at in enumerate(PEOPLE)),
        make_block(10, 8, [2.0, 3.0, 1.3]),
        make_block(13, 3, [0.2, 0.6, 1.69]),
    ]
    return np.concatenate(parts).astype(np.float32)


def make_boxes_at(indices, height=1.8):
    return np.array([[x + 0.05, y, GROUND_Z + height / 2, 0.6, 0.8, height, 0] for x, y in indices])


def from_pixels(pixels):
    """Convert an (80, 32) bool image to (80,) uint32, the inverse of silhouette.to_pixels."""
    weights = np.uint32(1) << np.arange(32, dtype=np.uint32)
    return (pixels.astype(np.uint32) * weights).sum(axis=1, dtype=np.uint32)
