"""Several scans as one: far things get points, and what moves is told from what stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar_perception.groups import cluster_count

MIN_SCANS = 3       # in which a cluster is seen, before its motion is measured
STILL_SPEED = 0.5   # m/s; slower is standing
MAX_SPEED = 4.0     # m/s; faster is no person, and rather a wrong match
MIN_POINTS = 2      # of a cluster in one scan


@dataclass(frozen=True)
class Accumulated:
    """M points of several scans in the frame of the newest: xyz (M, 3) float32, age (M,) float64
    seconds before the newest scan."""

    xyz: np.ndarray
    age: np.ndarray


def accumulate(scans: list[np.ndarray], poses: np.ndarray, ages: np.ndarray,
               min_range: float = 0.0) -> Accumulated:
    """The points of scans, each (N_i, 3) in its own frame, the newest last: all of the newest, of
    the others those beyond min_range metres (horizontal, from the newest). poses (S, 4, 4): each
    frame in a common one; ages (S,) seconds."""
    to_newest = np.linalg.inv(poses[-1]) @ poses
    parts, age = [], []
    for xyz, motion, seconds in zip(scans, to_newest, ages):
        moved = (xyz @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32)
        if seconds > 0:
            moved = moved[np.hypot(moved[:, 0], moved[:, 1]) >= min_range]
        parts.append(moved)
        age.append(np.full(len(moved), seconds))
    return Accumulated(np.concatenate(parts), np.concatenate(age))


def velocities(points: Accumulated, labels: np.ndarray) -> np.ndarray:
    """(K, 2) velocity over the ground in x and y, m/s, of clusters 1..K of labels (M,): the slope
    of their centroids over time, which fits whatever part of them is seen. 0 where a cluster is in
    fewer than three scans, stands, or is faster than a person."""
    clusters = cluster_count(labels)
    ages, scan = np.unique(points.age, return_inverse=True)
    cell = (labels - 1) * len(ages) + scan
    inside = labels > 0
    size = clusters * len(ages)
    count = np.bincount(cell[inside], minlength=size).reshape(clusters, len(ages))
    speed = np.zeros((clusters, 2))
    weight = np.where(count >= MIN_POINTS, count, 0).astype(float)
    enough = (weight > 0).sum(axis=1) >= MIN_SCANS
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    time = -ages - (weight @ -ages)[:, None] / total
    for axis in range(2):
        sums = np.bincount(cell[inside], weights=points.xyz[inside, axis], minlength=size)
        centre = sums.reshape(clusters, len(ages)) / np.maximum(count, 1)
        centre -= (weight * centre).sum(axis=1, keepdims=True) / total
        spread = (weight * time * time).sum(axis=1)
        speed[:, axis] = (weight * time * centre).sum(axis=1) / np.maximum(spread, 1e-9)
    fast = np.hypot(*speed.T)
    speed[~enough | (fast < STILL_SPEED) | (fast > MAX_SPEED)] = 0.0
    return speed


def aligned(points: Accumulated, labels: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """(M, 3) float32: the points of each cluster moved to where they are now, at velocity (K, 2)
    of clusters 1..K of labels (M,)."""
    moved = points.xyz.copy()
    shift = np.vstack([np.zeros((1, 2)), velocity])[labels] * points.age[:, None]
    moved[:, :2] += shift.astype(np.float32)
    return moved
