"""Laws that all methods of ground segmentation share, and of the sensor's pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from samples import DATA, needs_data
from test_cloth import f1, street

from lidar_perception.data.frame import Recording
from lidar_perception.data.open import open_recording
from lidar_perception.ground.params import (
    GROUND_METHODS,
    GroundParams,
    PatchworkParams,
    SensorPoseParams,
)
from lidar_perception.ground.segment import (
    METHODS,
    height_problem,
    level,
    measured_height,
    mount_problem,
    segment_ground,
)
from lidar_perception.types import LidarFrame

pypatchworkpp = pytest.importorskip("pypatchworkpp")
each_method = pytest.mark.parametrize("method", GROUND_METHODS)


def ground_of(xyz, method, intensity=None, **params):
    return segment_ground(LidarFrame(np.asarray(xyz, np.float32), intensity),
                          GroundParams(method=method, **params))


def test_every_method_of_the_parameters_exists():
    assert tuple(METHODS) == GROUND_METHODS


@each_method
def test_a_flat_road_is_ground_and_what_stands_on_it_is_not(method):
    xyz, road = street()
    near = np.hypot(xyz[:, 0], xyz[:, 1]) > 3  # Patchwork++ leaves out what is nearer
    assert f1(ground_of(xyz, method)[near], road[near]) > 0.97


BAD = {
    "empty": np.zeros((0, 3)), "one point": [[5, 0, -1.7]], "origin": np.zeros((50, 3)),
    "all NaN": np.full((50, 3), np.nan), "all infinite": np.full((50, 3), -np.inf),
    "all equal": np.full((50, 3), 4.0), "line": np.linspace(1, 9, 50)[:, None] * [1, 1, 0],
    "100 km": [[1e5, 0, 0], [0, 1e5, 1e5], [5, 5, -1.7]], "huge": np.full((5, 3), 3e38),
    "one below": np.concatenate([np.full((99, 3), 4.0), [[5, 5, -1e4]]]),
}


@each_method
@pytest.mark.parametrize("name", BAD)
def test_bad_clouds_give_a_mask_of_their_length(method, name):
    xyz = np.asarray(BAD[name], np.float32)
    for intensity in (None, np.zeros(len(xyz), np.float32)):
        found = ground_of(xyz, method, intensity)
        assert found.dtype == bool and found.shape == (len(xyz),)
    if name in ("origin", "all NaN", "all infinite"):
        assert not found.any()


@each_method
def test_unusable_points_take_no_part(method):
    xyz, _ = street(1)
    rng = np.random.default_rng(0)
    bad = np.float32([[np.nan] * 3, [np.inf, 0, 0], [0, 0, 0], [2e5, 0, -1], [1, np.nan, -2]])
    at = np.sort(rng.integers(0, len(xyz), 500))
    mixed = np.insert(xyz, at, bad[rng.integers(0, 5, 500)], axis=0)
    is_bad = np.insert(np.zeros(len(xyz), bool), at, True)
    intensity = rng.random(len(mixed)).astype(np.float32)
    found = ground_of(mixed, method, intensity)
    assert not found[is_bad].any()
    np.testing.assert_array_equal(found[~is_bad], ground_of(xyz, method, intensity[~is_bad]))


@each_method
def test_a_million_points(method):
    xyz, road = street(2, count=1_000_000)
    assert f1(ground_of(xyz, method), road) > 0.95


@each_method
@pytest.mark.parametrize("height", [0.6, 2.5])
def test_every_method_follows_the_height_of_the_sensor(method, height):
    xyz, road = street(3)
    xyz[:, 2] += np.float32(1.73 - height)
    assert f1(ground_of(xyz, method, sensor_pose=SensorPoseParams(height=height)), road) > 0.97


@each_method
@pytest.mark.parametrize("roll, pitch", [(0.05, 0.0), (0.0, 0.2), (-0.1, 0.3), (np.pi, 0.0),
                                         (np.pi, -0.1)])
def test_a_tilted_sensor_sees_the_ground_of_a_level_one(method, roll, pitch):
    """What a sensor sees that is mounted with roll and pitch is the level cloud turned back."""
    xyz, _ = street(4)
    pose = SensorPoseParams(roll=float(np.float32(roll)), pitch=pitch)
    turn = level(np.eye(3, dtype=np.float32), pose)  # its rows are the levelled axes
    tilted = xyz @ turn.T
    np.testing.assert_allclose(level(tilted, pose), xyz, atol=1e-4)
    found = ground_of(tilted, method, sensor_pose=pose)
    assert (found == ground_of(xyz, method)).mean() > 0.995


def test_pitch_and_roll_turn_as_in_a_urdf():
    """A sensor that looks down (positive pitch) sees the ground ahead in its own x."""
    down = level(np.float32([[1, 0, 0]]), SensorPoseParams(pitch=0.1))
    np.testing.assert_allclose(down, [[np.cos(0.1), 0, -np.sin(0.1)]], atol=1e-6)
    left_up = level(np.float32([[0, 1, 0]]), SensorPoseParams(roll=0.1))
    np.testing.assert_allclose(left_up, [[0, np.cos(0.1), np.sin(0.1)]], atol=1e-6)
    xyz = np.ones((2, 3), np.float32)
    assert level(xyz, SensorPoseParams()) is xyz


@pytest.mark.parametrize("height", [0.4, 1.73, 3.0])
def test_the_height_of_the_sensor_is_measured(height):
    xyz, _ = street(5, slope=(0.02, -0.01))
    xyz[:, 2] += np.float32(1.73 - height)
    found = measured_height(xyz)
    assert abs(found - height) < 0.03
    assert (height_problem(found, SensorPoseParams()) is None) == (height == 1.73)
    assert height_problem(found, SensorPoseParams(height=height)) is None
    assert abs(measured_height(xyz * np.float32([1, -1, -1])) + height) < 0.03


@pytest.mark.parametrize("lean", [0, 3, 8, -20])
def test_that_a_recordings_sensor_leans_is_said(lean):
    pose = SensorPoseParams(pitch=np.radians(lean))
    clouds = [LidarFrame.of(level(street(i)[0], pose)) for i in range(3)]
    recording = Recording(Path("drive.bag"), "bag", [])
    said = mount_problem(recording, clouds)
    assert (said is not None) == (abs(lean) > 5)
    assert said is None or (f"by {abs(lean)} degrees" in said and "drive.bag --robot" in said)
    down = [LidarFrame(cloud.xyz * np.float32([1, -1, -1])) for cloud in clouds]
    assert "upside down" in mount_problem(recording, down)
    assert mount_problem(recording, [LidarFrame.of(np.zeros((0, 3)))]) is None
    assert mount_problem(recording, []) is None


def test_height_problems_name_the_remedy():
    assert "set it to 0.60" in height_problem(0.6, SensorPoseParams())
    assert "upside down" in height_problem(-1.7, SensorPoseParams())
    assert height_problem(None, SensorPoseParams()) is None


def test_where_there_is_no_plane_no_height_is_measured():
    wall = np.random.default_rng(0).uniform(-9, 9, (5000, 3)) * [0, 1, 1] + [9, 0, 0]
    for xyz in (np.zeros((0, 3)), np.ones((1, 3)), wall, np.full((100, 3), 9.0)):
        assert measured_height(xyz.astype(np.float32)) is None
    ball = np.random.default_rng(1).normal(0, 8, (5000, 3))
    assert measured_height(ball.astype(np.float32)) is None


def bare_patchwork(xyz, intensity, height=1.73, rnr=True):
    settings = pypatchworkpp.Parameters()
    settings.sensor_height, settings.enable_RNR = height, rnr
    engine = pypatchworkpp.patchworkpp(settings)
    engine.estimateGround(np.column_stack([xyz, intensity]).astype(np.float32))
    found = np.zeros(len(xyz), bool)
    found[engine.getGroundIndices()] = True
    return found


@needs_data
def test_patchwork_is_the_library_on_the_first_cloud_and_silent(capfd):
    frame = open_recording(DATA / "semantickitti").frames[0].load()
    params = GroundParams(method="patchwork")
    found = [segment_ground(frame, params) for _ in range(3)]  # no memory from cloud to cloud
    assert capfd.readouterr().out == ""
    with_rnr, without = (bare_patchwork(frame.xyz, frame.intensity, rnr=r) for r in (True, False))
    assert (with_rnr != without).any()
    for mask in found:
        np.testing.assert_array_equal(mask, with_rnr)
    no_intensity = LidarFrame(frame.xyz)
    np.testing.assert_array_equal(segment_ground(no_intensity, params), without)
    off = GroundParams(method="patchwork", patchwork=PatchworkParams(remove_reflections=False))
    np.testing.assert_array_equal(segment_ground(frame, off), without)


@needs_data
@each_method
def test_on_the_real_scan_permuting_points_permutes_the_ground(method):
    frame = open_recording(DATA / "semantickitti").frames[0].load()
    order = np.random.default_rng(0).permutation(len(frame))
    found = ground_of(frame.xyz, method)
    assert (ground_of(frame.xyz[order], method) == found[order]).mean() > 0.99


@each_method
def test_the_frame_stays_as_it_is(method):
    xyz, _ = street(6)
    before = xyz.copy()
    ground_of(xyz, method, np.ones(len(xyz), np.float32), sensor_pose=SensorPoseParams(pitch=0.1))
    np.testing.assert_array_equal(xyz, before)
