"""Laws of several scans as one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.candidates.accumulation import Accumulated, accumulate, aligned, velocities

AGES = np.array([0.4, 0.3, 0.2, 0.1, 0.0])


def poses(rng, count):
    made = np.tile(np.eye(4), (count, 1, 1))
    angle = np.cumsum(rng.normal(0, 0.05, count))
    made[:, 0, 0] = made[:, 1, 1] = np.cos(angle)
    made[:, 1, 0], made[:, 0, 1] = np.sin(angle), -np.sin(angle)
    made[:, :3, 3] = np.cumsum(rng.normal(0, 1, (count, 3)), axis=0)
    return made


@given(st.integers(0, 2**32 - 1))
def test_what_stands_falls_together(seed):
    rng = np.random.default_rng(seed)
    world, at = rng.uniform(-30, 30, (40, 3)), poses(rng, 5)
    scans = [(world - p[:3, 3]) @ p[:3, :3] for p in at]
    points = accumulate(scans, at, AGES)
    for age in AGES:
        np.testing.assert_allclose(points.xyz[points.age == age], scans[-1], atol=1e-4)
    far = accumulate(scans, at, AGES, min_range=15.0)
    assert (points.age == 0).sum() == (far.age == 0).sum() == 40
    old = far.xyz[far.age > 0]
    assert (np.hypot(old[:, 0], old[:, 1]) >= 15.0).all()
    assert len(old) == 4 * (np.hypot(*scans[-1][:, :2].T) >= 15.0).sum()


def walkers(speeds, points=12, seed=0):
    """One cluster a speed (vx, vy), seen in every scan, and their labels."""
    rng = np.random.default_rng(seed)
    xyz, labels, age = [], [], []
    for k, speed in enumerate(speeds):
        body = rng.normal(0, 0.2, (points, 3)) + [10 + 5 * k, 3, -1]
        for seconds in AGES:
            xyz.append(body - np.append(np.array(speed) * seconds, 0))
            labels.append(np.full(points, k + 1))
            age.append(np.full(points, seconds))
    return (Accumulated(np.concatenate(xyz).astype(np.float32), np.concatenate(age)),
            np.concatenate(labels).astype(np.int32))


def test_velocities_are_those_of_walkers_and_0_for_what_stands_or_is_too_fast():
    points, labels = walkers([(1.4, 0.0), (-0.6, 0.8), (0.1, 0.1), (9.0, 0.0)])
    np.testing.assert_allclose(velocities(points, labels),
                               [[1.4, 0], [-0.6, 0.8], [0, 0], [0, 0]], atol=1e-3)


def test_alignment_puts_a_walkers_scans_on_the_newest_and_leaves_the_rest():
    points, labels = walkers([(1.4, 0.3), (0.0, 0.0)])
    moved = aligned(points, labels, velocities(points, labels))
    for k in (1, 2):
        newest = points.xyz[(labels == k) & (points.age == 0)]
        for age in AGES:
            np.testing.assert_allclose(moved[(labels == k) & (points.age == age)], newest,
                                       atol=2e-3)
    np.testing.assert_array_equal(aligned(points, np.zeros_like(labels), np.zeros((0, 2))),
                                  points.xyz)


def test_two_scans_are_not_enough_to_tell_a_speed():
    points, labels = walkers([(1.4, 0.0)])
    late = points.age < 0.15
    two = Accumulated(points.xyz[late], points.age[late])
    assert velocities(two, labels[late]).tolist() == [[0.0, 0.0]]


def test_no_points_no_clusters():
    none = Accumulated(np.zeros((0, 3), np.float32), np.zeros(0))
    assert velocities(none, np.zeros(0, np.int32)).shape == (0, 2)
    assert accumulate([np.zeros((0, 3))], np.eye(4)[None], np.zeros(1)).xyz.shape == (0, 3)


@pytest.mark.parametrize("count", [1, 2])
def test_a_cluster_seen_by_too_few_points_a_scan_has_no_speed(count):
    points, labels = walkers([(1.4, 0.0)], points=count)
    assert velocities(points, labels).any() == (count >= 2)
