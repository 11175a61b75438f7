"""Assignment of detections to tracks: least total cost within gates."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from lidar_perception.geometry import bev_iou
from lidar_perception.tracking.params import NOMINAL_PERIOD_S, AssociationParams

FORBIDDEN = 1e3  # far more than all allowed pairs cost together
MAX_COST = 1.0


def compute_costs(tracks: np.ndarray, spread: np.ndarray, kinds: np.ndarray, reach: np.ndarray,
                  boxes: np.ndarray, box_kinds: np.ndarray, params: AssociationParams,
                  seconds: float = NOMINAL_PERIOD_S) -> np.ndarray:
    """Compute the cost of assigning each detection to each track.

    Args:
        tracks: (N, 7) predicted boxes.
        spread: (N,) standard deviation of a measured centre around the predicted one, metres.
        kinds: (N,) indices in KINDS.
        reach: (N,) smallest gate, metres.
        boxes: (M, 7) detected boxes in the frame of tracks.
        box_kinds: (M,) indices in KINDS.
        seconds: time since the previous frame.

    Returns:
        (N, M) float64: at most MAX_COST where the detection can belong to the track, else
        FORBIDDEN.
    """
    dx, dy = (tracks[:, None, axis] - boxes[None, :, axis] for axis in (0, 1))
    distance = np.sqrt(dx * dx + dy * dy)
    widest = params.max_gate * max(1.0, seconds / NOMINAL_PERIOD_S)
    gate = np.minimum(np.maximum(params.sigmas * spread, reach), widest)[:, None]
    cost = (1.0 - params.overlap) * distance / gate
    if params.overlap > 0:
        cost += params.overlap * (1.0 - bev_iou(tracks, boxes))
    differ = kinds[:, None] != box_kinds[None, :]
    if differ.any():
        on_foot_or_cycle = (kinds > 0)[:, None] & (box_kinds > 0)[None, :]
        cost += params.other_kind * differ * np.where(on_foot_or_cycle, 0.5, 1.0)
    return np.where((distance <= gate) & (cost <= MAX_COST), cost, FORBIDDEN)


def assign(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pair rows and columns of cost (N, M): as many allowed pairs as possible, then least cost.

    Returns the rows (P,), ascending, and their columns (P,).
    """
    rows, columns = linear_sum_assignment(cost)
    allowed = cost[rows, columns] < FORBIDDEN
    return rows[allowed], columns[allowed]
