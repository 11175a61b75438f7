"""Times of points in the units, types and column names of various drivers."""

from __future__ import annotations

import numpy as np
import pytest
from samples import STAMP, make_any_header

from lidar_perception.types import InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import to_point_cloud
from lidar_perception.wire.point_times import read_point_times, replace_points
from msg_utils.point_cloud2 import from_array, to_array

SECONDS = np.linspace(0.0, 0.0999, 1000)
ABSOLUTE = STAMP + np.rint(SECONDS * 1e9).astype(np.int64)
DRIVERS = {  # column, values
    "Ouster": ("t", np.rint(SECONDS * 1e9).astype("<u4")),
    "Velodyne": ("time", SECONDS.astype("<f4")),
    "Velodyne, stamp at the end": ("time", (SECONDS - 0.0999).astype("<f4")),
    "Hesai, RoboSense": ("timestamp", STAMP * 1e-9 + SECONDS),
    "Livox PointCloud2": ("timestamp", ABSOLUTE.astype("<f8")),
    "Livox custom": ("offset_time", np.rint(SECONDS * 1e9).astype("<u4")),
    "Autoware": ("time_stamp", np.rint(SECONDS * 1e9).astype("<u4")),
    "microseconds": ("t", np.rint(SECONDS * 1e6).astype("<u4")),
    "milliseconds": ("time", (SECONDS * 1e3).astype("<f4")),
    "microseconds since 1970": ("timestamp", (ABSOLUTE // 1000).astype("<f8")),
}


def cloud(name, values, order="<"):
    kind = order + values.dtype.str[1:]
    points = np.zeros(
        len(values),
        [("x", f"{order}f4"), ("y", f"{order}f4"), ("z", f"{order}f8"), ("intensity", f"{order}f4"), (name, kind)],
    )
    points["x"], points["y"], points[name] = 5.0, np.arange(len(values)), values
    return from_array(points, make_any_header(make_bag_message), make_bag_message)


def all_indices(msg):
    return np.arange(msg.width)


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("order", "<>")
def test_times_of_every_driver_are_read_in_seconds(driver, order):
    name, values = DRIVERS[driver]
    msg = cloud(name, values, order)
    expected = SECONDS - (0.0999 if "end" in driver else 0.0)
    times = read_point_times(msg, all_indices(msg))
    assert times.name == name
    np.testing.assert_allclose(times.seconds, expected, atol=2e-6)
    for some in ([7, 3, 999], [500], range(500, 505)):  # the last one spans only 0.4 ms
        np.testing.assert_array_equal(read_point_times(msg, np.array(some)).seconds, times.seconds[some])


@pytest.mark.parametrize("driver", DRIVERS)
def test_motion_compensated_points_have_the_time_of_the_stamp(driver):
    name, values = DRIVERS[driver]
    msg = cloud(name, values)
    rows = np.arange(0, 1000, 3)
    frame, _ = to_point_cloud(msg)
    moved_xyz = frame.xyz[rows] + np.float32([1, 2, 3])
    times = read_point_times(msg, rows)
    after = replace_points(msg, make_bag_message, rows, moved_xyz, times)
    assert [f.name for f in after.fields] == [f.name for f in msg.fields]
    assert (after.point_step, after.width) == (msg.point_step, msg.width)
    np.testing.assert_array_equal(to_point_cloud(after)[0].xyz[rows], moved_xyz)
    others = np.setdiff1d(all_indices(msg), rows)
    np.testing.assert_array_equal(
        to_array(after)[others][["x", "y", "z", "intensity"]], to_array(msg)[others][["x", "y", "z", "intensity"]]
    )
    np.testing.assert_allclose(read_point_times(after, all_indices(msg)).seconds, 0.0, atol=1e-6)


def test_time_unit_of_a_short_cloud_follows_the_type():
    for name, values, seconds in [
        ("t", np.array([4_000_000, 4_000_001], "<u4"), [4e-3, 4e-3]),
        ("time", np.array([0.01, 0.0105], "<f4"), [0.01, 0.0105]),
        ("timestamp", np.array([STAMP, STAMP + 10**6], "<f8"), [0.0, 1e-3]),
    ]:
        msg = cloud(name, values)
        times = read_point_times(msg, all_indices(msg))
        np.testing.assert_allclose(times.seconds, seconds, atol=1e-6)


def test_nan_times_stay_nan():
    values = SECONDS.copy()
    values[::10] = np.nan
    seconds = read_point_times(cloud("time", values), np.arange(1000)).seconds
    np.testing.assert_array_equal(np.isnan(seconds), np.isnan(values))


@pytest.mark.parametrize(
    "name, values, words",
    [
        ("ring", np.arange(9, dtype="<u2"), "no time column .*are: x, y, z, intensity, ring"),
        ("timestamp", STAMP * 1e-9 + SECONDS + 37.0, "37.100 s from header.stamp; are the clocks"),
        ("t", np.array([0, 3 * 10**9], "<u4"), "3.000 s from header.stamp"),
        ("time", np.full(5, np.nan), "all times in the column 'time' are NaN"),
        ("time", np.zeros((5, 2), "<f4"), "count > 1"),
    ],
)
def test_unusable_times_are_reported(name, values, words):
    points = np.zeros(
        len(values), [(n, "<f4") for n in ("x", "y", "z", "intensity")] + [(name, values.dtype, values.shape[1:])]
    )
    points[name] = values
    msg = from_array(points, make_any_header(make_bag_message), make_bag_message)
    with pytest.raises(InputError, match=words):
        read_point_times(msg, all_indices(msg))


def test_times_of_missing_returns_are_ignored():
    """Drivers fill organised clouds with zeros for beams without a return."""
    values = np.where(np.arange(1000) % 3, STAMP * 1e-9 + SECONDS, 0.0)
    msg, returns = cloud("timestamp", values), np.flatnonzero(np.arange(1000) % 3)
    for some in (returns, returns[500:503]):
        np.testing.assert_allclose(read_point_times(msg, some).seconds, SECONDS[some], atol=1e-6)
    one = np.full(1000, np.nan)
    one[0] = 0.05
    with pytest.raises(InputError, match="are NaN or infinite"):
        read_point_times(cloud("time", one), np.arange(1, 1000))
