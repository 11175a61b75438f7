"""A cloud as a driver gave it, and what its columns are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.geometry import elevation_angles
from lidar_perception.intensity import INTENSITY_FIELDS, MAX_UNIT, infer_full_scale
from lidar_perception.types import InputError
from lidar_perception.wire.messages import to_frame
from lidar_perception.wire.point_times import NAMES as TIMES
from lidar_perception.wire.point_times import read_point_times
from msg_utils.point_cloud2 import to_array

# As Velodyne and Ouster, Hesai and Nebula, Livox, RoboSense and others call the number of the beam.
RINGS = ("ring", "channel", "line", "laser_id", "laser_number", "row")
FAR = 250.0         # metres; a cloud whose middle range is farther is in millimetres, or far from
TOGETHER = 200.0    # its origin: if half of its points are so near to their own middle
FLAT = 1.0          # degrees: a sensor whose returns are within this sees in one plane
MIN_POINTS = 100    # usable ones, of a cloud that says anything
RETROREFLECTOR = 0.9  # of the full intensity, from which on returns count as a retroreflector's


class Scan(NamedTuple):
    """The N usable points of a cloud in the driver's order: xyz (N, 3) float64 m; azimuth (N,)
    degrees, 0 .. 360, counter-clockwise from x, elevation (N,) degrees above the sensor's own
    horizon, range (N,) m from the sensor, ground_range (N,) m from its axis; intensity (N,) float64
    as it is in the cloud, ring (N,) int64 and seconds (N,) float64 after the stamp, each None where
    there is no such column; columns: the names in the cloud; time_problem: why its times cannot be
    read, "" where they can or are not there."""

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


def scan_of(msg: Any, name: str = "the cloud") -> Scan:
    """A PointCloud2 as a Scan. InputError where it has too few usable points, or its coordinates
    cannot be metres."""
    try:
        frame, indices = to_frame(msg)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    if len(frame) < MIN_POINTS:
        raise InputError(f"{name} has {len(frame)} usable points, which say nothing of the sensor; "
                         "record while it turns, in a place with walls or ground in sight")
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
    return Scan(xyz, np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])) % 360.0,
                np.degrees(elevation_angles(xyz)), ranges, ground_range,
                _column(points, indices, INTENSITY_FIELDS, float),
                _column(points, indices, RINGS, np.int64), seconds, frame.stamp_ns, frame.frame_id,
                columns, problem)


def _require_metres(xyz: np.ndarray, name: str) -> None:
    """InputError where the points (N, 3) of a cloud, N > 0, cannot be metres from its sensor."""
    middle = float(np.median(np.linalg.norm(xyz, axis=1)))
    if middle <= FAR:
        return
    if np.median(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)) < TOGETHER:
        raise InputError(f"{name}: half of its points are farther than {middle:.0f} m from the "
                         "origin and near each other, so it is in a frame such as map; give the "
                         "driver's own cloud")
    raise InputError(f"{name}: half of its points are farther than {middle:.0f} m, so its "
                     "coordinates seem to be millimetres; divide x y z by 1000 in the driver")


def require_space(degrees: np.ndarray, name: str) -> None:
    """InputError where points with these elevations (N,), N > 0, degrees, are all in one plane."""
    if np.subtract(*np.percentile(degrees, [99, 1])) < FLAT:
        raise InputError(f"{name}: all points lie in one plane, as those of a 2D scanner; give "
                         "clouds of a 3D LiDAR")


def _column(points: np.ndarray, indices: np.ndarray, names: Sequence[str],
            kind: type) -> np.ndarray | None:
    name = next((n for n in names if n in (points.dtype.names or ())), None)
    if name is None or points.dtype[name].shape:
        return None
    return points[name].take(indices).astype(kind)


class Intensity(NamedTuple):
    """Intensities of all scans together.

    full: the value of a full reflection, see intensity.infer_full_scale, or the greatest value
    where that is far beyond; sure: whether the values show it; whole: only whole numbers; zeros,
    bright: shares of the returns with 0, and from RETROREFLECTOR of full on; quantiles (101,) and
    histogram (51,) over 0 .. full.
    """

    full: float
    sure: bool
    whole: bool
    greatest: float
    zeros: float
    bright: float
    quantiles: np.ndarray
    histogram: np.ndarray


def intensity_of(scans: Sequence[Scan]) -> Intensity | None:
    """How the intensities are distributed; None without any, or where they are all the same."""
    found = [scan.intensity for scan in scans if scan.intensity is not None]
    values = np.concatenate(found) if found else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values) or values.min() == values.max():
        return None
    greatest = float(values.max())
    some = values[::max(1, len(values) // 10_000)]  # of all scans: one may begin with zeros
    whole = bool((some == np.round(some)).all())
    # Whole numbers that end at 1, as floats, are of no known driver: they count as integers.
    full = infer_full_scale(values, np.int64 if whole else values.dtype)
    if greatest > MAX_UNIT * full:
        full = greatest
    bright = float((values >= RETROREFLECTOR * full).mean())
    return Intensity(full, full <= 1.0 or greatest > 0.5 * full, whole, greatest,
                     float((values == 0).mean()), bright,
                     np.percentile(values, np.arange(101)),
                     np.histogram(values, 51, (0.0, full))[0])
