"""Silhouettes of clusters and their similarity: STM with CPA (paper A, Sections 3.6 and 3.7).

A silhouette is (80,) uint32: 80 rows from top to bottom, each with 32 columns as the bits of a
word. Closing and dilation therefore take a few shifts per row, and the cosine similarity of two
binary images is computed by counting bits.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.candidates.params import CpaParams, PipelineParams, StmParams

ROWS, COLUMNS = 80, 32  # size of the paper's window in pixels, Table 2
WINDOW_HEIGHT_M, WINDOW_WIDTH_M = 2.4, 1.6  # size of the metric window
FULL_ROW = np.uint64(0xFFFFFFFF)
ONE, LAST_COLUMN = np.uint64(1), np.uint64(31)


def draw_silhouettes(
    xyz: np.ndarray,
    start: np.ndarray,
    scales: np.ndarray,
    floors: np.ndarray | None = None,
    params: PipelineParams = PipelineParams(),
) -> np.ndarray:
    """Draw the silhouettes of K clusters.

    The steps are those of the paper, unless params.stm changes them:

    1. Rotate the cluster about z so that its widest direction in x-y becomes y. The direction is
       found by PCA and points to the left as seen from the sensor.
    2. Add the CPA copies, contracted towards the centroid in y-z.
    3. Stretch the y-z extent to the window.
    4. Apply a 3 x 3 closing and a 3 x 3 dilation.

    Args:
        xyz: (N, 3) float32 points, sorted by cluster.
        start: (K + 1,); cluster k has the rows start[k]:start[k + 1], at least one row.
        scales: (K, S) float64 scales a_k of the CPA copies; 1 for the original points (see
            compute_cpa_scales).
        floors: (K,) z of the ground below each cluster, for the metric window only.

    Returns:
        (K, 80) uint32.
    """
    stm, resolution = params.stm, params.resolution
    floors = np.zeros(len(start) - 1) if floors is None else floors
    half_angles = np.radians([resolution.azimuth_step, resolution.elevation_step]) / 2 * stm.spread
    return _draw_silhouettes(
        np.ascontiguousarray(xyz, np.float32),
        np.asarray(start, np.int64),
        scales,
        np.asarray(floors, np.float64),
        stm.window == "metric",
        stm.axis == "pca",
        half_angles,
        stm.dilations,
    )


def compute_cpa_scales(ranges: np.ndarray, params: CpaParams) -> np.ndarray:
    """Compute the scales (K, 1 + steps) float64 of the CPA copies.

    The first scale is 1, for the original points. The others are a_k = max(min_scale, 1 - k
    decrement) if the horizontal range (K,) is in [min_range, max_range), otherwise 1, which adds no
    points.
    """
    steps = np.arange(1 + params.steps)
    copy_scales = np.maximum(params.min_scale, 1.0 - steps * params.decrement)
    copy_scales[0] = 1.0
    is_in_range = (ranges >= params.min_range) & (ranges < params.max_range)
    return np.where(is_in_range[:, None], copy_scales, 1.0)


def compute_similarity(images: np.ndarray, template: np.ndarray, params: StmParams = StmParams()) -> np.ndarray:
    """Compute the cosine similarity (K,) of images (K, 80) and a template (80,); 0 if either is blank.

    The images are shifted horizontally by up to params.shifts columns, and the highest similarity
    is returned. With params.seen_only, only rows down to the lowest row in which both have pixels
    are compared.
    """
    if params.seen_only and params.window == "metric":
        rows = np.arange(ROWS)
        last_rows = np.minimum(
            ROWS - 1 - (images[:, ::-1] != 0).argmax(axis=1), ROWS - 1 - (template[::-1] != 0).argmax()
        )
        row_mask = np.where(rows <= last_rows[:, None], np.uint32(FULL_ROW), np.uint32(0))
        images, templates = images & row_mask, template & row_mask
    else:
        templates = template[None]
    norms = np.sqrt(count_pixels(images) * count_pixels(templates).astype(float))
    shared_counts = count_pixels(images & templates)
    for columns in range(1, params.shifts + 1):
        for shifted_images in (images << np.uint32(columns), images >> np.uint32(columns)):
            shared_counts = np.maximum(shared_counts, count_pixels(shifted_images & templates))
    return np.divide(shared_counts, norms, out=np.zeros(len(images)), where=norms > 0)


def to_pixels(image: np.ndarray) -> np.ndarray:
    """Convert a silhouette (80,) uint32 to (80, 32) bool; row 0 is the top, column 0 is bit 0."""
    return (image[:, None] >> np.arange(COLUMNS, dtype=np.uint32) & 1).astype(bool)


def count_pixels(images: np.ndarray) -> np.ndarray:
    """Return the number of set bits (K,) of each image (K, 80) uint32."""
    return np.unpackbits(images.view(np.uint8), axis=1).sum(axis=1, dtype=np.int64)


@njit(cache=True, nogil=True)
def _draw_silhouettes(xyz, start, scales, floors, is_metric, use_pca, half_angles, dilations):
    images = np.zeros((len(start) - 1, ROWS), np.uint32)
    rows = np.empty(ROWS, np.uint64)
    for k in range(len(start) - 1):
        points = xyz[start[k] : start[k + 1]]
        centre = _find_centroid(points)
        lateral, vertical = _find_principal_axes(points, centre) if use_pca else _find_yaw_axes(points, centre)
        y, z = np.empty(len(points)), np.empty(len(points))
        for i in range(len(points)):
            y[i] = z[i] = 0.0
            for j in range(3):
                y[i] += (points[i, j] - centre[j]) * lateral[j]
                z[i] += (points[i, j] - centre[j]) * vertical[j]
        half_sizes = half_angles * np.hypot(centre[0], centre[1])
        # The window is defined by its left edge, its top edge and its pixels per metre. The centroid
        # is the origin of y and z, so the CPA copies, whose scales are at most 1, fit in the window.
        if is_metric:
            left = (y.min() + y.max() - WINDOW_WIDTH_M) / 2
            top = floors[k] + WINDOW_HEIGHT_M - centre[2]
            columns_per_m, rows_per_m = COLUMNS / WINDOW_WIDTH_M, ROWS / WINDOW_HEIGHT_M
        else:
            left, top = y.min() - half_sizes[0], z.max() + half_sizes[1]
            columns_per_m = COLUMNS / max(y.max() + half_sizes[0] - left, 1e-6)
            rows_per_m = ROWS / max(top - z.min() + half_sizes[1], 1e-6)
        rows[:] = 0
        _draw_points(y, z, scales[k], is_metric, half_sizes, left, top, columns_per_m, rows_per_m, rows)
        image = _erode(_dilate(rows))
        for _ in range(dilations):
            image = _dilate(image)
        images[k] = image.astype(np.uint32)
    return images


@njit(cache=True, nogil=True)
def _draw_points(y, z, scales, is_metric, half_sizes, left, top, columns_per_m, rows_per_m, rows):
    for s in range(len(scales)):
        if s > 0 and scales[s] == 1.0:
            continue
        for i in range(len(y)):
            first_column = int(np.floor((scales[s] * y[i] - half_sizes[0] - left) * columns_per_m))
            last_column = int(np.floor((scales[s] * y[i] + half_sizes[0] - left) * columns_per_m))
            top_row = int(np.floor((top - scales[s] * z[i] - half_sizes[1]) * rows_per_m))
            bottom_row = int(np.floor((top - scales[s] * z[i] + half_sizes[1]) * rows_per_m))
            if is_metric and (last_column < 0 or first_column >= COLUMNS or bottom_row < 0 or top_row >= ROWS):
                continue
            # All points are in a stretched window; those on its far edges belong to the last pixels.
            first_column, last_column = min(max(first_column, 0), COLUMNS - 1), min(last_column, COLUMNS - 1)
            top_row = min(top_row, ROWS - 1)
            bits = (FULL_ROW >> np.uint64(31 - last_column + first_column)) << np.uint64(first_column)
            for row in range(max(top_row, 0), min(bottom_row, ROWS - 1) + 1):
                rows[row] |= bits


@njit(cache=True, nogil=True)
def _find_centroid(points):
    mean = np.zeros(3)
    for p in points:
        for j in range(3):
            mean[j] += p[j]
    return mean / len(points)


@njit(cache=True, nogil=True)
def _find_yaw_axes(points, centre):
    """Return two unit vectors: the widest direction in x-y, pointing to the sensor's left, and the up axis."""
    xx, xy, yy = 0.0, 0.0, 0.0
    for p in points:
        dx, dy = p[0] - centre[0], p[1] - centre[1]
        xx += dx * dx
        xy += dx * dy
        yy += dy * dy
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    lateral = np.array([np.cos(angle), np.sin(angle), 0.0])
    if lateral[1] * centre[0] - lateral[0] * centre[1] < 0:
        lateral = -lateral
    return lateral, np.array([0.0, 0.0, 1.0])


