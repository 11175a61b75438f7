"""When each point of a cloud was measured, from the column of times that its driver gives it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.robot.deskew import Poses, deskewed
from lidar_perception.types import InputError, LidarFrame
from msg_utils.point_cloud2 import CloudError, add_columns, to_array
from msg_utils.stamps import SECOND, to_ns

# As Ouster, Velodyne, Hesai and RoboSense, Autoware and Livox call it; the first that is there.
NAMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset")
UNITS_NS = (10**9, 10**6, 10**3, 1)
LIVOX_COLUMN, LIVOX_UNIT_NS = ("offset_time", True), 1  # whole numbers: the unit is documented
SWEEP = 2e-3, 1.0   # seconds that a turn takes: by these the unit is told from the others
SINCE_1970_NS = 1e18  # later than 2001
MAX_OFFSET = 1.0    # seconds between a point and the stamp of its cloud


class PointTimes(NamedTuple):
    """name: of the column; seconds (N,) float64 after the stamp, NaN where the driver says so;
    at_stamp: what the column says of a point that was measured at the stamp."""

    name: str
    seconds: np.ndarray
    at_stamp: int | float


def point_times(msg: Any, indices: np.ndarray) -> PointTimes:
    """Of the points (N,) of a PointCloud2 at indices (N,). Whether seconds, milli-, micro- or
    nanoseconds is told by the span of the whole cloud, of which indices may be any part, and which
    is taken for a turn; times that count from 1970 are taken from the stamp. Of other points 0 does
    not count: drivers fill beams without a return so. InputError where there is no such column,
    none of the points has a time, or they do not fit the stamp."""
    try:
        points = to_array(msg)
    except CloudError as error:
        raise InputError(str(error)) from None
    names = points.dtype.names or ()
    name = next((n for n in NAMES if n in names), None)
    if name is None:
        raise InputError(f"the cloud has no column of times ({', '.join(NAMES)}); it has "
                         f"{', '.join(names) or 'none at all'}")
    if points.dtype[name].shape:
        raise InputError(f"field '{name}' has count > 1; a single number is needed")
    whole = points[name].dtype.kind in "iu"
    column = points[name].astype(np.int64 if whole else np.float64)
    finite, values = np.isfinite(column), column.take(indices)
    known = values[finite.take(indices)]
    if not len(known):
        raise InputError(f"no time in the column '{name}' is a number")
    counts = column != 0
    counts[indices] = True
    turn = column[counts & finite]
    low, span = known.min(), turn.max() - turn.min()
    unit = LIVOX_UNIT_NS if (name, whole) == LIVOX_COLUMN else _unit_ns(float(span), whole,
                                                                        float(low))
    stamp = to_ns(msg.header.stamp)
    since_stamp = abs(float(low)) * unit <= abs(float(low) * unit - stamp)
    at_stamp = 0 if since_stamp else stamp // unit if whole else stamp / unit
    seconds = (values - at_stamp) * (unit * 1e-9)
    off = max(float(np.nanmin(seconds)), float(np.nanmax(seconds)), key=abs)
    if abs(off) > MAX_OFFSET:
        raise InputError(f"the times in '{name}' are {off:.3f} s from header.stamp; do sensor and "
                         "computer have the same clock?")
    return PointTimes(name, seconds, at_stamp)


def _unit_ns(span: float, whole: bool, low: float) -> int:
    """Nanoseconds of the unit of times from low on, of a cloud that spans a turn."""
    since_1970 = next((unit for unit in reversed(UNITS_NS) if low * unit > SINCE_1970_NS), None)
    if since_1970 is not None:
        return since_1970
    for unit in UNITS_NS[2:] if whole else UNITS_NS:  # whole seconds would tell nothing
        if SWEEP[0] <= span * unit * 1e-9 <= SWEEP[1]:
            return unit
    return 1 if whole else 10**9  # a cloud of less than SWEEP, or one moment


def corrected(msg: Any, frame: LidarFrame, indices: np.ndarray, poses: Poses
              ) -> tuple[np.ndarray, np.ndarray, PointTimes] | None:
    """Of the N points of a frame, which are those of a PointCloud2 at indices (N,): which of them
    (M,) have a time, these (M, 3) moved to the stamp, and their times; None where all times are
    those of the stamp already, and of no points. poses: of the sensor (K, 4, 4), in any frame that
    does not move, at times (K,) ns."""
    if not len(indices):
        return None
    times = point_times(msg, indices)
    if not times.seconds.any():
        return None
    known, xyz = np.flatnonzero(np.isfinite(times.seconds)), frame.xyz
    if len(known) < len(frame):
        times = times._replace(seconds=times.seconds.take(known))
        xyz = xyz.take(known, axis=0)
    moved = deskewed(xyz, times.seconds, lambda at: poses(
        frame.stamp_ns + np.rint(at * SECOND).astype(np.int64)))
    return known, moved, times


def moved_to_stamp(msg: Any, frame: LidarFrame, indices: np.ndarray, poses: Poses) -> LidarFrame:
    """The frame with its points moved to its stamp, see corrected(); those without a time stay."""
    if (found := corrected(msg, frame, indices, poses)) is None:
        return frame
    xyz = frame.xyz.copy()
    xyz[found[0]] = found[1]
    return replace(frame, xyz=xyz)


def moved_cloud(msg: Any, make: Any, indices: np.ndarray, moved: np.ndarray,
                times: PointTimes) -> Any:
    """The cloud with the points at indices (N,) moved to (N, 3), and all times at its stamp, so
    that who corrects it again changes nothing."""
    points = to_array(msg)
    new = {}
    for axis, name in enumerate("xyz"):
        new[name] = points[name].astype(points[name].dtype.newbyteorder("="))
        new[name][indices] = moved[:, axis]
    kind = points[times.name].dtype.newbyteorder("=")
    new[times.name] = np.full(len(points), times.at_stamp, kind)
    return add_columns(msg, make, **new)
