"""Silhouettes of clusters and their similarity: STM with CPA (paper A, Sections 3.6 and 3.7).

A silhouette is (80,) uint32: 80 rows from top to bottom, 32 columns as the bits of a word, so
that closing and dilation are a few shifts a row and the cosine of two binary images is a count
of bits.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.params import CpaParams

ROWS, COLUMNS = 80, 32  # the paper's window, Table 2
FULL = np.uint64(0xFFFFFFFF)
ONE, LAST = np.uint64(1), np.uint64(31)


def silhouettes(xyz: np.ndarray, start: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """(K, 80) uint32 silhouettes of K clusters.

    xyz (N, 3) float32 holds the clusters one after the other, cluster k in rows
    start[k]:start[k+1] (at least one row each); scales (K, S) float64 are the contractions
    a_k of its CPA copies, 1 for the points themselves (see cpa_scales).

    Step by step, as in the paper: turn about z so that the cluster's widest direction in x-y is y
    (PCA, seen from the sensor, so z stays up and the result does not depend on the heading); add
    the copies contracted towards the centroid in y-z; stretch the y-z extent to the window; close
    with 3 x 3, dilate with 3 x 3.
    """
    return _silhouettes(np.ascontiguousarray(xyz, np.float32), np.asarray(start, np.int64), scales)


def cpa_scales(ranges: np.ndarray, params: CpaParams) -> np.ndarray:
    """(K, 1 + steps) float64: 1 for the cluster itself, then a_k = max(min_scale, 1 - k decrement)
    where the horizontal range (K,) lies in [min_range, max_range), else 1 (no new points)."""
    steps = np.arange(1 + params.steps)
    contracted = np.maximum(params.min_scale, 1.0 - steps * params.decrement)
    contracted[0] = 1.0
    inside = (ranges >= params.min_range) & (ranges < params.max_range)
    return np.where(inside[:, None], contracted, 1.0)


def similarity(images: np.ndarray, template: np.ndarray) -> np.ndarray:
    """(K,) float64 cosine of binary images (K, 80) with a template (80,); 0 if either is blank."""
    shared = _bits(images & template)
    norm = np.sqrt(_bits(images) * float(_bits(template[None])[0]))
    return np.divide(shared, norm, out=np.zeros(len(images)), where=norm > 0)


def to_pixels(image: np.ndarray) -> np.ndarray:
    """(80, 32) bool of a silhouette (80,) uint32; row 0 on top, column 0 is bit 0."""
    return (image[:, None] >> np.arange(COLUMNS, dtype=np.uint32) & 1).astype(bool)


def from_pixels(pixels: np.ndarray) -> np.ndarray:
    """(80,) uint32 of an (80, 32) bool image; the inverse of to_pixels."""
    weights = np.uint32(1) << np.arange(COLUMNS, dtype=np.uint32)
    return (pixels.astype(np.uint32) * weights).sum(axis=1, dtype=np.uint32)


def _bits(images: np.ndarray) -> np.ndarray:
    """(K,) bits set in each image (K, 80) uint32."""
    return np.unpackbits(images.view(np.uint8), axis=1).sum(axis=1, dtype=np.int64)


@njit(cache=True)
def _silhouettes(xyz, start, scales):
    images = np.zeros((len(start) - 1, ROWS), np.uint32)
    rows = np.empty(ROWS, np.uint64)
    for k in range(len(start) - 1):
        points = xyz[start[k]:start[k + 1]]
        rows[:] = 0
        _draw(points, _lateral_axis(points), scales[k], rows)
        closed = _erode(_dilate(rows))
        images[k] = _dilate(closed).astype(np.uint32)
    return images


@njit(cache=True)
def _lateral_axis(points):
    """Unit vector (x, y) of the largest spread in x-y, pointing to the left as the sensor sees
    it; (x, y, mean_x, mean_y, mean_z)."""
    mx, my, mz = 0.0, 0.0, 0.0
    for p in points:
        mx += p[0]
        my += p[1]
        mz += p[2]
    mx, my, mz = mx / len(points), my / len(points), mz / len(points)
    xx, xy, yy = 0.0, 0.0, 0.0
    for p in points:
        dx, dy = p[0] - mx, p[1] - my
        xx += dx * dx
        xy += dx * dy
        yy += dy * dy
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    ax, ay = np.cos(angle), np.sin(angle)
    if ay * mx - ax * my < 0:
        ax, ay = -ax, -ay
    return ax, ay, mx, my, mz


@njit(cache=True)
def _draw(points, frame, scales, rows):
    ax, ay, mx, my, mz = frame
    y = np.empty(len(points))
    z = np.empty(len(points))
    for i in range(len(points)):
        y[i] = (points[i, 0] - mx) * ax + (points[i, 1] - my) * ay
        z[i] = points[i, 2] - mz
    # The centroid is the origin of y and z, so a copy is a scaled cluster; as scales are at most
    # 1, the extent is that of the points themselves.
    low, top = y.min(), z.max()
    per_y = COLUMNS / max(y.max() - low, 1e-6)
    per_z = ROWS / max(top - z.min(), 1e-6)
    for s in range(len(scales)):
        if s > 0 and scales[s] == 1.0:
            continue
        for i in range(len(points)):
            column = min(int((scales[s] * y[i] - low) * per_y), COLUMNS - 1)
            row = min(int((top - scales[s] * z[i]) * per_z), ROWS - 1)
            rows[row] |= ONE << np.uint64(column)


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
