"""Measurement times of a cloud's points, read from the time column of the sensor driver."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.robot.deskew import PoseLookup, deskew
from lidar_perception.types import InputError, PointCloud
from msg_utils.point_cloud2 import CloudError, add_columns, to_array
from msg_utils.stamps import SECOND_NS, to_ns

# Names used by Ouster, Velodyne, Hesai and RoboSense, Autoware and Livox; the first match counts.
NAMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset")
UNITS_NS = (10**9, 10**6, 10**3, 1)
LIVOX_COLUMN, LIVOX_UNIT_NS = ("offset_time", True), 1  # (name, is integer) and documented unit of Livox times
SWEEP_S = 2e-3, 1.0  # limits of the duration of a sweep, from which the unit is inferred
SINCE_1970_NS = 1e18  # larger values are Unix times
MAX_OFFSET_S = 1.0  # maximum offset of a point's time from the stamp of its cloud


class PointTimes(NamedTuple):
    """Measurement times of N points.

    Attributes:
        name: Name of the column.
        seconds: (N,) float64 time relative to the stamp of the cloud; NaN if the driver wrote NaN.
        at_stamp: Value of the column for a point that is measured at the stamp.
    """

    name: str
    seconds: np.ndarray
    at_stamp: int | float


def read_point_times(msg: Any, indices: np.ndarray) -> PointTimes:
    """Read the measurement times of the points of a PointCloud2 at indices (N,).

    The unit (s, ms, us or ns) is inferred from the time span of the cloud, which is one sweep of
    the sensor. Unix times are converted to times relative to the stamp. Zeros at other points are
    ignored, because drivers write them for beams without a return.

    Raises:
        InputError: There is no time column, no point has a time, or the times are too far from the
            stamp.
    """
    try:
        points = to_array(msg)
    except CloudError as error:
        raise InputError(str(error)) from None
    names = points.dtype.names or ()
    name = next((n for n in NAMES if n in names), None)
    if name is None:
        raise InputError(
            f"the cloud has no time column ({', '.join(NAMES)}); its columns are: {', '.join(names) or 'none'}"
        )
    if points.dtype[name].shape:
        raise InputError(f"field '{name}' has count > 1; it must have one number per point")
    is_integer = points[name].dtype.kind in "iu"
    column = points[name].astype(np.int64 if is_integer else np.float64)
    is_finite, values = np.isfinite(column), column.take(indices)
    finite_values = values[is_finite.take(indices)]
    if not len(finite_values):
        raise InputError(f"all times in the column '{name}' are NaN or infinite")
    is_measured = column != 0
    is_measured[indices] = True
    sweep_values = column[is_measured & is_finite]
    low, span = finite_values.min(), sweep_values.max() - sweep_values.min()
    unit = LIVOX_UNIT_NS if (name, is_integer) == LIVOX_COLUMN else _infer_unit_ns(float(span), is_integer, float(low))
    stamp = to_ns(msg.header.stamp)
    is_relative = abs(float(low)) * unit <= abs(float(low) * unit - stamp)
    at_stamp = 0 if is_relative else stamp // unit if is_integer else stamp / unit
    seconds = (values - at_stamp) * (unit * 1e-9)
    largest = max(float(np.nanmin(seconds)), float(np.nanmax(seconds)), key=abs)
    if abs(largest) > MAX_OFFSET_S:
        raise InputError(
            f"the times in '{name}' are {largest:.3f} s from header.stamp; are the "
            "clocks of sensor and computer synchronised?"
        )
    return PointTimes(name, seconds, at_stamp)


def _infer_unit_ns(span: float, is_integer: bool, low: float) -> int:
    """Infer the time unit in ns from the time span of one sweep and the lowest time."""
    unix_unit = next((unit for unit in reversed(UNITS_NS) if low * unit > SINCE_1970_NS), None)
    if unix_unit is not None:
        return unix_unit
    for unit in UNITS_NS[2:] if is_integer else UNITS_NS:  # s and ms are too coarse as integers
        if SWEEP_S[0] <= span * unit * 1e-9 <= SWEEP_S[1]:
            return unit
    return 1 if is_integer else 10**9  # reached for a cloud shorter than SWEEP_S


def deskew_points(
    msg: Any, frame: PointCloud, indices: np.ndarray, poses: PoseLookup
) -> tuple[np.ndarray, np.ndarray, PointTimes] | None:
    """Correct the motion of the sensor by transforming points to its pose at the stamp.

    Args:
        msg: PointCloud2 with a time column.
        frame: N points of this cloud.
        indices: (N,) indices of these points in `msg`.
        poses: Poses (K, 4, 4) of the sensor in a fixed frame, as a function of times (K,) in ns.

    Returns:
        Indices (M,) into `frame` of the points with a time, their corrected coordinates (M, 3), and
        their times. None if the frame is empty or all points were measured at the stamp.
    """
    if not len(indices):
        return None
    times = read_point_times(msg, indices)
    if not times.seconds.any():
        return None
    timed_indices, xyz = np.flatnonzero(np.isfinite(times.seconds)), frame.xyz
    if len(timed_indices) < len(frame):
        times = times._replace(seconds=times.seconds.take(timed_indices))
        xyz = xyz.take(timed_indices, axis=0)
    deskewed_xyz = deskew(
        xyz, times.seconds, lambda seconds: poses(frame.stamp_ns + np.rint(seconds * SECOND_NS).astype(np.int64))
    )
    return timed_indices, deskewed_xyz, times


def deskew_frame(msg: Any, frame: PointCloud, indices: np.ndarray, poses: PoseLookup) -> PointCloud:
    """Return the frame after motion correction, see deskew_points.

    Points without a time are not changed.
    """
    if (deskewed_points := deskew_points(msg, frame, indices, poses)) is None:
        return frame
    timed_indices, deskewed_xyz, _ = deskewed_points
    xyz = frame.xyz.copy()
    xyz[timed_indices] = deskewed_xyz
    return replace(frame, xyz=xyz)


def replace_points(msg: Any, make: Any, indices: np.ndarray, coordinates: np.ndarray, times: PointTimes) -> Any:
    """Return the message with new coordinates (N, 3) for the points at indices (N,).

    All times are set to the stamp, so that a second motion correction has no effect.
    """
    points = to_array(msg)
    columns = {}
    for axis, name in enumerate("xyz"):
        columns[name] = points[name].astype(points[name].dtype.newbyteorder("="))
        columns[name][indices] = coordinates[:, axis]
    time_type = points[times.name].dtype.newbyteorder("=")
    columns[times.name] = np.full(len(points), times.at_stamp, time_type)
    return add_columns(msg, make, **columns)
