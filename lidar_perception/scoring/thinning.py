"""Scans with fewer points, for what a detector does with a sparser sensor (paper C)."""

from __future__ import annotations

import zlib

import numpy as np

from lidar_perception.types import PointCloud


def thin_points(frame: PointCloud, share: float, name: str) -> PointCloud:
    """About this share (0..1) of the points of the frame called name, drawn at random but always
    the same; with 1 the frame itself. A smaller share keeps some of the points of a larger one."""
    if share >= 1.0:
        return frame
    return frame.take(np.flatnonzero(draw_subset(len(frame), share, name)))


def draw_subset(count: int, share: float, name: str) -> np.ndarray:
    """(count,) bool: which of the points of something called name are that share of it."""
    return np.random.default_rng(zlib.crc32(name.encode())).random(count) < share
