"""How high the ground is at a place: a plane through what lies around it."""

from __future__ import annotations

import numpy as np
from numba import njit

RADIUS = 3.0  # metres around a place
FEWEST = 8    # ground points there
STEEPEST = 0.3  # gradient of the plane; a steeper one comes from points along a line
SPREAD = 0.15   # square metres: least variance of the points along either axis of the plane


def surface_under(ground: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(K,) float64 z of the ground at places xy (K, 2), metres: of the plane through the ground's
    points (G, 3) within RADIUS, or their mean where they lie along a line; NaN with less than
    FEWEST of them. Time grows with K times G, so K is of detections, not of points."""
    return _surface_under(np.ascontiguousarray(ground, np.float32).reshape(-1, 3),
                          np.ascontiguousarray(xy, np.float64).reshape(-1, 2))


@njit(cache=True, nogil=True)
def _surface_under(ground, xy):
    heights = np.full(len(xy), np.nan)
    for k in range(len(xy)):
        x, y = xy[k]
        n = sx = sy = sz = xx = yy = cross = xz = yz = 0.0
        for i in range(len(ground)):
            u = ground[i, 0] - x
            if u > RADIUS or u < -RADIUS:
                continue
            v = ground[i, 1] - y
            if u * u + v * v > RADIUS * RADIUS:
                continue
            z = np.float64(ground[i, 2])
            n += 1.0
            sx += u
            sy += v
            sz += z
            xx += u * u
            yy += v * v
            cross += u * v
            xz += u * z
            yz += v * z
        if n < FEWEST:
            continue
        mx, my, mz = sx / n, sy / n, sz / n
        heights[k] = mz
        vxx, vyy, vxy = xx / n - mx * mx, yy / n - my * my, cross / n - mx * my
        least = (vxx + vyy) / 2 - np.sqrt((vxx - vyy) ** 2 / 4 + vxy * vxy)
        if least < SPREAD:
            continue
        determinant = vxx * vyy - vxy * vxy
        vxz, vyz = xz / n - mx * mz, yz / n - my * mz
        a = (vxz * vyy - vyz * vxy) / determinant
        b = (vyz * vxx - vxz * vxy) / determinant
        if a * a + b * b <= STEEPEST * STEEPEST:
            heights[k] = mz - a * mx - b * my
    return heights
