"""Builders of clouds with a known ground."""

from __future__ import annotations

import numpy as np


def make_street(seed=0, slope=(0.0, 0.0), count=30_000, reach=40.0):
    """Return points of a sloped road with five cars and a wall, and (N,) bool, True = road."""
    rng = np.random.default_rng(seed)
    road = np.column_stack([rng.uniform(-reach, reach, (count, 2)), rng.normal(0, 0.02, count)])
    cars = [rng.uniform(-1, 1, (600, 3)) * [2.1, 0.9, 0.6] + [*rng.uniform(-25, 25, 2), 0.9] for _ in range(5)]
    wall = np.column_stack([rng.uniform(-30, 30, 3000), np.full(3000, 33.25), rng.uniform(0.4, 5, 3000)])
    # The road is hidden behind the wall and under the cars.
    hidden = road[:, 1] > 33
    for car in cars:
        centre = car.mean(axis=0)
        hidden |= (np.abs(road[:, :2] - centre[:2]) < [2.1, 0.9]).all(axis=1)
    road = road[~hidden]
    xyz = np.concatenate([road, *cars, wall])
    xyz[:, 2] += xyz[:, :2] @ np.asarray(slope) - 1.73
    return xyz.astype(np.float32), np.arange(len(xyz)) < len(road)


def compute_f1(found, truth):
    return 2 * (found & truth).sum() / (found.sum() + truth.sum())
