"""Crop of a cloud by range, body and sectors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import make_any_header, make_scene
from scipy.spatial.transform import Rotation

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.param_fields import with_values
from lidar_perception.robot.crop import crop_frame, select_points
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placement import find_level_transform, make_tilted_pose
from lidar_perception.robot.poses import invert_pose, transform_points
from lidar_perception.types import PointCloud
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import to_point_cloud
from msg_utils.point_cloud2 import from_array

BODY = (-1.0, -0.6, -1.7, 2.0, 0.6, 0.2)
CROP = CropParams(body=BODY, min_range=1.0, max_range=15.0, sectors=(170.0, 190.0, -60.0, -45.0))


def make_points(count=5000, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.uniform(-20, 20, (count, 3)) * rng.uniform(0, 1, (count, 1))).astype(np.float32)


def is_kept(point, params):
    """Return True if a plain implementation keeps the point."""
    x, y, z = map(float, point)
    distance = np.sqrt(x * x + y * y + z * z)
    if distance < params.min_range or (params.max_range and distance > params.max_range):
        return False
    low, high = params.body[:3], params.body[3:]
    if params.body and all(a < v < b for a, v, b in zip(low, (x, y, z), high)):
        return False
    azimuth = np.degrees(np.arctan2(y, x))
    for start, end in zip(params.sectors[::2], params.sectors[1::2]):
        if any(start <= azimuth + turn <= end for turn in range(-1080, 1081, 360)):
            return False
    return True


@pytest.mark.parametrize(
    "params",
    [
        CropParams(),
        CropParams(body=BODY),
        CropParams(min_range=5.0),
        CropParams(max_range=5.0),
        CropParams(sectors=(350.0, 370.0)),
        CropParams(sectors=(-190.0, -170.0, 30.0, 31.0)),
        CropParams(sectors=(0.0, 360.0)),
        CROP,
    ],
)
def test_crop_equals_plain_implementation(params):
    xyz = make_points()
    expected = [is_kept(p, params) for p in xyz]
    np.testing.assert_array_equal(select_points(xyz, params), expected)
    if params.enabled:
        assert 0 < len(xyz) - sum(expected)


@given(st.integers(0, 1000), st.floats(-180, 180))
def test_rotated_sector_keeps_rotated_points(seed, angle):
    xyz = make_points(200, seed).astype(np.float64)
    rotated = Rotation.from_euler("z", angle, degrees=True).apply(xyz)
    edges = np.array([20.0, 75.0])
    near = np.abs((np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))[:, None] - edges + 180) % 360 - 180).min(axis=1) < 1e-6
    before = select_points(xyz, CropParams(sectors=tuple(edges)))
    after = select_points(rotated, CropParams(sectors=tuple(edges + angle)))
    np.testing.assert_array_equal(before[~near], after[~near])


def test_body_crop_applies_in_the_base_frame():
    base = np.eye(4)
    base[:3, :3] = Rotation.from_euler("zyx", [2.0, 0.4, -0.3]).as_matrix()
    base[:3, 3] = 0.5, -0.2, 1.1
    xyz = make_points().astype(np.float64)
    np.testing.assert_array_equal(
        select_points(xyz, CropParams(body=BODY), base),
        select_points(xyz @ base[:3, :3].T + base[:3, 3], CropParams(body=BODY)),
    )


@pytest.mark.parametrize("roll, pitch, ahead", [(0, 0, 180), (180, 0, 0), (15, -20, 90)])
def test_cropped_sectors_do_not_depend_on_the_mount(roll, pitch, ahead):
    level = find_level_transform(make_tilted_pose(*np.radians([roll, pitch])), np.radians(ahead))
    straight = make_points().astype(np.float64)
    params = CropParams(sectors=(150.0, 210.0, 60.0, 90.0), min_range=2.0)
    np.testing.assert_array_equal(
        select_points(transform_points(straight, invert_pose(level)), params, level=level),
        select_points(straight, params),
    )


def test_disabled_crop_returns_the_same_frame():
    frame = PointCloud(make_points())
    indices, same = crop_frame(frame, CropParams())
    assert same is frame and indices.tolist() == list(range(len(frame)))


def test_cropping_before_or_inside_the_pipeline_is_equivalent():
    """Indices refer to the given cloud, and a second crop removes nothing."""
    frame = PointCloud(np.ascontiguousarray(make_scene()[:, :3]))
    params = with_values(PipelineParams(), {"crop.min_range": 4.0, "crop.sectors": (90.0, 270.0)})
    kept_rows, before = crop_frame(frame, params.crop)
    assert 0 < len(kept_rows) < len(frame)
    whole, part = segment_cloud(frame, params=params), segment_cloud(before)
    np.testing.assert_array_equal(whole.indices, kept_rows.take(part.indices))
    for name in ("xyz", "ground", "cluster_ids", "boxes"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(part, name))
    assert len(crop_frame(before, params.crop)[0]) == len(before)


def test_cropped_message_has_points_of_cropped_frame():
    cloud = np.zeros(300, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    for i, name in enumerate("xyz"):
        cloud[name] = make_points(300)[:, i]
    cloud["x"][::7] = np.nan
    frame, usable = to_point_cloud(from_array(cloud, make_any_header(make_bag_message), make_bag_message))
    kept_rows, _ = crop_frame(frame, CROP)
    finite = np.isfinite(cloud["x"])
    np.testing.assert_array_equal(
        usable.take(kept_rows), np.flatnonzero(finite & select_points(make_points(300), CROP))
    )


@pytest.mark.parametrize(
    "values, words",
    [
        ({"body": (0.0, 1.0)}, "must be empty or"),
        ({"body": (1.0, 0.0, 0.0, 1.0, 1.0, 1.0)}, "min below its max"),
        ({"body": (0.0, 0.0, 0.0, 1.0, 1.0, float("inf"))}, "finite"),
        ({"sectors": (1.0,)}, "even number of values"),
        ({"min_range": 5.0, "max_range": 4.0}, "at least min_range"),
    ],
)
def test_error_for_invalid_crop_names_the_remedy(values, words):
    with pytest.raises(ValueError, match=words):
        CropParams(**values)
