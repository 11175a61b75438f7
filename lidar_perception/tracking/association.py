"""Which detection belongs to which track: the assignment of least cost within gates."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from lidar_perception.geometry import bev_iou
from lidar_perception.tracking.params import FRAME, AssociationParams

FORBIDDEN = 1e3  # more than all pairs that are allowed together cost by far
MAX_COST = 1.0


def costs(tracks: np.ndarray, spread: np.ndarray, kinds: np.ndarray, reach: np.ndarray,
          found: np.ndarray, found_kinds: np.ndarray, params: AssociationParams,
          seconds: float = FRAME) -> np.ndarray:
    """(N, M) float64, up to MAX_COST where a detection can belong to a track, else FORBIDDEN.

    tracks (N, 7) predicted boxes and found (M, 7) detected ones, in the same frame; spread (N,)
    metres, the standard deviation of a predicted centre as it would be measured; kinds (N,),
    found_kinds (M,) indices in KINDS; reach (N,) metres; seconds since the frame before.
    """
    dx, dy = (tracks[:, None, axis] - found[None, :, axis] for axis in (0, 1))
    apart = np.sqrt(dx * dx + dy * dy)
    widest = params.max_gate * max(1.0, seconds / FRAME)
    gate = np.minimum(np.maximum(params.sigmas * spread, reach), widest)[:, None]
    cost = (1.0 - params.overlap) * apart / gate
    if params.overlap > 0:
        cost += params.overlap * (1.0 - bev_iou(tracks, found))
    differ = kinds[:, None] != found_kinds[None, :]
    if differ.any():
        on_foot_or_cycle = (kinds > 0)[:, None] & (found_kinds > 0)[None, :]
        cost += params.other_kind * differ * np.where(on_foot_or_cycle, 0.5, 1.0)
    return np.where((apart <= gate) & (cost <= MAX_COST), cost, FORBIDDEN)


def assigned(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (P,) and columns (P,) of cost (N, M) that belong together, rows rising: as many pairs
    as can be, then of least cost."""
    rows, columns = linear_sum_assignment(cost)
    good = cost[rows, columns] < FORBIDDEN
    return rows[good], columns[good]
