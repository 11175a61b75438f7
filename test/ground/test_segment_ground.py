"""Properties of all ground segmentation methods, including tilted sensors."""

from __future__ import annotations

import numpy as np
import pytest
from ground_samples import compute_f1, make_street
from samples import DATA, needs_data

from lidar_perception.data.open import open_recording
from lidar_perception.ground.params import GROUND_METHODS, GroundParams, PatchworkParams, SensorPoseParams
from lidar_perception.ground.patchwork import segment_by_patchwork
from lidar_perception.ground.segment import METHODS, level_points, segment_ground
from lidar_perception.types import PointCloud

each_method = pytest.mark.parametrize("method", GROUND_METHODS)


def segment_xyz(xyz, method, intensity=None, **params):
    return segment_ground(PointCloud(np.asarray(xyz, np.float32), intensity), GroundParams(method=method, **params))


def test_every_method_name_has_a_function():
    assert tuple(METHODS) == GROUND_METHODS


@each_method
def test_flat_road_is_ground_and_objects_are_not(method):
    xyz, road = make_street()
    beyond = np.hypot(xyz[:, 0], xyz[:, 1]) > 3  # Patchwork++ ignores nearer points
    assert compute_f1(segment_xyz(xyz, method)[beyond], road[beyond]) > 0.97


BAD = {
    "empty": np.zeros((0, 3)),
    "one point": [[5, 0, -1.7]],
    "origin": np.zeros((50, 3)),
    "all NaN": np.full((50, 3), np.nan),
    "all infinite": np.full((50, 3), -np.inf),
    "all equal": np.full((50, 3), 4.0),
    "line": np.linspace(1, 9, 50)[:, None] * [1, 1, 0],
    "100 km": [[1e5, 0, 0], [0, 1e5, 1e5], [5, 5, -1.7]],
    "huge": np.full((5, 3), 3e38),
    "one below": np.concatenate([np.full((99, 3), 4.0), [[5, 5, -1e4]]]),
}


@each_method
@pytest.mark.parametrize("name", BAD)
def test_mask_has_the_length_of_any_invalid_cloud(method, name):
    xyz = np.asarray(BAD[name], np.float32)
    for intensity in (None, np.zeros(len(xyz), np.float32)):
        result = segment_xyz(xyz, method, intensity)
        assert result.dtype == bool and result.shape == (len(xyz),)
    if name in ("origin", "all NaN", "all infinite"):
        assert not result.any()


@each_method
def test_unusable_points_do_not_affect_the_others(method):
    xyz, _ = make_street(1)
    rng = np.random.default_rng(0)
    bad = np.float32([[np.nan] * 3, [np.inf, 0, 0], [0, 0, 0], [2e5, 0, -1], [1, np.nan, -2]])
    at = np.sort(rng.integers(0, len(xyz), 500))
    all_points = np.insert(xyz, at, bad[rng.integers(0, 5, 500)], axis=0)
    is_bad = np.insert(np.zeros(len(xyz), bool), at, True)
    intensity = rng.random(len(all_points)).astype(np.float32)
    result = segment_xyz(all_points, method, intensity)
    assert not result[is_bad].any()
    np.testing.assert_array_equal(result[~is_bad], segment_xyz(xyz, method, intensity[~is_bad]))


@each_method
def test_million_points_are_segmented(method):
    xyz, road = make_street(2, count=1_000_000)
    assert compute_f1(segment_xyz(xyz, method), road) > 0.95


@each_method
@pytest.mark.parametrize("height", [0.6, 2.5])
def test_each_method_uses_the_sensor_height(method, height):
    xyz, road = make_street(3)
    xyz[:, 2] += np.float32(1.73 - height)
    assert compute_f1(segment_xyz(xyz, method, sensor_pose=SensorPoseParams(height=height)), road) > 0.97


@each_method
@pytest.mark.parametrize("roll, pitch", [(0.05, 0.0), (0.0, 0.2), (-0.1, 0.3), (np.pi, 0.0), (np.pi, -0.1)])
def test_tilted_and_level_sensor_give_equal_ground(method, roll, pitch):
    xyz, _ = make_street(4)
    pose = SensorPoseParams(roll=float(np.float32(roll)), pitch=pitch)
    axes = level_points(np.eye(3, dtype=np.float32), pose)  # rows: the levelled axes
    tilted = xyz @ axes.T
    np.testing.assert_allclose(level_points(tilted, pose), xyz, atol=1e-4)
    result = segment_xyz(tilted, method, sensor_pose=pose)
    assert (result == segment_xyz(xyz, method)).mean() > 0.995


