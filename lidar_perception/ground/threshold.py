"""Ground by height threshold and RANSAC plane (paper A, Sections 3.2 and 3.4).

A plane is (3,) float64 [a b c]: z = a x + b y + c, in the frame of the points.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.ground.params import ThresholdParams
from lidar_perception.types import SENSOR_HEIGHT

MIN_POINTS = 3
SAMPLE = 2048        # candidates on which trial planes are compared; the fit uses all of them
CONFIDENCE = 0.9999  # of having drawn one triple without outliers
MIN_SINE = 1e-3      # of the angle in a trial's triangle; a thinner one says nothing of the plane
REFINEMENTS = 50     # the inliers settle after a few; this bounds the rare case that they cycle


def segment_by_threshold(xyz: np.ndarray, params: ThresholdParams = ThresholdParams(),
                         sensor_height: float = SENSOR_HEIGHT) -> np.ndarray:
    """(N,) bool, True = ground: points (N, 3) within inlier_distance of the plane that holds most
    of those lower than max_height above the ground under the sensor. All False where no plane can
    be found (too few points, all steep)."""
    plane = find_plane(xyz, params, sensor_height)
    if plane is None:
        return np.zeros(len(xyz), bool)
    return np.abs(height_above(xyz, plane)) <= params.inlier_distance


def find_plane(xyz: np.ndarray, params: ThresholdParams = ThresholdParams(),
               sensor_height: float = SENSOR_HEIGHT) -> np.ndarray | None:
    """The plane of segment_by_threshold: found among the low points, fitted to all near it."""
    low = xyz[:, 2] < params.max_height - sensor_height
    plane = _best_of_trials(xyz.compress(low, axis=0), params)
    return None if plane is None else refine_plane(xyz, plane, params)


def ransac_plane(xyz: np.ndarray, params: ThresholdParams) -> np.ndarray | None:
    """The plane with most points (M, 3) within inlier_distance, then fitted to its inliers until
    they no longer change, so that it does not depend on the triple that found it. None where
    there is none. Fischler and Bolles, 1981, with the adaptive number of trials."""
    plane = _best_of_trials(xyz, params)
    return None if plane is None else refine_plane(xyz, plane, params)


def _best_of_trials(xyz: np.ndarray, params: ThresholdParams) -> np.ndarray | None:
    if len(xyz) < MIN_POINTS:
        return None
    rng = np.random.default_rng(params.seed)
    sample = xyz[rng.integers(len(xyz), size=SAMPLE)] if len(xyz) > SAMPLE else xyz
    triples = rng.integers(len(sample), size=(params.max_iterations, 3))
    max_gradient = np.tan(np.radians(params.max_slope))
    plane = _best_trial(sample.astype(np.float64), triples, params.inlier_distance, max_gradient,
                        CONFIDENCE)
    return None if np.isnan(plane[0]) else plane


def refine_plane(xyz: np.ndarray, plane: np.ndarray, params: ThresholdParams) -> np.ndarray | None:
    """The plane fitted to the points (N, 3) within inlier_distance, again and again until these no
    longer change. None where they lie on one line."""
    max_gradient = np.tan(np.radians(params.max_slope))
    for _ in range(REFINEMENTS):
        fitted = _plane_of(_moments(xyz, plane, params.inlier_distance))
        if fitted is None:
            return None
        if np.array_equal(fitted, plane) or np.hypot(fitted[0], fitted[1]) > max_gradient:
            break
        plane = fitted
    return plane


def fit_plane(xyz: np.ndarray) -> np.ndarray | None:
    """Least-squares plane of points (M, 3), errors along z. None for fewer than 3 points or
    points on one line."""
    return _plane_of(_moments(xyz, np.zeros(3), np.inf))


def inlier_share(xyz: np.ndarray, plane: np.ndarray,
                 params: ThresholdParams = ThresholdParams()) -> float:
    """Of the points (N, 3) lower than max_height above the plane, the share within inlier_distance
    of it: how well one plane describes the ground. 0 where no point is that low."""
    height = height_above(xyz, plane)
    low = height < params.max_height
    return float((np.abs(height[low]) <= params.inlier_distance).mean()) if low.any() else 0.0


def height_above(xyz: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """(N,) metres of points (N, 3) above the plane, along z."""
    x, y, z = xyz.T.astype(np.float64)  # NumPy 1 would compute in float32
    return z - (plane[0] * x + plane[1] * y + plane[2])


@njit(cache=True)
def _best_trial(sample, triples, distance, max_gradient, confidence):
    """[a b c] with most inliers among planes through triples; NaN where there is none."""
    best, best_count = np.full(3, np.nan), 0
    needed = float(len(triples))
    for trial in range(len(triples)):
        if trial >= needed:
            break
        p, q, r = sample[triples[trial, 0]], sample[triples[trial, 1]], sample[triples[trial, 2]]
        ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        normal_x, normal_y, normal_z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area = normal_x * normal_x + normal_y * normal_y + normal_z * normal_z
        sides = (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz)
        if area <= MIN_SINE * MIN_SINE * sides or normal_z == 0.0:
            continue  # three points on a line, or a vertical plane
        a, b = -normal_x / normal_z, -normal_y / normal_z
        if a * a + b * b > max_gradient * max_gradient:
            continue
        c = p[2] - a * p[0] - b * p[1]
        count = 0
        for i in range(len(sample)):
            count += abs(sample[i, 2] - (a * sample[i, 0] + b * sample[i, 1] + c)) <= distance
        if count > best_count:
            best_count, best = count, np.array([a, b, c])
            good = (count / len(sample)) ** 3
            if good >= 1.0:
                break
            needed = min(needed, np.log(1 - confidence) / np.log1p(-good))
    return best


@njit(cache=True)
def _moments(xyz, plane, distance):
    """Count, sums and products of the points within distance of the plane, about the first
    point: [n, x, y, z, xx, xy, yy, xz, yz, x0, y0, z0]."""
    m = np.zeros(12)
    if len(xyz) == 0:
        return m
    x0, y0, z0 = np.float64(xyz[0, 0]), np.float64(xyz[0, 1]), np.float64(xyz[0, 2])
    for i in range(len(xyz)):
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        if abs(z - (plane[0] * x + plane[1] * y + plane[2])) <= distance:
            x, y, z = x - x0, y - y0, z - z0
            m[0] += 1
            m[1] += x
            m[2] += y
            m[3] += z
            m[4] += x * x
            m[5] += x * y
            m[6] += y * y
            m[7] += x * z
            m[8] += y * z
    m[9], m[10], m[11] = x0, y0, z0
    return m


def _plane_of(m: np.ndarray) -> np.ndarray | None:
    n = m[0]
    if n < MIN_POINTS:
        return None
    mx, my, mz = m[1:4] / n
    xx, xy, yy = m[4] / n - mx * mx, m[5] / n - mx * my, m[6] / n - my * my
    xz, yz = m[7] / n - mx * mz, m[8] / n - my * mz
    determinant = xx * yy - xy * xy
    if determinant <= 1e-9 * (xx + yy) ** 2:
        return None
    a, b = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
    return np.array([a, b, mz + m[11] - a * (mx + m[9]) - b * (my + m[10])])
