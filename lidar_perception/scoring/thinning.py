"""Scans with fewer points, to simulate a sparser sensor (paper C)."""

from __future__ import annotations

import zlib

import numpy as np

from lidar_perception.types import PointCloud


def thin_points(frame: PointCloud, share: float, name: str) -> PointCloud:
    """Return a random share (0..1) of the points of the frame called name.

    The choice depends on the name only. A smaller share is a subset of a larger one.
    """
    if share >= 1.0:
        return frame
    return frame.take(np.flatnonzero(draw_subset(len(frame), share, name)))


def draw_subset(count: int, share: float, name: str) -> np.ndarray:
    """Return a mask (count,) bool of a random share of the points, seeded by name."""
    return np.random.default_rng(zlib.crc32(name.encode())).random(count) < share
