"""Ground by height threshold and RANSAC plane (paper A, Sections 3.2 and 3.4).

A plane is (3,) float64 [a b c] with z = a x + b y + c, in the frame of the points.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.ground.params import ThresholdParams
from lidar_perception.types import SENSOR_HEIGHT

MIN_POINTS = 3
SAMPLE_SIZE = 2048  # number of points used to compare trial planes; the fit uses all points
CONFIDENCE = 0.9999  # probability of drawing at least one triple without outliers
MIN_SINE = 1e-3  # min sine of the angle in a trial's triangle; thin triangles do not define a plane
MAX_REFINEMENTS = 50  # a few suffice; bounds the rare case that the inliers cycle


def segment_by_threshold(
    xyz: np.ndarray, params: ThresholdParams = ThresholdParams(), sensor_height: float = SENSOR_HEIGHT
) -> np.ndarray:
    """Segment the ground of finite points (N, 3).

    Returns:
        (N,) bool, True = ground. separate = "plane": points within inlier_distance of the plane of
        most points lower than max_height above the ground at the sensor; all False if there is no
        such plane (too few points, or too steep). separate = "height": these low points.
    """
    if params.separate == "height":
        return _is_low(xyz, params, sensor_height)
    plane = find_plane(xyz, params, sensor_height)
    if plane is None:
        return np.zeros(len(xyz), bool)
    return np.abs(height_above_plane(xyz, plane)) <= params.inlier_distance


def find_plane(
    xyz: np.ndarray, params: ThresholdParams = ThresholdParams(), sensor_height: float = SENSOR_HEIGHT
) -> np.ndarray | None:
    """Find the plane of segment_by_threshold, None if there is none.

    It is found among the low points and fitted to all points near it.
    """
    plane = _run_trials(xyz.compress(_is_low(xyz, params, sensor_height), axis=0), params)
    return None if plane is None else refine_plane(xyz, plane, params)


def _is_low(xyz: np.ndarray, params: ThresholdParams, sensor_height: float) -> np.ndarray:
    return xyz[:, 2] < params.max_height - sensor_height


def fit_plane_by_ransac(xyz: np.ndarray, params: ThresholdParams) -> np.ndarray | None:
    """Find the plane with most points (M, 3) within inlier_distance, None if there is none.

    RANSAC (Fischler and Bolles, 1981) with an adaptive number of trials. The plane is then fitted
    to its inliers until they no longer change, so that it does not depend on the triple found.
    """
    plane = _run_trials(xyz, params)
    return None if plane is None else refine_plane(xyz, plane, params)


def _run_trials(xyz: np.ndarray, params: ThresholdParams) -> np.ndarray | None:
    if len(xyz) < MIN_POINTS:
        return None
    rng = np.random.default_rng(params.seed)
    sample = xyz[rng.integers(len(xyz), size=SAMPLE_SIZE)] if len(xyz) > SAMPLE_SIZE else xyz
    triples = rng.integers(len(sample), size=(params.max_iterations, 3))
    max_gradient = np.tan(np.radians(params.max_slope))
    plane = _find_best_trial(sample.astype(np.float64), triples, params.inlier_distance, max_gradient, CONFIDENCE)
    return None if np.isnan(plane[0]) else plane


def refine_plane(xyz: np.ndarray, plane: np.ndarray, params: ThresholdParams) -> np.ndarray | None:
    """Fit a plane to the points (N, 3) within inlier_distance until these no longer change.

    None if they are on one line.
    """
    max_gradient = np.tan(np.radians(params.max_slope))
    for _ in range(MAX_REFINEMENTS):
        fitted = _solve_plane(_compute_moments(xyz, plane, params.inlier_distance))
        if fitted is None:
            return None
        if np.array_equal(fitted, plane) or np.hypot(fitted[0], fitted[1]) > max_gradient:
            break
        plane = fitted
    return plane


def fit_plane(xyz: np.ndarray) -> np.ndarray | None:
    """Return the least-squares plane of points (M, 3) with errors along z.

    None for fewer than 3 points or points on one line.
    """
    return _solve_plane(_compute_moments(xyz, np.zeros(3), np.inf))


def compute_inlier_share(xyz: np.ndarray, plane: np.ndarray, params: ThresholdParams = ThresholdParams()) -> float:
    """Return the share of points (N, 3) below max_height that are within inlier_distance.

    Both are measured from the plane. The share tells how well one plane describes the ground; it is
    0 if no point is that low.
    """
    height = height_above_plane(xyz, plane)
    low = height < params.max_height
    return float((np.abs(height[low]) <= params.inlier_distance).mean()) if low.any() else 0.0


def height_above_plane(xyz: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Return (N,) float64 height of points (N, 3) above the plane along z, in metres."""
    x, y, z = xyz.T.astype(np.float64)  # NumPy 1 would compute in float32
    return z - (plane[0] * x + plane[1] * y + plane[2])


@njit(cache=True)
def _find_best_trial(sample, triples, distance, max_gradient, confidence):
    """Return the plane through a triple with most inliers in the sample; NaN if there is none."""
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
            continue  # points on a line, or a vertical plane
        a, b = -normal_x / normal_z, -normal_y / normal_z
        if a * a + b * b > max_gradient * max_gradient:
            continue
        c = p[2] - a * p[0] - b * p[1]
        count = 0
        for i in range(len(sample)):
            count += abs(sample[i, 2] - (a * sample[i, 0] + b * sample[i, 1] + c)) <= distance
        if count > best_count:
            best_count, best = count, np.array([a, b, c])
            all_inliers = (count / len(sample)) ** 3  # probability for one triple
            if all_inliers >= 1.0:
                break
            needed = min(needed, np.log(1 - confidence) / np.log1p(-all_inliers))
    return best


@njit(cache=True)
def _compute_moments(xyz, plane, distance):
    """Sum the moments of the points within `distance` of the plane, relative to the first point.

    Returns [n, x, y, z, xx, xy, yy, xz, yz, x0, y0, z0].
    """
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


def _solve_plane(m: np.ndarray) -> np.ndarray | None:
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
