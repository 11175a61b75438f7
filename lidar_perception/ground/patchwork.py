"""Ground segmentation by Patchwork++ (Lee, Lim, Myung, IROS 2022), as in paper B's V1.

The labels equal those of the authors' library (pypatchworkpp 1.4.1) for a single cloud, except for a
few points within rounding error of a limit. Unlike the library, this code releases the GIL, prints
nothing and does not adapt limits from cloud to cloud, so the same cloud always gets the same labels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.geometry import counting_sort
from lidar_perception.ground.params import PatchworkParams

# Constants of the Patchwork++ library; comments give their names there.
RINGS, SECTORS = (2, 4, 4, 4), (16, 32, 54, 32)  # by zone: num_rings_each_zone, num_sectors_each_zone
PATCHES = sum(rings * sectors for rings, sectors in zip(RINGS, SECTORS))
MIN_PATCH_POINTS = 10  # num_min_pts
ITERATIONS = 3  # num_iter
LOWEST_POINTS = 20  # num_lpr, whose mean is the lowest height of a patch
NEAR_RINGS = 4  # num_rings_of_interest
MIN_SEED_HEIGHT = -1.2  # adaptive_seed_selection_margin, in sensor heights
VERTICAL_SEED_DISTANCE, VERTICAL_DISTANCE = 0.25, 0.1  # th_seeds_v, th_dist_v, metres
MAX_NOISE_DEG, MAX_NOISE_INTENSITY = -15.0, 0.2  # RNR_ver_angle_thr, RNR_intensity_thr
MIN_NOISE_DEPTH = 0.8  # minimum depth of reflections below the ground, metres
MAX_LINE_RATIO = 8.0  # maximum ratio of the two largest eigenvalues of a patch that is reverted to ground
MANY_POINTS = 1500  # number of ground points above which a flat patch is reverted to ground

OTHER, GROUND, REMOVED = 0, 1, 2  # states of a point in its patch


class _Settings(NamedTuple):
    """Parameters for compiled code, in metres; uprightness is the minimum z of a unit normal."""

    sensor_height: float
    min_range: float
    max_range: float
    inlier_distance: float
    seed_distance: float
    uprightness: float


# A plane of ground points is an array (8,) float64: normal and offset (normal . p + offset = 0),
# mean height of the points, and eigenvalues of their covariance.
OFFSET, MEAN_Z, LARGEST, MIDDLE, SMALLEST = 3, 4, 5, 6, 7


def segment_by_patchwork(
    xyz: np.ndarray, intensity: np.ndarray | None, sensor_height: float, params: PatchworkParams = PatchworkParams()
) -> np.ndarray:
    """Segment the ground of finite points.

    Args:
        xyz: (N, 3) float32 with z up.
        intensity: (N,) float32 0..1, used to remove reflections; None to keep them.
        sensor_height: height of the sensor above the ground in metres.

    Returns:
        (N,) bool, True = ground.
    """
    settings = _Settings(
        float(sensor_height),
        float(params.min_range),
        float(params.max_range),
        float(params.inlier_distance),
        float(params.seed_distance),
        float(params.uprightness),
    )
    use_intensity = params.remove_reflections and intensity is not None
    return _segment(
        np.array(xyz, np.float32, order="C"), np.array(intensity if use_intensity else (), np.float32), settings
    )


@njit(cache=True, nogil=True)
def _segment(xyz, intensity, settings):
    order, start = counting_sort(_find_patches(xyz, intensity, settings), PATCHES + 1, np.arange(len(xyz)))
    max_size = 0
    for p in range(PATCHES):
        max_size = max(max_size, start[p + 1] - start[p])
    points, state = np.empty((3, max_size), np.float32), np.empty(max_size, np.int8)
    ground = np.zeros(len(xyz), np.bool_)
    plane = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    flatness = np.empty(PATCHES)
    candidates, ground_counts = np.empty(PATCHES, np.int64), np.empty(PATCHES, np.int64)
    eigenvalues = np.empty((PATCHES, 3))  # eigenvalues of these candidates
    p, ring = 0, 0
    for zone in range(len(RINGS)):
        for _ in range(RINGS[zone]):
            flat_count, count = np.int64(0), 0
            for _ in range(SECTORS[zone]):
                begin, size = start[p], start[p + 1] - start[p]
                p += 1
                if size < MIN_PATCH_POINTS:
                    continue
                for i in range(size):
                    for axis in range(3):
                        points[axis, i] = xyz[order[begin + i], axis]
                _fit_ground(points, state, size, zone, plane, settings)
                # Ground likelihood estimation (GLE)
                is_near, is_low = ring < NEAR_RINGS, plane[MEAN_Z] < 0.0
                if not plane[2] > settings.uprightness:
                    continue
                if is_near and is_low:
                    flatness[flat_count] = plane[SMALLEST]
                    flat_count += 1
                if is_near and not plane[OFFSET] > 0.0:
                    continue  # the sensor is below the plane
                ground_counts[count] = 0
                for i in range(size):
                    ground[order[begin + i]] = state[i] == GROUND
                    ground_counts[count] += state[i] == GROUND
                if is_near and not is_low:
                    candidates[count] = p - 1
                    for k in range(3):
                        eigenvalues[count, k] = plane[LARGEST + k]
                    count += 1
            limit = _compute_flatness_limit(flatness, flat_count)
            for c in range(count):  # Temporal ground revert (TGR)
                is_flat = eigenvalues[c, 2] < limit or (
                    ground_counts[c] > MANY_POINTS and eigenvalues[c, 2] < settings.inlier_distance**2
                )
                if not is_flat or eigenvalues[c, 0] > MAX_LINE_RATIO * eigenvalues[c, 1]:
                    for i in range(start[candidates[c]], start[candidates[c] + 1]):
                        ground[order[i]] = False
            ring += 1
    return ground


@njit(cache=True, nogil=True)
def _find_patches(xyz, intensity, settings):
    """Return the patch (N,) of each point in the concentric zones (CZM), ring by ring.

    Reflections (RNR) and points out of range have the value PATCHES.
    """
    min_range, max_range = settings.min_range, settings.max_range
    limits = (
        min_range,
        (7 * min_range + max_range) / 8,
        (3 * min_range + max_range) / 4,
        (min_range + max_range) / 2,
        max_range,
    )
    patch = np.full(len(xyz), PATCHES)
    max_noise = math.tan(math.radians(MAX_NOISE_DEG))
    for i in range(len(xyz)):
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        distance = math.sqrt(x * x + y * y)
        if len(intensity) and (
            intensity[i] < MAX_NOISE_INTENSITY
            and z < max_noise * distance
            and z < -settings.sensor_height - MIN_NOISE_DEPTH
        ):
            continue
        if not min_range < distance <= max_range:
            continue
        angle = math.atan2(y, x)
        angle = angle if angle > 0 else 2 * math.pi + angle
        zone, zone_offset = 0, 0
        while zone < 3 and distance >= limits[zone + 1]:
            zone_offset += RINGS[zone] * SECTORS[zone]
            zone += 1
        width = (limits[zone + 1] - limits[zone]) / RINGS[zone]
        ring = min(int((distance - limits[zone]) / width), RINGS[zone] - 1)
        sector = min(int(angle / (2 * math.pi / SECTORS[zone])), SECTORS[zone] - 1)
        patch[i] = zone_offset + ring * SECTORS[zone] + sector
    return patch


@njit(cache=True, nogil=True)
def _fit_ground(points, state, size, zone, plane, settings):
    """Fit the ground of a patch: set the state of each of its points (3, >= size) and the plane.

    If there are no points to fit, the plane of the previous patch is kept.
    """
    for i in range(size):
        state[i] = OTHER
    min_height = MIN_SEED_HEIGHT * settings.sensor_height if zone == 0 else -np.inf
    for _ in range(ITERATIONS):  # Region-wise vertical plane fitting (R-VPF)
        _mark_seeds(points, state, size, min_height, VERTICAL_SEED_DISTANCE)
        _fit_plane(points, state, size, plane)
        if zone > 0 or not plane[2] < settings.uprightness:
            break
        for i in range(size):
            if state[i] != REMOVED and abs(_compute_signed_distance(plane, points, i)) < VERTICAL_DISTANCE:
                state[i] = REMOVED
    _mark_seeds(points, state, size, min_height, settings.seed_distance)
    _fit_plane(points, state, size, plane)
    for _ in range(ITERATIONS):  # Region-wise ground plane fitting (R-GPF)
        for i in range(size):
            if state[i] != REMOVED:
                is_ground = _compute_signed_distance(plane, points, i) < settings.inlier_distance
                state[i] = GROUND if is_ground else OTHER
        _fit_plane(points, state, size, plane)


@njit(cache=True, nogil=True)
def _mark_seeds(points, state, size, min_height, distance):
    """Mark the points less than `distance` above the mean height of the lowest points."""
    lowest, count = np.empty(LOWEST_POINTS), 0  # kept in ascending order
    for i in range(size):
        z = points[2, i]
        if state[i] == REMOVED or z < min_height or (count == LOWEST_POINTS and z >= lowest[-1]):
            continue
        position = count if count < LOWEST_POINTS else count - 1
        while position > 0 and lowest[position - 1] > z:
            lowest[position] = lowest[position - 1]
            position -= 1
        lowest[position] = z
        count = min(count + 1, LOWEST_POINTS)
    total = 0.0
    for k in range(count):
        total += lowest[k]
    limit = distance + total / max(count, 1)
    for i in range(size):
        if state[i] != REMOVED:
            state[i] = GROUND if points[2, i] < limit else OTHER


@njit(cache=True, nogil=True)
def _compute_signed_distance(plane, points, i):
    return np.float32(plane[0] * points[0, i] + plane[1] * points[1, i] + plane[2] * points[2, i]) + plane[OFFSET]


@njit(cache=True, nogil=True)
def _fit_plane(points, state, size, plane):
    """Fit the plane to the ground points of a patch, if there are any."""
    count, sx, sy, sz = 0, 0.0, 0.0, 0.0
    for i in range(size):
        if state[i] == GROUND:
            count += 1
            sx, sy, sz = sx + points[0, i], sy + points[1, i], sz + points[2, i]
    if count == 0:
        return
    # Rounded to float32 as in the library, because the rounding determines the plane through two points.
    mean = np.array([sx / count, sy / count, sz / count], np.float32)
    xx, xy, yy, xz, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(size):
        if state[i] == GROUND:
            x, y, z = points[0, i] - mean[0], points[1, i] - mean[1], points[2, i] - mean[2]
            xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
            xz, yz, zz = xz + x * z, yz + y * z, zz + z * z
    cov = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], np.float32)
    for k in range(3):
        for j in range(3):
            cov[k, j] /= np.float32(max(count - 1, 1))
    _decompose(cov, plane)
    if plane[2] < 0:
        for k in range(3):
            plane[k] = -plane[k]
    plane[MEAN_Z], plane[OFFSET] = mean[2], 0.0
    for k in range(3):
        plane[OFFSET] -= plane[k] * mean[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _decompose(matrix, plane):
    """Decompose the covariance of a patch: write eigenvalues and normal to the plane.

    The method is that of Eigen's SelfAdjointEigenSolver.computeDirect, because the normal of a patch
    with two points depends on the method. It takes a third of the time of Jacobi rotations.

    Args:
        matrix: (3, 3) float32 symmetric; overwritten.
        plane: (8,); the normal becomes the eigenvector of the smallest eigenvalue.
    """
    m, epsilon = matrix, np.float32(2.0**-23)
    shift = (m[0, 0] + m[1, 1] + m[2, 2]) / np.float32(3.0)
    scale = np.float32(0.0)
    for k in range(3):
        m[k, k] -= shift
        for j in range(3):
            scale = max(scale, abs(m[k, j]))
    if scale > 0:
        for k in range(3):
            for j in range(3):
                m[k, j] /= scale
    low, middle, high = _compute_eigenvalues(m)
    plane[LARGEST], plane[MIDDLE], plane[SMALLEST] = (high * scale + shift, middle * scale + shift, low * scale + shift)
    normal, column = np.zeros(3, np.float32), np.empty(3, np.float32)
    if high - low <= epsilon:
        normal[0] = 1.0
    elif high - middle <= middle - low:
        _find_kernel(m, low, normal, column)
    else:
        _find_kernel(m, high, column, normal)
        if middle - low <= 0:  # `normal` holds a column that is close to the eigenvector
            factor = np.float32(1.0) - (column[0] * normal[0] + column[1] * normal[1] + column[2] * normal[2])
            length = np.float32(0.0)
            for k in range(3):
                normal[k] *= factor
                length += normal[k] * normal[k]
            for k in range(3):
                normal[k] /= np.sqrt(length)
        else:
            _find_kernel(m, low, normal, column)
    for k in range(3):
        plane[k] = normal[k]


@njit(cache=True, nogil=True)
def _compute_eigenvalues(m):
    """Return the eigenvalues of a symmetric matrix (3, 3) float32 with trace 0, ascending."""
    zero, half, two = np.float32(0.0), np.float32(0.5), np.float32(2.0)
    third, root = np.float32(1.0 / 3.0), np.float32(3.0**0.5)
    c0 = (
        m[0, 0] * m[1, 1] * m[2, 2]
        + two * m[1, 0] * m[2, 0] * m[2, 1]
        - m[0, 0] * m[2, 1] * m[2, 1]
        - m[1, 1] * m[2, 0] * m[2, 0]
        - m[2, 2] * m[1, 0] * m[1, 0]
    )
    c1 = (
        m[0, 0] * m[1, 1]
        - m[1, 0] * m[1, 0]
        + m[0, 0] * m[2, 2]
        - m[2, 0] * m[2, 0]
        + m[1, 1] * m[2, 2]
        - m[2, 1] * m[2, 1]
    )
    c2 = m[0, 0] + m[1, 1] + m[2, 2]
    mean = c2 * third
    a = max((c2 * mean - c1) * third, zero)
    b = half * (c0 + mean * (two * mean * mean - c1))
    angle = math.atan2(np.sqrt(max(a * a * a - b * b, zero)), b) * third
    radius, cos, sin = np.sqrt(a), math.cos(angle), math.sin(angle)
    return (mean - radius * (cos + root * sin), mean - radius * (cos - root * sin), mean + two * radius * cos)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_kernel(m, eigenvalue, kernel, column):
    """Find the eigenvector of an eigenvalue of m (3, 3); all arrays are float32.

    Writes the eigenvector to kernel (3,), and to column (3,) the column of m - eigenvalue * I with
    the largest diagonal entry.
    """
    top = 0
    for k in range(1, 3):
        top = k if abs(m[k, k] - eigenvalue) > abs(m[top, top] - eigenvalue) else top
    for k in range(3):
        column[k] = m[k, top] - (eigenvalue if k == top else np.float32(0.0))
    best = np.float32(-1.0)
    for step in range(1, 3):
        other = (top + step) % 3
        x, y, z = m[0, other], m[1, other], m[2, other]
        x -= eigenvalue if other == 0 else np.float32(0.0)
        y -= eigenvalue if other == 1 else np.float32(0.0)
        z -= eigenvalue if other == 2 else np.float32(0.0)
        u = column[1] * z - column[2] * y
        v = column[2] * x - column[0] * z
        w = column[0] * y - column[1] * x
        length = u * u + v * v + w * w
        if step == 1 or not best > length:
            best = length
            kernel[0], kernel[1], kernel[2] = (u / np.sqrt(length), v / np.sqrt(length), w / np.sqrt(length))


@njit(cache=True, nogil=True)
def _compute_flatness_limit(flatness, count):
    """Return the flatness below which a candidate remains ground; 0 for fewer than two patches."""
    if count < 2:
        return 0.0
    total, squares = 0.0, 0.0
    for i in range(count):
        total += flatness[i]
    for i in range(count):
        squares += (flatness[i] - total / count) ** 2
    return total / count + 1.5 * math.sqrt(squares / (count - 1))
