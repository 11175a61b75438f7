"""Measurement times of the points of a cloud, from the time column of its driver."""

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
LIVOX_COLUMN, LIVOX_UNIT_NS = ("offset_time", True), 1  # integers, whose unit Livox documents
SWEEP_S = 2e-3, 1.0  # limits of the duration of a sweep, from which the unit is inferred
SINCE_1970_NS = 1e18  # larger values are Unix times
MAX_OFFSET_S = 1.0  # maximum offset of a point's time from the stamp of its cloud


class PointTimes(NamedTuple):
    """Measurement times of N points.

    Attributes:
        name: name of the column.
        seconds: (N,) float64, relative to the stamp of the cloud; NaN where the driver wrote NaN.
        at_stamp: value of the column for a point measured at the stamp.
    """

    name: str
    seconds: np.ndarray
    at_stamp: int | float


def read_point_times(msg: Any, indices: np.ndarray) -> PointTimes:
    """Read the measurement times of the points (N,) of a PointCloud2 at indices (N,).

    The unit (s, ms, us or ns) is inferred from the time span of the cloud, which is one turn of the
    sensor. Times since 1970 are converted to times relative to the stamp. Zeros at other points
    are ignored, as drivers write them for beams without return.

    Raises:
        InputError: there is no such column, no point has a time, or the times do not fit the stamp.
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
    finite, values = np.isfinite(column), column.take(indices)
    finite_values = values[finite.take(indices)]
    if not len(finite_values):
        raise InputError(f"all times in the column '{name}' are NaN or infinite")
    counts = column != 0
    counts[indices] = True
    turn_values = column[counts & finite]
    low, span = finite_values.min(), turn_values.max() - turn_values.min()
    unit = LIVOX_UNIT_NS if (name, is_integer) == LIVOX_COLUMN else _unit_ns(float(span), is_integer, float(low))
    stamp = to_ns(msg.header.stamp)
    since_stamp = abs(float(low)) * unit <= abs(float(low) * unit - stamp)
    at_stamp = 0 if since_stamp else stamp // unit if is_integer else stamp / unit
    seconds = (values - at_stamp) * (unit * 1e-9)
    largest = max(float(np.nanmin(seconds)), float(np.nanmax(seconds)), key=abs)
    if abs(largest) > MAX_OFFSET_S:
        raise InputError(
            f"the times in '{name}' are {largest:.3f} s from header.stamp; are the "
            "clocks of sensor and computer synchronised?"
        )
    return PointTimes(name, seconds, at_stamp)


def _unit_ns(span: float, is_integer: bool, low: float) -> int:
    """Infer the time unit in ns from the time span of one turn and the lowest time."""
    since_1970 = next((unit for unit in reversed(UNITS_NS) if low * unit > SINCE_1970_NS), None)
    if since_1970 is not None:
        return since_1970
    for unit in UNITS_NS[2:] if is_integer else UNITS_NS:  # s and ms are too coarse as integers
        if SWEEP_S[0] <= span * unit * 1e-9 <= SWEEP_S[1]:
            return unit
    return 1 if is_integer else 10**9  # reached for a cloud shorter than SWEEP_S


def deskew_points(
    msg: Any, frame: PointCloud, indices: np.ndarray, poses: PoseLookup
) -> tuple[np.ndarray, np.ndarray, PointTimes] | None:
    """Correct the motion of the sensor: transform points to its pose at the stamp.

    Args:
        msg: PointCloud2 with a time column.
        frame: N of its points.
        indices: (N,) indices of these points in `msg`.
        poses: returns the poses (K, 4, 4) of the sensor in a fixed frame at times (K,) ns.

    Returns:
        Indices (M,) into `frame` of the points with a time, their new coordinates (M, 3), and their
        times. None if the frame is empty or all points were measured at the stamp.
    """
    if not len(indices):
        return None
    times = read_point_times(msg, indices)
    if not times.seconds.any():
        return None
    timed, xyz = np.flatnonzero(np.isfinite(times.seconds)), frame.xyz
    if len(timed) < len(frame):
        times = times._replace(seconds=times.seconds.take(timed))
        xyz = xyz.take(timed, axis=0)
    moved = deskew(
        xyz, times.seconds, lambda seconds: poses(frame.stamp_ns + np.rint(seconds * SECOND_NS).astype(np.int64))
    )
    return timed, moved, times


def deskew_frame(msg: Any, frame: PointCloud, indices: np.ndarray, poses: PoseLookup) -> PointCloud:
    """Return the frame after motion correction, see deskew_points. Points without a time stay."""
    if (deskewed_points := deskew_points(msg, frame, indices, poses)) is None:
        return frame
    timed, moved, _ = deskewed_points
    xyz = frame.xyz.copy()
    xyz[timed] = moved
    return replace(frame, xyz=xyz)


def replace_points(msg: Any, make: Any, indices: np.ndarray, moved: np.ndarray, times: PointTimes) -> Any:
    """Return the message with new coordinates `moved` (N, 3) of the points at indices (N,).

    All times are set to the stamp, so that a second motion correction has no effect.
    """
    points = to_array(msg)
    columns = {}
    for axis, name in enumerate("xyz"):
        columns[name] = points[name].astype(points[name].dtype.newbyteorder("="))
        columns[name][indices] = moved[:, axis]
    kind = points[times.name].dtype.newbyteorder("=")
    columns[times.name] = np.full(len(points), times.at_stamp, kind)
    return add_columns(msg, make, **columns)
