"""The tree of frames: laws of poses, against scipy's rotations, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from lidar_perception.robot import tree as module
from lidar_perception.robot.poses import interpolated, inverse, moved_points, pose_of
from lidar_perception.robot.tree import SECOND, Missing, TransformTree
from lidar_perception.types import InputError

START = 1_700_000_000 * SECOND + 123_456_789
seeds = st.integers(0, 10_000)


def some(seed, count=None):
    """Translations and quaternions."""
    rng = np.random.default_rng(seed)
    size = () if count is None else (count,)
    return rng.uniform(-50, 50, (*size, 3)), Rotation.random(count, rng).as_quat()


def chain(seed=0):
    """map -> odom -> base (moving, 50 Hz for 2 s) -> lidar, and base -> camera."""
    tree, poses = TransformTree(), {}
    for i, (parent, child) in enumerate([("map", "odom"), ("base", "lidar"), ("base", "camera")]):
        poses[parent, child] = some(seed + i)
        tree.set(parent, child, 0, *poses[parent, child], static=True)
    times = START + np.arange(101) * (SECOND // 50)
    rng = np.random.default_rng(seed)
    translations = np.cumsum(rng.normal(0, 0.3, (101, 3)), axis=0)
    quaternions = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.03, (101, 3)), axis=0)).as_quat()
    for t, moved, turned in zip(times, translations, quaternions):
        tree.set("odom", "base", int(t), moved, turned)
    return tree, poses, (times, translations, quaternions)


@given(seeds, st.floats(0, 2))
def test_lookup_is_what_scipy_composes_by_hand(seed, seconds):
    tree, poses, (times, translations, quaternions) = chain(seed)
    stamp = min(START + round(seconds * SECOND), int(times[-1]))
    since = (times - START).astype(float)
    turned = Slerp(since, Rotation.from_quat(quaternions))(stamp - START)
    moved = [np.interp(stamp - START, since, axis) for axis in translations.T]
    point = np.array([3.0, -2.0, 1.0])
    t, q = poses["base", "lidar"]
    expected = Rotation.from_quat(q).apply(point) + t
    expected = turned.apply(expected) + moved
    t, q = poses["map", "odom"]
    expected = Rotation.from_quat(q).apply(expected) + t
    pose = tree.lookup("map", "lidar", stamp)
    np.testing.assert_allclose(pose[:3, :3] @ point + pose[:3, 3], expected, atol=1e-6)
    np.testing.assert_allclose(moved_points(point[None], pose)[0], expected, atol=1e-6)


@given(seeds)
def test_there_and_back_is_where_one_was_and_any_way_round_is_the_same(seed):
    tree, _, _ = chain(seed)
    stamp = START + SECOND // 3
    there, back = tree.lookup("map", "lidar", stamp), tree.lookup("lidar", "map", stamp)
    np.testing.assert_allclose(there @ back, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(inverse(there), back, atol=1e-9)
    by_way = tree.lookup("map", "camera", stamp) @ tree.lookup("camera", "lidar", stamp)
    np.testing.assert_allclose(by_way, there, atol=1e-9)
    np.testing.assert_array_equal(tree.lookup("base", "base", stamp), np.eye(4))
    np.testing.assert_array_equal(tree.lookup("/nowhere", "nowhere", stamp), np.eye(4))
    at = np.array([stamp, START, stamp + 1])
    np.testing.assert_array_equal(tree.poses("map", "lidar", at)[0], there)


@given(seeds, st.floats(0, 1))
def test_between_two_poses_it_moves_straight_and_turns_evenly(seed, share):
    (t0, t1), (q0, q1) = some(seed, 2)
    times = np.array([START, START + SECOND])
    pose = interpolated(times, [t0, t1], [q0, q1], np.array([START + round(share * SECOND)]))[0]
    np.testing.assert_allclose(pose[:3, 3], t0 + share * (t1 - t0), atol=1e-5)
    first = Rotation.from_quat(q0)
    whole = (first.inv() * Rotation.from_quat(q1)).magnitude()
    part = (first.inv() * Rotation.from_matrix(pose[:3, :3])).magnitude()
    assert part == pytest.approx(share * whole, abs=1e-6)
    ends = interpolated(times, [t0, t1], [q0, -q1], times)  # q and -q are the same rotation
    np.testing.assert_allclose(ends, pose_of([t0, t1], [q0, q1]), atol=1e-9)


def test_nothing_is_guessed_beyond_what_is_known():
    tree, _, (times, _, _) = chain()
    for stamp, words, late in [(times[-1] + 1, "'odom' -> 'base' is 0.000 s older", True),
                               (times[-1] + 5 * SECOND, "5.000 s older than needed", False),
                               (times[-1] + 37 * SECOND, "stopped.*different clocks", False),
                               (START - SECOND, "1.000 s newer than needed$", False),
                               (1234 * SECOND, "different clocks", False)]:  # since power-up
        with pytest.raises(Missing, match=words) as error:
            tree.lookup("map", "lidar", int(stamp))
        assert error.value.late == late
    assert np.isfinite(tree.lookup("lidar", "camera", 0)).all()  # fixed, so known at any time


@given(seeds, st.floats(0.02, 0.4))
def test_with_a_gap_allowed_what_moves_goes_on_as_it_did(seed, seconds):
    """Along the way of its last two poses, evenly: as far again takes as long again."""
    tree, _, (times, _, _) = chain(seed)
    last, beyond = int(times[-1]), round(seconds * SECOND)
    step = inverse(tree.lookup("odom", "base", int(times[-2]))) @ tree.lookup("odom", "base", last)
    found = tree.lookup("odom", "base", last + beyond, 0.5)
    turned = Rotation.from_matrix(step[:3, :3]).as_rotvec() * seconds / 0.02
    expected = tree.lookup("odom", "base", last)[:3, :3] @ Rotation.from_rotvec(turned).as_matrix()
    np.testing.assert_allclose(found[:3, :3], expected, atol=1e-6)
    before, now = (tree.lookup("odom", "base", t)[:3, 3] for t in (int(times[-2]), last))
    np.testing.assert_allclose(found[:3, 3], now + (now - before) * seconds / 0.02, atol=1e-6)
    np.testing.assert_array_equal(tree.lookup("odom", "base", last, 0.5),
                                  tree.lookup("odom", "base", last))


def test_a_gap_that_is_too_long_is_not_bridged():
    tree = TransformTree()
    tree.set("odom", "base", START, [0, 0, 0], [0, 0, 0, 1])
    for stamp in (START - 1, START + 1):  # one pose alone does not move
        with pytest.raises(Missing):
            tree.lookup("odom", "base", stamp, 0.5)
    tree.set("odom", "base", START + SECOND // 10, [1, 0, 0], [0, 0, 0, 1])
    assert tree.lookup("odom", "base", START + SECOND // 2, 0.5)[0, 3] == pytest.approx(5)
    with pytest.raises(Missing, match="older than needed") as error:
        tree.lookup("odom", "base", START + SECOND * 7 // 10, 0.5)
    assert error.value.late
    tree.set("odom", "base", START + 2 * SECOND, [2, 0, 0], [0, 0, 0, 1])
    assert np.isfinite(tree.lookup("odom", "base", START + SECOND)).all()
    with pytest.raises(Missing, match="s apart at the time"):
        tree.lookup("odom", "base", START + SECOND, 0.5)
    assert tree.lookup("odom", "base", START + SECOND // 10, 0.0)[0, 3] == 1  # its very stamp


def test_what_is_not_connected_is_named():
    tree, _, _ = chain()
    tree.set("world", "tower", 0, [0, 0, 0], [0, 0, 0, 1], static=True)
    with pytest.raises(Missing, match="'lidar' with 'radar': 'lidar' is below 'map', 'radar' is "
                                      "not in TF"):
        tree.lookup("radar", "lidar", START)
    with pytest.raises(Missing, match="'tower' is below 'world', 'map' is the root"):
        tree.lookup("map", "tower", START)


def test_a_circle_is_an_error_and_not_an_endless_walk():
    tree = TransformTree()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        tree.set(parent, child, 0, [0, 0, 0], [0, 0, 0, 1], static=True)
    with pytest.raises(Missing, match="circle: b -> a -> c -> b"):
        tree.lookup("x", "b", 0)


def test_a_bag_that_starts_again_leaves_what_is_fixed_and_forgets_what_moves():
    tree, _, (times, _, _) = chain()
    fixed = tree.lookup("map", "odom", 0)
    tree.set("odom", "base", START - 20 * SECOND, [1, 2, 3], [0, 0, 0, 1])
    assert tree.jumps == 1
    with pytest.raises(Missing, match="older than needed"):
        tree.lookup("odom", "base", int(times[50]))
    np.testing.assert_array_equal(tree.lookup("map", "odom", 0), fixed)
    tree.set("odom", "base", START - 19 * SECOND, [2, 2, 3], [0, 0, 0, 1])
    assert tree.lookup("odom", "base", START - 19 * SECOND - SECOND // 2)[0, 3] == 1.5
    tree.set("odom", "base", START - 19 * SECOND - SECOND // 4, [5, 2, 3], [0, 0, 0, 1])
    assert tree.jumps == 1  # a little out of order is no jump
    assert tree.lookup("odom", "base", START - 19 * SECOND - SECOND // 4)[0, 3] == 5


class Counted(int):
    """A stamp that counts how often it is compared."""

    asked = 0

    def __lt__(self, other):
        Counted.asked += 1
        return int(self) < int(other)

    def __gt__(self, other):
        Counted.asked += 1
        return int(self) > int(other)


def test_a_recording_that_goes_back_takes_no_longer():
    tree = TransformTree(keeps_all=True)
    for first in (0, 5):
        for i in range(500):
            tree.set("a", "b", Counted(10 * i + first), [2 * i + first / 5, 0, 0], [0, 0, 0, 1])
    assert Counted.asked < 1000 * 20
    assert [tree.lookup("a", "b", 5 * i)[0, 3] for i in range(1000)] == [*range(1000)]


def test_memory_is_bounded(monkeypatch):
    """By time, by count and by the number of frames; what is still kept stays right."""
    monkeypatch.setattr(module, "MAX_KEPT", 100)
    monkeypatch.setattr(module, "MAX_FRAMES", 3)
    tree = TransformTree()
    for i in range(5000):
        tree.set("a", "b", START + i * SECOND // 1000, [i, 0, 0], [0, 0, 0, 1])
    assert len(tree._links["b"].times) <= 112
    assert tree.lookup("a", "b", START + 4990 * SECOND // 1000)[0, 3] == 4990
    for i in range(100):
        tree.set("c", "d", START + i * SECOND, [i, 0, 0], [0, 0, 0, 1])
    assert len(tree._links["d"].times) <= 13
    tree.set("e", "f", 0, [0, 0, 0], [0, 0, 0, 1], static=True)
    with pytest.raises(InputError, match="more than 3 frames"):
        tree.set("g", "h", 0, [0, 0, 0], [0, 0, 0, 1])


@pytest.mark.parametrize("change, words", [
    (dict(quaternion=[0, 0, 0, 0]), "no unit quaternion"),
    (dict(quaternion=[0, 0, 0, 1.5]), "no unit quaternion"),
    (dict(quaternion=[0, 0, float("nan"), 1]), "no unit quaternion"),
    (dict(translation=[0, float("inf"), 0]), "not finite"),
    (dict(child="a"), "two frames with names"),
    (dict(child=""), "two frames with names"),
])
def test_what_is_no_transform_is_refused_and_changes_nothing(change, words):
    tree = TransformTree()
    good = dict(parent="a", child="b", stamp_ns=0, translation=[1, 2, 3],
                quaternion=[0, 0, 0, 1.001], static=True)
    tree.set(**good)
    before = tree.lookup("a", "b", 0)
    with pytest.raises(InputError, match=words):
        tree.set(**{**good, **change})
    np.testing.assert_array_equal(tree.lookup("a", "b", 0), before)
    np.testing.assert_allclose(before[:3, :3], np.eye(3))
