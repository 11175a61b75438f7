"""How densely a cloud samples what it sees, and clustering whose numbers follow it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.geometry import horizontal_range
from lidar_perception.types import usable_returns

CELL = 2.0       # degrees: the gap between the beams of a VLP-16
LOOKED_AT = 30_000  # points, of a larger cloud
WIDEST = 4.0     # times as wide are neighbourhoods at most
FEWEST = 3       # points of a cluster, at least, and one less within eps
# So many distances between points on a surface that faces the sensor are within a widened radius of
# the local threshold, and within a widened eps at the end of its band.
IN_RADIUS, IN_EPS = 4.0, 2.5
BEYOND = 1.5     # times as far as the last limit is the end of the last band


def density(xyz: np.ndarray) -> float:
    """Points a square degree of view: how many others lie in the direction of a usable return of
    (N, 3) float32, metres from the sensor, in the mean. 0 where none has another beside it; N may
    be 0. KITTI's HDL-64E has 13 to 16, however its clouds are cropped."""
    step = max(len(xyz) // LOOKED_AT, 1)
    looked_at = xyz[::step]
    x, y, z = looked_at.compress(usable_returns(looked_at), axis=0).T
    away = np.hypot(x, y)
    row = (np.degrees(np.arctan2(z, away)) + 90.0) // CELL
    column = (np.degrees(np.arctan2(y, x)) + 180.0) // CELL
    cell = (row * (360.0 // CELL + 1.0) + column).astype(np.int64)
    others = np.bincount(cell).take(cell) - 1.0 if len(cell) else np.zeros(0)
    slant = np.maximum(away / np.hypot(away, z), 0.05)  # a cell is the narrower the steeper it lies
    return step * float((others / (CELL**2 * slant)).mean()) if len(cell) else 0.0


def followed(params: ClusteringParams, seen: float) -> ClusteringParams:
    """params for a cloud of `seen` points a square degree: in one that is thinner than they are
    made for neighbourhoods widen, at most as its points move apart, and least sizes shrink with
    their number. The same object where the cloud is not thinner, where they are made for every
    cloud, and where `seen` is 0."""
    if not 0.0 < seen < params.density:
        return params
    wider = min((params.density / seen) ** 0.5, WIDEST)
    dbscan, euclidean = params.dbscan, params.euclidean
    ends = [*dbscan.range_limits, BEYOND * dbscan.range_limits[-1] if dbscan.range_limits else 1e6]
    return replace(
        params,
        dbscan=replace(
            dbscan, eps=tuple(min(max(eps, IN_EPS * spacing(seen) * end), wider * eps)
                              for eps, end in zip(dbscan.eps, ends)),
            min_samples=_fewer(dbscan.min_samples, wider**2, FEWEST - 1)),
        euclidean=replace(
            euclidean, radius=min(euclidean.radius * wider, 10.0),
            distance=min(euclidean.distance * wider, 10.0), beta=euclidean.beta / wider,
            min_size=_fewer(euclidean.min_size, wider**2, FEWEST)))


def spacing(seen: float) -> float:
    """Metres between neighbours on a surface that faces the sensor 1 m away, where `seen` points,
    more than 0, lie in a square degree."""
    return float(np.radians(seen**-0.5))


def _fewer(count: int, thinner: float, least: int) -> int:
    return min(count, max(round(count / thinner), least))


def radii(xyz: np.ndarray, seen: float, least: float, most: float) -> np.ndarray:
    """(N,) float64 m: the radius of the local threshold that the horizontal range of each of points
    (N, 3) asks for in a cloud of `seen` points a square degree, between least and most."""
    return np.clip(IN_RADIUS * spacing(seen) * horizontal_range(xyz).astype(np.float64), least,
                   most)
