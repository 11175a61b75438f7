"""Cluster boxes snapped to the ground and filtered by height (paper A, Sections 3.4 and 3.5)."""

from __future__ import annotations

import numpy as np

from lidar_perception.candidates.params import HeightParams


def snap_to_ground(boxes: np.ndarray, plane: np.ndarray | None) -> np.ndarray:
    """Return boxes (K, 7) whose bottom is lowered to the plane under their centre (Section 3.4).

    A box that already reaches below the plane is not changed. Without a plane no box is.
    """
    snapped = boxes.copy()
    if plane is None:
        return snapped
    ground = boxes[:, :2].astype(np.float64) @ plane[:2] + plane[2]
    top = boxes[:, 2] + boxes[:, 5] / 2
    bottom = np.minimum(boxes[:, 2] - boxes[:, 5] / 2, ground)
    snapped[:, 2] = (top + bottom) / 2
    snapped[:, 5] = top - bottom
    return snapped


def select_by_height(boxes: np.ndarray, seed_height: float, params: HeightParams) -> np.ndarray:
    """Return (K,) bool: |h - h_seed| <= tolerance (Section 3.5)."""
    return np.abs(boxes[:, 5] - seed_height) <= params.tolerance
