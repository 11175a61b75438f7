"""Height of the ground at a place, from a plane through the ground points around it."""

from __future__ import annotations

import numpy as np
from numba import njit

RADIUS_M = 3.0          # around a place
MIN_POINTS = 8          # ground points within the radius
MAX_GRADIENT = 0.3      # steeper planes come from points along a line
MIN_VARIANCE_M2 = 0.15  # smallest variance of the points along either principal axis in x-y


def fit_ground_heights(ground: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Fit the height of the ground at places xy (K, 2) to ground points (G, 3), in metres.

    Time grows with K * G: meant for detections, not for all points of a cloud.

    Returns:
        (K,) float64 z of the plane through the ground points within RADIUS_M, or their mean z if
        they are on a line; NaN for fewer than MIN_POINTS.
    """
    return _fit_ground_heights(np.ascontiguousarray(ground, np.float32).reshape(-1, 3),
                               np.ascontiguousarray(xy, np.float64).reshape(-1, 2))


@njit(cache=True, nogil=True)
def _fit_ground_heights(ground, xy):
    heights = np.full(len(xy), np.nan)
    for k in range(len(xy)):
        x, y = xy[k]
        n = sx = sy = sz = xx = yy = cross = xz = yz = 0.0
        for i in range(len(ground)):
            u = ground[i, 0] - x
            if u > RADIUS_M or u < -RADIUS_M:
                continue
            v = ground[i, 1] - y
            if u * u + v * v > RADIUS_M * RADIUS_M:
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
        if n < MIN_POINTS:
            continue
        mx, my, mz = sx / n, sy / n, sz / n
        heights[k] = mz
        vxx, vyy, vxy = xx / n - mx * mx, yy / n - my * my, cross / n - mx * my
        least = (vxx + vyy) / 2 - np.sqrt((vxx - vyy) ** 2 / 4 + vxy * vxy)
        if least < MIN_VARIANCE_M2:
            continue
        determinant = vxx * vyy - vxy * vxy
        vxz, vyz = xz / n - mx * mz, yz / n - my * mz
        a = (vxz * vyy - vyz * vxy) / determinant
        b = (vyz * vxx - vxz * vxy) / determinant
        if a * a + b * b <= MAX_GRADIENT * MAX_GRADIENT:
            heights[k] = mz - a * mx - b * my
    return heights
