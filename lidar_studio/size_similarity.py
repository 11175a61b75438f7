"""Similarity of clusters to a seed that is not a pedestrian, by the size of their visible part."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.classes import Size
from lidar_perception.geometry import to_box_frame
from lidar_studio.snap import LONG_OBJECT_M

Array = np.ndarray[Any, Any]
# Standard deviations, as shares of the seed's length, width or height. Hidden parts make a cluster
# shorter, so a deficit in length counts less than an excess.
LENGTH_EXCESS, LENGTH_DEFICIT, WIDTH_EXCESS, HEIGHT_DEVIATION = 0.12, 0.3, 0.2, 0.12
END_VIEW_PENALTY = 0.5  # deviation added where only the front or rear may be visible
ROWS, COLUMNS = 20, 48  # pixels of a side view


def compute_size_similarity(shapes: Array, size: Size) -> Array:
    """Compute how well clusters fit the visible part of an object of a size, (T,) float64 in 0..1.

    Objects longer than LONG_OBJECT_M may show only their front or rear, so the longer side of a
    cluster may also be the width.

    Args:
        shapes: (T, 7) L-shapes of the clusters, down to the ground.
        size: length, width and height in metres.
    """
    length, width, height = size
    long, short, tall = (shapes[:, k].astype(np.float64) for k in (3, 4, 5))
    beyond = long / length - 1
    off = np.hypot(np.where(beyond > 0, beyond / LENGTH_EXCESS, beyond / LENGTH_DEFICIT),
                   np.maximum(short / width - 1, 0) / WIDTH_EXCESS)
    if length > LONG_OBJECT_M:
        off = np.minimum(off, np.hypot((long / width - 1) / WIDTH_EXCESS, END_VIEW_PENALTY))
    return np.exp(-0.5 * (off ** 2 + ((tall / height - 1) / HEIGHT_DEVIATION) ** 2))


def draw_side_view(xyz: Array, box: Array, cell: float) -> Array:
    """Draw points (N, 3) as seen from the side of a box (7,), (ROWS, COLUMNS) bool.

    The front is on the right, the bottom of the box at the last row. cell: pixel size in metres.
    """
    at = to_box_frame(xyz, box)
    column = np.floor(at[:, 0] / cell + COLUMNS / 2).astype(int)
    row = ROWS - 1 - np.floor((at[:, 2] + box[5] / 2) / cell).astype(int)
    inside = (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
    image = np.zeros((ROWS, COLUMNS), bool)
    image[row[inside], column[inside]] = True
    return image


def choose_cell_size(*boxes: Array) -> float:
    """Return the pixel size in metres at which every box (7,) fits into a side view."""
    return max(0.05, *(max(b[3] / (COLUMNS - 2), b[5] / (ROWS - 1)) for b in boxes))