def test_pitch_and_roll_rotate_as_in_a_urdf():
    """With positive pitch, the sensor's x axis points down."""
    down = level_points(np.float32([[1, 0, 0]]), SensorPoseParams(pitch=0.1))
    np.testing.assert_allclose(down, [[np.cos(0.1), 0, -np.sin(0.1)]], atol=1e-6)
    left_up = level_points(np.float32([[0, 1, 0]]), SensorPoseParams(roll=0.1))
    np.testing.assert_allclose(left_up, [[0, np.cos(0.1), np.sin(0.1)]], atol=1e-6)
    xyz = np.ones((2, 3), np.float32)
    assert level_points(xyz, SensorPoseParams()) is xyz


def run_library(xyz, intensity, height=1.73, rnr=True):
    pypatchworkpp = pytest.importorskip("pypatchworkpp")
    settings = pypatchworkpp.Parameters()
    settings.sensor_height, settings.enable_RNR = height, rnr
    engine = pypatchworkpp.patchworkpp(settings)
    engine.estimateGround(np.column_stack([xyz, intensity]).astype(np.float32))
    result = np.zeros(len(xyz), bool)
    result[engine.getGroundIndices()] = True
    return result


def make_hilly_scene(seed):
    """Return points (N, 3) on slopes, raised plates, walls and reflections below the ground, and their intensity
    (N,). The scene contains every case that Patchwork++ distinguishes."""
    rng = np.random.default_rng(seed)
    distance, angle = 3 + 70 * rng.random(60_000) ** 2, rng.uniform(-np.pi, np.pi, 60_000)
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    z = -1.73 + 0.6 * np.sin(x / 15) + 0.02 * y + rng.normal(0, 0.02, len(x))
    plate = np.floor(x / 6) + 7 * np.floor(y / 6)
    z += np.where(plate % 5 == 0, 2.2, 0.0)  # roofs of cars, hedges
    wall = plate % 7 == 3
    z[wall] = rng.uniform(-1.7, 2.0, wall.sum())
    x[wall] = 6 * np.floor(x[wall] / 6) + rng.normal(0, 0.02, wall.sum())
    below = rng.random(len(x)) < 0.02
    z[below] -= 2.0
    return np.column_stack([x, y, z]).astype(np.float32), rng.random(len(x)).astype(np.float32)


@pytest.mark.parametrize("rnr", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_patchwork_equals_the_library_up_to_rounding(seed, rnr):
    xyz, intensity = make_hilly_scene(seed)
    expected = run_library(xyz, intensity, rnr=rnr)
    result = segment_by_patchwork(xyz, intensity if rnr else None, 1.73)
    assert 0.2 < expected.mean() < 0.8
    assert (result != expected).mean() < 1e-4


@needs_data
def test_patchwork_equals_the_library_on_a_real_scan():
    frame = open_recording(DATA / "semantickitti").frames[0].load()
    params = GroundParams(method="patchwork")
    off = GroundParams(method="patchwork", patchwork=PatchworkParams(remove_reflections=False))
    with_rnr, without = (run_library(frame.xyz, frame.intensity, rnr=r) for r in (True, False))
    assert (with_rnr != without).any()
    for result, expected in (
        (segment_ground(frame, params), with_rnr),
        (segment_ground(PointCloud(frame.xyz), params), without),
        (segment_ground(frame, off), without),
    ):
        assert (result != expected).sum() <= 20  # of 124,668 points, due to rounding at limits


@needs_data
@each_method
def test_permuting_points_of_a_real_scan_permutes_the_ground(method):
    frame = open_recording(DATA / "semantickitti").frames[0].load()
    order = np.random.default_rng(0).permutation(len(frame))
    result = segment_xyz(frame.xyz, method)
    assert (segment_xyz(frame.xyz[order], method) == result[order]).mean() > 0.99


@each_method
def test_input_is_not_modified(method):
    xyz, _ = make_street(6)
    before = xyz.copy()
    segment_xyz(xyz, method, np.ones(len(xyz), np.float32), sensor_pose=SensorPoseParams(pitch=0.1))
    np.testing.assert_array_equal(xyz, before)
