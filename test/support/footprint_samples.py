"""Boxes of simulated footprints and overlaps between them, computed by plain geometry."""

from __future__ import annotations

import numpy as np

from lidar_perception.geometry import box_corners
from lidar_perception.simulation.actors import HEADING, LENGTH, SPEED, START, STOP, WIDTH


def compute_centres(footprints, t):
    """Return the centres (M, 2) of footprints (M, 8) at time t."""
    travelled = footprints[:, SPEED] * np.clip(
        t - footprints[:, START], 0.0, footprints[:, STOP] - footprints[:, START]
    )
    heading = footprints[:, HEADING]
    return footprints[:, :2] + travelled[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])


def make_flat_boxes(footprints, t):
    """Return boxes (M, 7) [x y 0 l w 1 heading] of footprints (M, 8) at time t, in the world."""
    centre = compute_centres(footprints, t)
    one, zero = np.ones(len(centre)), np.zeros(len(centre))
    return np.column_stack([centre, zero, 2 * footprints[:, LENGTH : WIDTH + 1], one, footprints[:, HEADING]])


def find_overlaps(boxes, many):
    """Return index pairs (n, 2) of overlapping boxes (M, 7): one of the first `many`, and a later one."""
    corner = box_corners(boxes)[:, :4, :2]
    first, second = np.nonzero(np.arange(many)[:, None] < np.arange(len(boxes)))
    radius = np.hypot(boxes[:, 3], boxes[:, 4]) / 2
    is_close = np.hypot(*(boxes[first, :2] - boxes[second, :2]).T) < radius[first] + radius[second]
    first, second = first[is_close], second[is_close]
    is_apart = np.zeros(len(first), bool)
    for indices in (first, second):
        for rotation in (0.0, np.pi / 2):
            angle = boxes[indices, 6] + rotation
            normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            a, b = (np.einsum("mcd,md->mc", corner[i], normal) for i in (first, second))
            is_apart |= (a.min(1) > b.max(1) - 1e-3) | (b.min(1) > a.max(1) - 1e-3)
    return np.column_stack([first, second])[~is_apart]
