"""Things that are like a seed other than a pedestrian: by the size of what is seen of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.classes import Size
from lidar_perception.geometry import to_box_frame
from lidar_studio.snap import LONG

Array = np.ndarray[Any, Any]
# Shares of the length by which a cluster may be longer, or shorter as a part of it is hidden; of
# the width and the height.
LONGER, SHORTER, WIDER, TALLER = 0.12, 0.3, 0.2, 0.12
BEHIND = 0.5            # how much less is known of what is seen from ahead or behind alone
ROWS, COLUMNS = 20, 48  # of a view from the side


def alike(shapes: Array, size: Size) -> Array:
    """(T,) float64, 0..1: how well the L-shapes (T, 7) of clusters, which stand on the ground, may
    be the visible sides of a thing of a size, length, width and height. What is longer than
    LONG may be seen from ahead or behind, so that its longer side is the width."""
    length, width, height = size
    long, short, tall = (shapes[:, k].astype(np.float64) for k in (3, 4, 5))
    beyond = long / length - 1
    off = np.hypot(np.where(beyond > 0, beyond / LONGER, beyond / SHORTER),
                   np.maximum(short / width - 1, 0) / WIDER)
    if length > LONG:
        off = np.minimum(off, np.hypot((long / width - 1) / WIDER, BEHIND))
    return np.exp(-0.5 * (off ** 2 + ((tall / height - 1) / TALLER) ** 2))


def side_view(xyz: Array, box: Array, cell: float) -> Array:
    """(ROWS, COLUMNS) bool: points (N, 3) seen from the side of a box (7,), its front to the right
    and its bottom at the last row; cell in metres."""
    at = to_box_frame(xyz, box)
    column = np.floor(at[:, 0] / cell + COLUMNS / 2).astype(int)
    row = ROWS - 1 - np.floor((at[:, 2] + box[5] / 2) / cell).astype(int)
    inside = (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
    image = np.zeros((ROWS, COLUMNS), bool)
    image[row[inside], column[inside]] = True
    return image


def cell_of(*boxes: Array) -> float:
    """Metres of a cell in which all boxes (7,) fit into a side_view."""
    return max(0.05, *(max(b[3] / (COLUMNS - 2), b[5] / (ROWS - 1)) for b in boxes))