@njit(cache=True, nogil=True)
def _find_principal_axes(points, centre):
    """Return the principal axes with the second largest and the largest variance, pointing left and up."""
    scatter = np.zeros((3, 3))
    for p in points:
        for i in range(3):
            for j in range(3):
                scatter[i, j] += (p[i] - centre[i]) * (p[j] - centre[j])
    vectors = np.linalg.eigh(scatter)[1]
    lateral, vertical = vectors[:, 1].copy(), vectors[:, 2].copy()
    if vertical[2] < 0:
        vertical = -vertical
    if lateral[1] * centre[0] - lateral[0] * centre[1] < 0:
        lateral = -lateral
    return lateral, vertical


@njit(cache=True, nogil=True)
def _dilate(rows):
    """Dilate an image with a 3 x 3 kernel; pixels outside the window count as not set."""
    widened_rows = (rows | (rows << ONE) | (rows >> ONE)) & FULL_ROW
    result = widened_rows.copy()
    result[1:] |= widened_rows[:-1]
    result[:-1] |= widened_rows[1:]
    return result


@njit(cache=True, nogil=True)
def _erode(rows):
    """Erode an image with a 3 x 3 kernel; pixels outside the window count as set, so that borders remain."""
    narrowed_rows = rows & ((rows << ONE) | ONE) & ((rows >> ONE) | (ONE << LAST_COLUMN))
    result = narrowed_rows.copy()
    result[1:] &= narrowed_rows[:-1]
    result[:-1] &= narrowed_rows[1:]
    return result
