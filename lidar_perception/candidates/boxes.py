"""Cluster boxes snapped to the ground and filtered by height (paper A, Sections 3.4 and 3.5)."""

from __future__ import annotations

import numpy as np

from lidar_perception.candidates.params import HeightParams


def snap_to_ground(boxes: np.ndarray, plane: np.ndarray | None) -> np.ndarray:
    """Boxes (K, 7) with the bottom face moved down to the plane under the box centre; a box that
    already reaches below it stays. Without a plane nothing moves. Paper A, Section 3.4."""
    snapped = boxes.copy()
    if plane is None:
        return snapped
    ground = boxes[:, :2].astype(np.float64) @ plane[:2] + plane[2]
    top = boxes[:, 2] + boxes[:, 5] / 2
    bottom = np.minimum(boxes[:, 2] - boxes[:, 5] / 2, ground)
    snapped[:, 2] = (top + bottom) / 2
    snapped[:, 5] = top - bottom
    return snapped


def height_matches(boxes: np.ndarray, seed_height: float, params: HeightParams) -> np.ndarray:
    """(K,) bool: |h - h_seed| <= tolerance. Paper A, Section 3.5."""
    return np.abs(boxes[:, 5] - seed_height) <= params.tolerance
