"""Angular density of a cloud, and clustering parameters that adapt to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.geometry import horizontal_range
from lidar_perception.types import are_usable_returns

CELL_DEG = 2.0  # side of a cell, equal to the spacing of a VLP-16's beams
MAX_SAMPLED = 30_000  # approximate number of points to sample from a larger cloud
MAX_WIDENING = 4.0  # maximum factor by which neighbourhoods widen
MIN_CLUSTER_POINTS = 3  # lower limit of min_size; that of min_samples is one less
# A widened radius of the local threshold, and a widened eps at the end of its band, in multiples of
# the distance between neighbouring points on a surface that faces the sensor.
SPACINGS_PER_RADIUS, SPACINGS_PER_EPS = 4.0, 2.5
LAST_BAND_FACTOR = 1.5  # assumed end of the last band, as a multiple of the last range limit


def measure_density(xyz: np.ndarray) -> float:
    """Measure the angular density of a cloud as seen from the sensor.

    It is the mean number of points per square degree around a point.

    Args:
        xyz: (N, 3) float32 in sensor coordinates, metres; N may be 0.

    Returns:
        Points per square degree; 0 if no two usable points share a cell of CELL_DEG. For KITTI's
        HDL-64E, the result is 13 to 16.
    """
    step = max(len(xyz) // MAX_SAMPLED, 1)
    sample = np.ascontiguousarray(xyz[::step])
    is_usable = are_usable_returns(sample)
    if not is_usable.all():
        sample = sample.take(np.flatnonzero(is_usable), axis=0)
    if len(sample) == 0:
        return 0.0
    x, y, z = np.ascontiguousarray(sample.T)
    distance = np.hypot(x, y)
    # CELL_DEG is a power of two, so floor() equals the slower operator //.
    row = np.floor((np.degrees(np.arctan2(z, distance)) + 90.0) / CELL_DEG)
    column = np.floor((np.degrees(np.arctan2(y, x)) + 180.0) / CELL_DEG)
    cell = (row * (360.0 // CELL_DEG + 1.0) + column).astype(np.int64)
    other_count = np.bincount(cell).take(cell) - 1.0
    # Cells narrow towards the zenith and the nadir.
    slant = np.maximum(distance / np.hypot(distance, z), 0.05)
    return step * float((other_count / (CELL_DEG**2 * slant)).mean())


def adapt_to_density(params: ClusteringParams, density: float) -> ClusteringParams:
    """Adapt the parameters to the density of a cloud.

    If the cloud is sparser than params.density, neighbourhoods widen, at most in proportion to the
    distance between points, and minimum sizes shrink in proportion to the number of points.

    Args:
        density: density of the cloud in points per square degree.

    Returns:
        The adapted parameters, or params itself if the cloud is not sparser or either density is 0.
    """
    if not 0.0 < density < params.density:
        return params
    widening = min((params.density / density) ** 0.5, MAX_WIDENING)
    dbscan, euclidean = params.dbscan, params.euclidean
    range_limits = dbscan.range_limits
    band_ends = [*range_limits, LAST_BAND_FACTOR * range_limits[-1] if range_limits else 1e6]
    return replace(
        params,
        dbscan=replace(
            dbscan,
            eps=tuple(
                min(max(eps, SPACINGS_PER_EPS * compute_point_spacing(density) * end), widening * eps)
                for eps, end in zip(dbscan.eps, band_ends)
            ),
            min_samples=_reduce_count(dbscan.min_samples, widening**2, MIN_CLUSTER_POINTS - 1),
        ),
        euclidean=replace(
            euclidean,
            radius=min(euclidean.radius * widening, 10.0),
            distance=min(euclidean.distance * widening, 10.0),
            beta=euclidean.beta / widening,
            min_size=_reduce_count(euclidean.min_size, widening**2, MIN_CLUSTER_POINTS),
        ),
    )


def compute_point_spacing(density: float) -> float:
    """Return the distance in metres between neighbouring points on a surface 1 m from the sensor.

    The surface faces the sensor. density is in points per square degree and above 0.
    """
    return float(np.radians(density**-0.5))


def _reduce_count(count: int, factor: float, minimum: int) -> int:
    return min(count, max(round(count / factor), minimum))


def compute_radii(xyz: np.ndarray, density: float, low: float, high: float) -> np.ndarray:
    """Compute the radius (N,) float64, in metres, for the local threshold of each point (N, 3).

    The radius grows with the point's horizontal range and shrinks with the density of the cloud, in
    points per square degree. It is limited to low..high.
    """
    ranges = horizontal_range(xyz).astype(np.float64)
    return np.clip(SPACINGS_PER_RADIUS * compute_point_spacing(density) * ranges, low, high)
