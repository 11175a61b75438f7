"""Silhouettes of clusters and their similarity: STM with CPA (paper A, Sections 3.6 and 3.7).

A silhouette is (80,) uint32: 80 rows from top to bottom, 32 columns as the bits of a word, so
that closing and dilation are a few shifts a row and the cosine of two binary images is a count
of bits.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.candidates.params import CpaParams, PipelineParams, StmParams

ROWS, COLUMNS = 80, 32  # the paper's window, Table 2
HEIGHT, WIDTH = 2.4, 1.6  # metres, of the metric window
FULL = np.uint64(0xFFFFFFFF)
ONE, LAST = np.uint64(1), np.uint64(31)


def silhouettes(xyz: np.ndarray, start: np.ndarray, scales: np.ndarray,
                floors: np.ndarray | None = None, params: PipelineParams = PipelineParams()
                ) -> np.ndarray:
    """(K, 80) uint32 silhouettes of K clusters.

    xyz (N, 3) float32 holds the clusters one after the other, cluster k in rows
    start[k]:start[k+1] (at least one row each); scales (K, S) float64 are the contractions
    a_k of its CPA copies, 1 for the points themselves (see cpa_scales); floors (K,) the height of
    the ground under each, which only the metric window needs.

    Step by step, as in the paper: turn about z so that the cluster's widest direction in x-y is y
    (PCA, seen from the sensor, so z stays up and the result does not depend on the heading); add
    the copies contracted towards the centroid in y-z; stretch the y-z extent to the window; close
    with 3 x 3, dilate with 3 x 3. params.stm says what is done otherwise.
    """
    stm, cell = params.stm, params.resolution
    floors = np.zeros(len(start) - 1) if floors is None else floors
    half = np.radians([cell.azimuth_step, cell.elevation_step]) / 2 * stm.spread
    return _silhouettes(np.ascontiguousarray(xyz, np.float32), np.asarray(start, np.int64), scales,
                        np.asarray(floors, np.float64), stm.window == "metric", stm.axis == "pca",
                        half, stm.dilations)


def cpa_scales(ranges: np.ndarray, params: CpaParams) -> np.ndarray:
    """(K, 1 + steps) float64: 1 for the cluster itself, then a_k = max(min_scale, 1 - k decrement)
    where the horizontal range (K,) lies in [min_range, max_range), else 1 (no new points)."""
    steps = np.arange(1 + params.steps)
    contracted = np.maximum(params.min_scale, 1.0 - steps * params.decrement)
    contracted[0] = 1.0
    inside = (ranges >= params.min_range) & (ranges < params.max_range)
    return np.where(inside[:, None], contracted, 1.0)


def similarity(images: np.ndarray, template: np.ndarray, params: StmParams = StmParams()
               ) -> np.ndarray:
    """(K,) float64 cosine of binary images (K, 80) with a template (80,); 0 if either is blank.
    params.shifts: the best one of the images moved sideways by up to so many columns.
    params.seen_only: of the rows down to the last that both have."""
    if params.seen_only and params.window == "metric":
        rows = np.arange(ROWS)
        last = np.minimum(ROWS - 1 - (images[:, ::-1] != 0).argmax(axis=1),
                          ROWS - 1 - (template[::-1] != 0).argmax())
        seen = np.where(rows <= last[:, None], np.uint32(FULL), np.uint32(0))
        images, templates = images & seen, template & seen
    else:
        templates = template[None]
    norm = np.sqrt(covered(images) * covered(templates).astype(float))
    shared = covered(images & templates)
    for columns in range(1, params.shifts + 1):
        for moved in (images << np.uint32(columns), images >> np.uint32(columns)):
            shared = np.maximum(shared, covered(moved & templates))
    return np.divide(shared, norm, out=np.zeros(len(images)), where=norm > 0)


def to_pixels(image: np.ndarray) -> np.ndarray:
    """(80, 32) bool of a silhouette (80,) uint32; row 0 on top, column 0 is bit 0."""
    return (image[:, None] >> np.arange(COLUMNS, dtype=np.uint32) & 1).astype(bool)


def from_pixels(pixels: np.ndarray) -> np.ndarray:
    """(80,) uint32 of an (80, 32) bool image; the inverse of to_pixels."""
    weights = np.uint32(1) << np.arange(COLUMNS, dtype=np.uint32)
    return (pixels.astype(np.uint32) * weights).sum(axis=1, dtype=np.uint32)


def covered(images: np.ndarray) -> np.ndarray:
    """(K,) bits set in each image (K, 80) uint32."""
    return np.unpackbits(images.view(np.uint8), axis=1).sum(axis=1, dtype=np.int64)


@njit(cache=True)
def _silhouettes(xyz, start, scales, floors, metric, upright, half, dilations):
    images = np.zeros((len(start) - 1, ROWS), np.uint32)
    rows = np.empty(ROWS, np.uint64)
    for k in range(len(start) - 1):
        points = xyz[start[k]:start[k + 1]]
        centre = _centroid(points)
        lateral, vertical = _principal_axes(points, centre) if upright else _turned(points, centre)
        y, z = np.empty(len(points)), np.empty(len(points))
        for i in range(len(points)):
            y[i] = z[i] = 0.0
            for j in range(3):
                y[i] += (points[i, j] - centre[j]) * lateral[j]
                z[i] += (points[i, j] - centre[j]) * vertical[j]
        reach = half * np.hypot(centre[0], centre[1])
        # The window: its left edge, its top, pixels a metre. The centroid is the origin of y and
        # z, so a copy is a scaled cluster; as scales are at most 1, it reaches no farther.
        if metric:
            left, top = (y.min() + y.max() - WIDTH) / 2, floors[k] + HEIGHT - centre[2]
            per_y, per_z = COLUMNS / WIDTH, ROWS / HEIGHT
        else:
            left, top = y.min() - reach[0], z.max() + reach[1]
            per_y = COLUMNS / max(y.max() + reach[0] - left, 1e-6)
            per_z = ROWS / max(top - z.min() + reach[1], 1e-6)
        rows[:] = 0
        _draw(y, z, scales[k], metric, reach, left, top, per_y, per_z, rows)
        image = _erode(_dilate(rows))
        for _ in range(dilations):
            image = _dilate(image)
        images[k] = image.astype(np.uint32)
    return images


@njit(cache=True)
def _draw(y, z, scales, metric, reach, left, top, per_y, per_z, rows):
    for s in range(len(scales)):
        if s > 0 and scales[s] == 1.0:
            continue
        for i in range(len(y)):
            first = int(np.floor((scales[s] * y[i] - reach[0] - left) * per_y))
            last = int(np.floor((scales[s] * y[i] + reach[0] - left) * per_y))
            high = int(np.floor((top - scales[s] * z[i] - reach[1]) * per_z))
            low = int(np.floor((top - scales[s] * z[i] + reach[1]) * per_z))
            if metric and (last < 0 or first >= COLUMNS or low < 0 or high >= ROWS):
                continue
            # Nothing is outside a stretched window; its far edges belong to the last pixels.
            first, last = min(max(first, 0), COLUMNS - 1), min(last, COLUMNS - 1)
            high = min(high, ROWS - 1)
            bits = (FULL >> np.uint64(31 - last + first)) << np.uint64(first)
            for row in range(max(high, 0), min(low, ROWS - 1) + 1):
                rows[row] |= bits


@njit(cache=True)
def _centroid(points):
    mean = np.zeros(3)
    for p in points:
        for j in range(3):
            mean[j] += p[j]
    return mean / len(points)


@njit(cache=True)
def _turned(points, centre):
    """Unit vectors: the largest spread in x-y, pointing to the left as the sensor sees it; up."""
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


@njit(cache=True)
def _principal_axes(points, centre):
    """Unit vectors of the second largest and the largest spread, to the left and up."""
    spread = np.zeros((3, 3))
    for p in points:
        for i in range(3):
            for j in range(3):
                spread[i, j] += (p[i] - centre[i]) * (p[j] - centre[j])
    vectors = np.linalg.eigh(spread)[1]
    lateral, vertical = vectors[:, 1].copy(), vectors[:, 2].copy()
    if vertical[2] < 0:
        vertical = -vertical
    if lateral[1] * centre[0] - lateral[0] * centre[1] < 0:
        lateral = -lateral
    return lateral, vertical


@njit(cache=True)
def _dilate(rows):
    """3 x 3; nothing comes in from outside the window."""
    wide = (rows | (rows << ONE) | (rows >> ONE)) & FULL
    out = wide.copy()
    out[1:] |= wide[:-1]
    out[:-1] |= wide[1:]
    return out


@njit(cache=True)
def _erode(rows):
    """3 x 3; outside counts as set, so the border of the window does not eat into the image."""
    narrow = rows & ((rows << ONE) | ONE) & ((rows >> ONE) | (ONE << LAST))
    out = narrow.copy()
    out[1:] &= narrow[:-1]
    out[:-1] &= narrow[1:]
    return out
