"""Ground segmentation by height threshold and RANSAC plane (paper A, Sections 3.2 and 3.4).

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
MIN_SINE = 1e-3  # minimum sine of the angle in a trial's triangle; thin triangles do not define a plane
MAX_REFINEMENTS = 50  # ends the rare case of inliers that alternate; a few refinements are typical


def segment_by_threshold(
    xyz: np.ndarray, params: ThresholdParams = ThresholdParams(), sensor_height: float = SENSOR_HEIGHT
) -> np.ndarray:
    """Segment the ground of finite points (N, 3).

    Returns:
        (N,) bool, True = ground. separate = "height": the low points, that is, those less than
        max_height above the ground at the sensor. separate = "plane": the points within
        inlier_distance of the plane with the most low points; all False if there is no such plane
        (too few points, or too steep).
    """
    if params.separate == "height":
        return _is_low(xyz, params, sensor_height)
    plane = find_plane(xyz, params, sensor_height)
    if plane is None:
        return np.zeros(len(xyz), bool)
    return np.abs(compute_height_above_plane(xyz, plane)) <= params.inlier_distance


def find_plane(
    xyz: np.ndarray, params: ThresholdParams = ThresholdParams(), sensor_height: float = SENSOR_HEIGHT
) -> np.ndarray | None:
    """Find the ground plane as in segment_by_threshold; return None if there is none.

    RANSAC uses the low points; the plane is then fitted to all points within inlier_distance.
    """
    plane = _run_trials(xyz.compress(_is_low(xyz, params, sensor_height), axis=0), params)
    return None if plane is None else refine_plane(xyz, plane, params)


def _is_low(xyz: np.ndarray, params: ThresholdParams, sensor_height: float) -> np.ndarray:
    return xyz[:, 2] < params.max_height - sensor_height


def fit_plane_by_ransac(xyz: np.ndarray, params: ThresholdParams) -> np.ndarray | None:
    """Find the plane with the most inliers among points (M, 3); return None if there is none.

    RANSAC (Fischler and Bolles, 1981) with an adaptive number of trials. The plane is then fitted
    to its inliers until they no longer change, so that it does not depend on the sampled triple.
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
    """Fit a plane to its inliers among points (N, 3) until these no longer change.

    Returns None if the inliers are collinear.
    """
    max_gradient = np.tan(np.radians(params.max_slope))
    for _ in range(MAX_REFINEMENTS):
        fitted_plane = _solve_plane(_compute_moments(xyz, plane, params.inlier_distance))
        if fitted_plane is None:
            return None
        if np.array_equal(fitted_plane, plane) or np.hypot(fitted_plane[0], fitted_plane[1]) > max_gradient:
            break
        plane = fitted_plane
    return plane


def fit_plane(xyz: np.ndarray) -> np.ndarray | None:
    """Fit a least-squares plane to points (M, 3) with errors along z.

    Returns None for fewer than 3 points or collinear points.
    """
    return _solve_plane(_compute_moments(xyz, np.zeros(3), np.inf))


def compute_inlier_fraction(xyz: np.ndarray, plane: np.ndarray, params: ThresholdParams = ThresholdParams()) -> float:
    """Return the fraction of the low points (N, 3) that are within inlier_distance of the plane.

    Low points are less than max_height above the plane. The fraction shows how well the plane
    describes the ground; it is 0 if there are no low points.
    """
    height = compute_height_above_plane(xyz, plane)
    is_low = height < params.max_height
    return float((np.abs(height[is_low]) <= params.inlier_distance).mean()) if is_low.any() else 0.0


def compute_height_above_plane(xyz: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Return the height (N,) float64 of points (N, 3) above the plane along z, in metres."""
    x, y, z = xyz.T.astype(np.float64)  # NumPy 1 would compute in float32
    return z - (plane[0] * x + plane[1] * y + plane[2])


@njit(cache=True, nogil=True)
def _find_best_trial(sample, triples, distance, max_gradient, confidence):
    """Return the plane through a triple with the most inliers in the sample; NaN if there is none."""
    best_plane, best_count = np.full(3, np.nan), 0
    required_trials = float(len(triples))
    for trial in range(len(triples)):
        if trial >= required_trials:
            break
        p, q, r = sample[triples[trial, 0]], sample[triples[trial, 1]], sample[triples[trial, 2]]
        ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        normal_x, normal_y, normal_z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        squared_area = normal_x * normal_x + normal_y * normal_y + normal_z * normal_z
        side_product = (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz)
        if squared_area <= MIN_SINE * MIN_SINE * side_product or normal_z == 0.0:
            continue  # points on a line, or a vertical plane
        a, b = -normal_x / normal_z, -normal_y / normal_z
        if a * a + b * b > max_gradient * max_gradient:
            continue
        c = p[2] - a * p[0] - b * p[1]
        count = 0
        for i in range(len(sample)):
            count += abs(sample[i, 2] - (a * sample[i, 0] + b * sample[i, 1] + c)) <= distance
        if count > best_count:
            best_count, best_plane = count, np.array([a, b, c])
            triple_probability = (count / len(sample)) ** 3  # probability for one triple
            if triple_probability >= 1.0:
                break
            required_trials = min(required_trials, np.log(1 - confidence) / np.log1p(-triple_probability))
    return best_plane


@njit(cache=True, nogil=True)
def _compute_moments(xyz, plane, distance):
    """Sum the moments of the points within `distance` of the plane, relative to the first point.

    Returns [n, x, y, z, xx, xy, yy, xz, yz, x0, y0, z0].
    """
    moments = np.zeros(12)
    if len(xyz) == 0:
        return moments
    x0, y0, z0 = np.float64(xyz[0, 0]), np.float64(xyz[0, 1]), np.float64(xyz[0, 2])
    for i in range(len(xyz)):
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        if abs(z - (plane[0] * x + plane[1] * y + plane[2])) <= distance:
            x, y, z = x - x0, y - y0, z - z0
            moments[0] += 1
            moments[1] += x
            moments[2] += y
            moments[3] += z
            moments[4] += x * x
            moments[5] += x * y
            moments[6] += y * y
            moments[7] += x * z
            moments[8] += y * z
    moments[9], moments[10], moments[11] = x0, y0, z0
    return moments


def _solve_plane(moments: np.ndarray) -> np.ndarray | None:
    n = moments[0]
    if n < MIN_POINTS:
        return None
    mx, my, mz = moments[1:4] / n
    xx, xy, yy = moments[4] / n - mx * mx, moments[5] / n - mx * my, moments[6] / n - my * my
    xz, yz = moments[7] / n - mx * mz, moments[8] / n - my * mz
    determinant = xx * yy - xy * xy
    if determinant <= 1e-9 * (xx + yy) ** 2:
        return None
    a, b = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
    return np.array([a, b, mz + moments[11] - a * (mx + moments[9]) - b * (my + moments[10])])
