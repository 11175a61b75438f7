"""Raw clouds of a driver, and the scale of their intensity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.geometry import elevation_angles
from lidar_perception.intensity import INTENSITY_FIELDS, MAX_UNIT, infer_full_scale
from lidar_perception.types import InputError
from lidar_perception.wire.messages import to_point_cloud
from lidar_perception.wire.point_times import NAMES as TIMES
from lidar_perception.wire.point_times import read_point_times
from msg_utils.point_cloud2 import to_array

# Names of the beam number column in the drivers of Velodyne, Ouster, Hesai, Nebula, Livox and RoboSense.
RING_FIELDS = ("ring", "channel", "line", "laser_id", "laser_number", "row")
MAX_MEDIAN_RANGE_M = 250.0  # maximum median range of a cloud in metres in the sensor's frame
# A distant cloud with a smaller median distance to its own centre is in another frame, such as map. With a
# larger one, its coordinates are not metres.
MAX_SPREAD_M = 200.0
MIN_ELEVATION_SPAN = 1.0  # minimum span of the elevations of a 3D sensor, in degrees
MIN_POINTS = 100  # minimum number of usable points of a cloud


class Scan(NamedTuple):
    """N usable points of a cloud, in the order of the driver.

    Attributes:
        xyz: (N, 3) float64, m.
        azimuth: (N,) degrees, 0 .. 360, counter-clockwise from x.
        elevation: (N,) degrees above the horizon of the sensor.
        range: (N,) m from the sensor.
        ground_range: (N,) m from the z axis.
        intensity: (N,) float64 in the scale of the cloud, or None.
        ring: (N,) int64 beam number, or None.
        seconds: (N,) float64 seconds relative to the stamp, or None.
        stamp_ns: Stamp of the cloud, ns.
        frame_id: Frame of the cloud.
        columns: Names of the cloud's columns.
        time_problem: Reason why the time column cannot be read, "" for none.
    """

    xyz: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    range: np.ndarray
    ground_range: np.ndarray
    intensity: np.ndarray | None
    ring: np.ndarray | None
    seconds: np.ndarray | None
    stamp_ns: int
    frame_id: str
    columns: tuple[str, ...]
    time_problem: str = ""


def read_scan(msg: Any, name: str = "the cloud") -> Scan:
    """Convert a PointCloud2 to a Scan.

    Args:
        msg: sensor_msgs/PointCloud2.
        name: Name of the cloud in error messages.

    Raises:
        InputError: The cloud has too few usable points, or its coordinates are not metres in the
            sensor's frame.
    """
    try:
        frame, indices = to_point_cloud(msg)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    if len(frame) < MIN_POINTS:
        raise InputError(
            f"{name} has {len(frame)} usable points, too few to measure the sensor; "
            "record while the sensor spins, with walls or ground in view"
        )
    xyz = frame.xyz.astype(np.float64)
    ranges = np.linalg.norm(xyz, axis=1)
    _require_metres(xyz, name)
    points = to_array(msg)
    columns = points.dtype.names or ()
    seconds, problem = None, ""
    if any(column in columns for column in TIMES):
        try:
            seconds = read_point_times(msg, indices).seconds
        except InputError as error:
            problem = str(error)
    ground_range = np.hypot(xyz[:, 0], xyz[:, 1])
    return Scan(
        xyz,
        np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])) % 360.0,
        np.degrees(elevation_angles(xyz)),
        ranges,
        ground_range,
        _read_column(points, indices, INTENSITY_FIELDS, float),
        _read_column(points, indices, RING_FIELDS, np.int64),
        seconds,
        frame.stamp_ns,
        frame.frame_id,
        columns,
        problem,
    )


def _require_metres(xyz: np.ndarray, name: str) -> None:
    """Raise InputError if points (N, 3), N > 0, cannot be in metres in the sensor's frame."""
    median_range = float(np.median(np.linalg.norm(xyz, axis=1)))
    if median_range <= MAX_MEDIAN_RANGE_M:
        return
    if np.median(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)) < MAX_SPREAD_M:
        raise InputError(
            f"{name}: half of the points are farther than {median_range:.0f} m from the origin, but close to each "
            "other, so the cloud is in a frame such as map; use the driver's own cloud"
        )
    raise InputError(
        f"{name}: half of the points are farther than {median_range:.0f} m, so the coordinates are probably "
        "millimetres; divide x y z by 1000 in the driver"
    )


def require_3d(degrees: np.ndarray, name: str) -> None:
    """Raise InputError if the elevations (N,), N > 0, in degrees, are those of a 2D scanner."""
    if np.subtract(*np.percentile(degrees, [99, 1])) < MIN_ELEVATION_SPAN:
        raise InputError(f"{name}: all points are in one plane, like those of a 2D scanner; use clouds of a 3D LiDAR")


def _read_column(points: np.ndarray, indices: np.ndarray, names: Sequence[str], dtype: type) -> np.ndarray | None:
    name = next((n for n in names if n in (points.dtype.names or ())), None)
    if name is None or points.dtype[name].shape:
        return None
    return points[name].take(indices).astype(dtype)


class IntensityScale(NamedTuple):
    """Scale of the intensities of all scans.

    Attributes:
        full_scale: Value of a full reflection, see intensity.infer_full_scale; the maximum value if
            that is far larger.
        is_certain: True if the values are large enough to determine the scale.
        is_integer: True if all values are integers.
        maximum: Maximum value.
        zero_fraction: Fraction of returns with intensity 0.
    """

    full_scale: float
    is_certain: bool
    is_integer: bool
    maximum: float
    zero_fraction: float


def measure_intensity(scans: Sequence[Scan]) -> IntensityScale | None:
    """Measure the scale of the intensities; None if there are none, or if all are equal."""
    values = np.concatenate([np.zeros(0), *(scan.intensity for scan in scans if scan.intensity is not None)])
    values = values[np.isfinite(values)]
    if not len(values) or values.min() == values.max():
        return None
    maximum = float(values.max())
    sample = values[:: max(1, len(values) // 10_000)]  # from all scans, because one may begin with zeros
    is_integer = bool((sample == np.round(sample)).all())
    # Float columns with only integer values are treated as integers, even if the maximum is 1.
    full_scale = infer_full_scale(values, np.int64 if is_integer else values.dtype)
    if maximum > MAX_UNIT * full_scale:
        full_scale = maximum
    is_certain = full_scale <= 1.0 or maximum > 0.5 * full_scale
    return IntensityScale(full_scale, is_certain, is_integer, maximum, float((values == 0).mean()))
