"""Clouds in the driver's format, and the meaning of their columns."""

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

# Columns with the beam number, as named by Velodyne and Ouster, Hesai and Nebula, Livox, RoboSense
# and others.
RING_FIELDS = ("ring", "channel", "line", "laser_id", "laser_number", "row")
MAX_MEDIAN_RANGE_M = 250.0  # maximum for a cloud in metres in the sensor's frame
MAX_SPREAD_M = 200.0  # maximum median distance to the cloud's centre for a cloud in metres in another frame
MIN_ELEVATION_SPAN = 1.0  # in degrees; a sensor with a smaller span scans a plane
MIN_POINTS = 100  # minimum number of usable points of a cloud


class Scan(NamedTuple):
    """N usable points of a cloud, in the driver's order.

    Attributes:
        xyz: (N, 3) float64, m.
        azimuth: (N,) degrees, 0 .. 360, counter-clockwise from x.
        elevation: (N,) degrees above the horizon of the sensor.
        range: (N,) m from the sensor.
        ground_range: (N,) m from the z axis.
        intensity: (N,) float64 in the cloud's own scale, or None.
        ring: (N,) int64 number of the beam, or None.
        seconds: (N,) float64 after the stamp, or None.
        stamp_ns: Stamp of the cloud, ns.
        frame_id: Frame of the cloud.
        columns: Names of the cloud's columns.
        time_problem: Why its times cannot be read; "" if they can, or without any.
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
    """Return a PointCloud2 as a Scan.

    Raises:
        InputError: It has too few usable points, or its coordinates cannot be metres.
    """
    try:
        frame, indices = to_point_cloud(msg)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    if len(frame) < MIN_POINTS:
        raise InputError(
            f"{name} has {len(frame)} usable points, too few to measure the sensor; "
            "record while it turns, in a place with walls or ground in view"
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
    """Raise InputError if points (N, 3), N > 0, cannot be metres from their sensor."""
    median_range = float(np.median(np.linalg.norm(xyz, axis=1)))
    if median_range <= MAX_MEDIAN_RANGE_M:
        return
    if np.median(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)) < MAX_SPREAD_M:
        raise InputError(
            f"{name}: half of its points are farther than {median_range:.0f} m from "
            "the origin and near each other, so it is in a frame such as map; give "
            "the driver's own cloud"
        )
    raise InputError(
        f"{name}: half of its points are farther than {median_range:.0f} m, so its "
        "coordinates seem to be millimetres; divide x y z by 1000 in the driver"
    )


def require_3d(degrees: np.ndarray, name: str) -> None:
    """Raise InputError if elevations (N,), N > 0, in degrees, are all in one plane."""
    if np.subtract(*np.percentile(degrees, [99, 1])) < MIN_ELEVATION_SPAN:
        raise InputError(f"{name}: all points are in one plane, as from a 2D scanner; give clouds of a 3D LiDAR")


def _read_column(points: np.ndarray, indices: np.ndarray, names: Sequence[str], kind: type) -> np.ndarray | None:
    name = next((n for n in names if n in (points.dtype.names or ())), None)
    if name is None or points.dtype[name].shape:
        return None
    return points[name].take(indices).astype(kind)


class IntensityScale(NamedTuple):
    """Intensities of all scans together.

    Attributes:
        full: Value of a full reflection, see intensity.infer_full_scale; the greatest value if
            that is far beyond it.
        sure: The values show the scale.
        whole: All values are whole numbers.
        greatest: Greatest value.
        zeros: Share of returns with intensity 0.
    """

    full: float
    sure: bool
    whole: bool
    greatest: float
    zeros: float


def measure_intensity(scans: Sequence[Scan]) -> IntensityScale | None:
    """Return the scale of the intensities; None without any, or if all are equal."""
    found = [scan.intensity for scan in scans if scan.intensity is not None]
    values = np.concatenate(found) if found else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values) or values.min() == values.max():
        return None
    greatest = float(values.max())
    sample = values[:: max(1, len(values) // 10_000)]  # sampled over all scans, because one may begin with zeros
    whole = bool((sample == np.round(sample)).all())
    # No known driver sends whole numbers up to 1 as floats, so they count as integers.
    full = infer_full_scale(values, np.int64 if whole else values.dtype)
    if greatest > MAX_UNIT * full:
        full = greatest
    return IntensityScale(full, full <= 1.0 or greatest > 0.5 * full, whole, greatest, float((values == 0).mean()))
