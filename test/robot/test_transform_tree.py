"""The tree of coordinate frames, compared with scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from lidar_perception.robot import transform_tree
from lidar_perception.robot.poses import interpolate_poses, invert_pose, make_pose, transform_points
from lidar_perception.robot.transform_tree import SECOND_NS, MissingTransform, TransformTree
from lidar_perception.types import InputError

START = 1_700_000_000 * SECOND_NS + 123_456_789
seeds = st.integers(0, 10_000)


def make_transforms(seed, count=None):
    """Return random translations and quaternions."""
    rng = np.random.default_rng(seed)
    size = () if count is None else (count,)
    return rng.uniform(-50, 50, (*size, 3)), Rotation.random(count, rng).as_quat()


def make_tree(seed=0):
    """Return a tree map -> odom -> base -> lidar, camera, and its poses.

    The base moves in odom, at 50 Hz for 2 s.
    """
    tree, poses = TransformTree(), {}
    for i, (parent, child) in enumerate([("map", "odom"), ("base", "lidar"), ("base", "camera")]):
        poses[parent, child] = make_transforms(seed + i)
        tree.set(parent, child, 0, *poses[parent, child], static=True)
    times = START + np.arange(101) * (SECOND_NS // 50)
    rng = np.random.default_rng(seed)
    translations = np.cumsum(rng.normal(0, 0.3, (101, 3)), axis=0)
    quaternions = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.03, (101, 3)), axis=0)).as_quat()
    for t, translation, quaternion in zip(times, translations, quaternions):
        tree.set("odom", "base", int(t), translation, quaternion)
    return tree, poses, (times, translations, quaternions)


@given(seeds, st.floats(0, 2))
def test_lookup_equals_composition_by_scipy(seed, seconds):
    tree, poses, (times, translations, quaternions) = make_tree(seed)
    stamp = min(START + round(seconds * SECOND_NS), int(times[-1]))
    since = (times - START).astype(float)
    rotation = Slerp(since, Rotation.from_quat(quaternions))(stamp - START)
    translation = [np.interp(stamp - START, since, axis) for axis in translations.T]
    point = np.array([3.0, -2.0, 1.0])
    t, q = poses["base", "lidar"]
    expected = Rotation.from_quat(q).apply(point) + t
    expected = rotation.apply(expected) + translation
    t, q = poses["map", "odom"]
    expected = Rotation.from_quat(q).apply(expected) + t
    pose = tree.lookup("map", "lidar", stamp)
    np.testing.assert_allclose(pose[:3, :3] @ point + pose[:3, 3], expected, atol=1e-6)
    np.testing.assert_allclose(transform_points(point[None], pose)[0], expected, atol=1e-6)


@given(seeds)
def test_inverse_and_chained_lookups_agree(seed):
    tree, _, _ = make_tree(seed)
    stamp = START + SECOND_NS // 3
    pose, inverse = tree.lookup("map", "lidar", stamp), tree.lookup("lidar", "map", stamp)
    np.testing.assert_allclose(pose @ inverse, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(invert_pose(pose), inverse, atol=1e-9)
    detour = tree.lookup("map", "camera", stamp) @ tree.lookup("camera", "lidar", stamp)
    np.testing.assert_allclose(detour, pose, atol=1e-9)
    np.testing.assert_array_equal(tree.lookup("base", "base", stamp), np.eye(4))
    np.testing.assert_array_equal(tree.lookup("/nowhere", "nowhere", stamp), np.eye(4))
    at = np.array([stamp, START, stamp + 1])
    np.testing.assert_array_equal(tree.lookup_many("map", "lidar", at)[0], pose)


@given(seeds, st.floats(0, 1))
def test_poses_are_interpolated_linearly_and_by_slerp(seed, share):
    (t0, t1), (q0, q1) = make_transforms(seed, 2)
    times = np.array([START, START + SECOND_NS])
    pose = interpolate_poses(times, [t0, t1], [q0, q1], np.array([START + round(share * SECOND_NS)]))[0]
    np.testing.assert_allclose(pose[:3, 3], t0 + share * (t1 - t0), atol=1e-5)
    first = Rotation.from_quat(q0)
    whole = (first.inv() * Rotation.from_quat(q1)).magnitude()
    part = (first.inv() * Rotation.from_matrix(pose[:3, :3])).magnitude()
    assert part == pytest.approx(share * whole, abs=1e-6)
    ends = interpolate_poses(times, [t0, t1], [q0, -q1], times)  # q and -q are the same rotation
    np.testing.assert_allclose(ends, make_pose([t0, t1], [q0, q1]), atol=1e-9)


def test_poses_are_not_extrapolated_by_default():
    tree, _, (times, _, _) = make_tree()
    for stamp, words, late in [
        (times[-1] + 1, "'odom' -> 'base' is 0.000 s older", True),
        (times[-1] + 5 * SECOND_NS, "5.000 s older than needed", False),
        (times[-1] + 37 * SECOND_NS, "stopped.*different clocks", False),
        (START - SECOND_NS, "1.000 s newer than needed$", False),
        (1234 * SECOND_NS, "different clocks", False),
    ]:
        with pytest.raises(MissingTransform, match=words) as error:
            tree.lookup("map", "lidar", int(stamp))
        assert error.value.late == late
    assert np.isfinite(tree.lookup("lidar", "camera", 0)).all()  # static, so known at any time


@given(seeds, st.floats(0.02, 0.4))
def test_max_gap_extrapolates_last_two_poses(seed, seconds):
    tree, _, (times, _, _) = make_tree(seed)
    last, beyond = int(times[-1]), round(seconds * SECOND_NS)
    before, now = (tree.lookup("odom", "base", t) for t in (int(times[-2]), last))
    step = invert_pose(before) @ now
    result = tree.lookup("odom", "base", last + beyond, 0.5)
    turn = Rotation.from_rotvec(Rotation.from_matrix(step[:3, :3]).as_rotvec() * seconds / 0.02)
    np.testing.assert_allclose(result[:3, :3], now[:3, :3] @ turn.as_matrix(), atol=1e-6)
    velocity = (now - before)[:3, 3] / 0.02
    np.testing.assert_allclose(result[:3, 3], now[:3, 3] + velocity * seconds, atol=1e-6)
    np.testing.assert_array_equal(tree.lookup("odom", "base", last, 0.5), tree.lookup("odom", "base", last))


def test_gaps_longer_than_max_gap_are_not_bridged():
    tree = TransformTree()
    tree.set("odom", "base", START, [0, 0, 0], [0, 0, 0, 1])
    for stamp in (START - 1, START + 1):  # a single pose is not extrapolated
        with pytest.raises(MissingTransform):
            tree.lookup("odom", "base", stamp, 0.5)
    tree.set("odom", "base", START + SECOND_NS // 10, [1, 0, 0], [0, 0, 0, 1])
    assert tree.lookup("odom", "base", START + SECOND_NS // 2, 0.5)[0, 3] == pytest.approx(5)
    with pytest.raises(MissingTransform, match="older than needed") as error:
        tree.lookup("odom", "base", START + SECOND_NS * 7 // 10, 0.5)
    assert error.value.late
    tree.set("odom", "base", START + 2 * SECOND_NS, [2, 0, 0], [0, 0, 0, 1])
    assert np.isfinite(tree.lookup("odom", "base", START + SECOND_NS)).all()
    with pytest.raises(MissingTransform, match="s apart at the requested time"):
        tree.lookup("odom", "base", START + SECOND_NS, 0.5)
    # At its own stamp a pose is known.
    assert tree.lookup("odom", "base", START + SECOND_NS // 10, 0.0)[0, 3] == 1


def test_error_names_unconnected_frames():
    tree, _, _ = make_tree()
    tree.set("world", "tower", 0, [0, 0, 0], [0, 0, 0, 1], static=True)
    with pytest.raises(MissingTransform, match="'lidar' with 'radar': 'lidar' is below 'map', 'radar' is not in TF"):
        tree.lookup("radar", "lidar", START)
    with pytest.raises(MissingTransform, match="'tower' is below 'world', 'map' is the root"):
        tree.lookup("map", "tower", START)


def test_loop_of_transforms_is_rejected():
    tree = TransformTree()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        tree.set(parent, child, 0, [0, 0, 0], [0, 0, 0, 1], static=True)
    with pytest.raises(MissingTransform, match="loop: b -> a -> c -> b"):
        tree.lookup("x", "b", 0)


def test_jump_back_in_time_forgets_moving_transforms():
    tree, _, (times, _, _) = make_tree()
    fixed = tree.lookup("map", "odom", 0)
    tree.set("odom", "base", START - 20 * SECOND_NS, [1, 2, 3], [0, 0, 0, 1])
    with pytest.raises(MissingTransform, match="older than needed"):
        tree.lookup("odom", "base", int(times[50]))
    np.testing.assert_array_equal(tree.lookup("map", "odom", 0), fixed)
    tree.set("odom", "base", START - 19 * SECOND_NS, [2, 2, 3], [0, 0, 0, 1])
    assert tree.lookup("odom", "base", START - 19 * SECOND_NS - SECOND_NS // 2)[0, 3] == 1.5
    tree.set("odom", "base", START - 19 * SECOND_NS - SECOND_NS // 4, [5, 2, 3], [0, 0, 0, 1])
    # a slightly older stamp is not a jump
    assert tree.lookup("odom", "base", START - 19 * SECOND_NS - SECOND_NS // 4)[0, 3] == 5


class CountingStamp(int):
    """Stamp that counts comparisons."""

    comparisons = 0

    def __lt__(self, other):
        CountingStamp.comparisons += 1
        return int(self) < int(other)

    def __gt__(self, other):
        CountingStamp.comparisons += 1
        return int(self) > int(other)


def test_inserting_old_transforms_takes_logarithmic_time():
    tree = TransformTree(keeps_all=True)
    for first in (0, 5):
        for i in range(500):
            tree.set("a", "b", CountingStamp(10 * i + first), [2 * i + first / 5, 0, 0], [0, 0, 0, 1])
    assert CountingStamp.comparisons < 1000 * 20
    assert [tree.lookup("a", "b", 5 * i)[0, 3] for i in range(1000)] == [*range(1000)]


def test_memory_of_transforms_is_bounded(monkeypatch):
    """Time, number of poses and number of frames are bounded."""
    monkeypatch.setattr(transform_tree, "MAX_HISTORY", 100)
    monkeypatch.setattr(transform_tree, "MAX_FRAMES", 3)
    tree = TransformTree()
    for i in range(5000):
        tree.set("a", "b", START + i * SECOND_NS // 1000, [i, 0, 0], [0, 0, 0, 1])
    assert len(tree._links["b"].times) <= 112
    assert tree.lookup("a", "b", START + 4990 * SECOND_NS // 1000)[0, 3] == 4990
    for i in range(100):
        tree.set("c", "d", START + i * SECOND_NS, [i, 0, 0], [0, 0, 0, 1])
    assert len(tree._links["d"].times) <= 13
    tree.set("e", "f", 0, [0, 0, 0], [0, 0, 0, 1], static=True)
    with pytest.raises(InputError, match="more than 3 frames"):
        tree.set("g", "h", 0, [0, 0, 0], [0, 0, 0, 1])


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(quaternion=[0, 0, 0, 0]), "not normalized"),
        (dict(quaternion=[0, 0, 0, 1.5]), "not normalized"),
        (dict(quaternion=[0, 0, float("nan"), 1]), "not normalized"),
        (dict(translation=[0, float("inf"), 0]), "not finite"),
        (dict(child="a"), "different, non-empty names"),
        (dict(child=""), "different, non-empty names"),
    ],
)
def test_invalid_transform_is_rejected_and_not_stored(change, words):
    tree = TransformTree()
    good = dict(parent="a", child="b", stamp_ns=0, translation=[1, 2, 3], quaternion=[0, 0, 0, 1.001], static=True)
    tree.set(**good)
    before = tree.lookup("a", "b", 0)
    with pytest.raises(InputError, match=words):
        tree.set(**{**good, **change})
    np.testing.assert_array_equal(tree.lookup("a", "b", 0), before)
    np.testing.assert_allclose(before[:3, :3], np.eye(3))
