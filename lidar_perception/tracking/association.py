"""Assignment of detections to tracks with minimum total cost within gates.

The run time grows with the number of pairs within the gates, not with tracks times detections.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lidar_perception.geometry import MAX_CORNERS, footprint_radii, lower_bound, overlap_area
from lidar_perception.tracking.params import NOMINAL_PERIOD_S, AssociationParams

FORBIDDEN_COST = 1e5  # cost of a forbidden pair, higher than the total cost of all allowed pairs
MAX_COST = 1.0  # maximum cost of an allowed pair


class Pairs(NamedTuple):
    """P allowed pairs of tracks and detections, sorted by track, then by detection.

    Attributes:
        tracks: (P,) indices of the tracks.
        boxes: (P,) indices of the detections.
        costs: (P,) float64, at most MAX_COST.
    """

    tracks: np.ndarray
    boxes: np.ndarray
    costs: np.ndarray

    def select(self, selection: np.ndarray) -> Pairs:
        """Return the selected pairs, given a mask (P,) bool or indices."""
        return Pairs(*(column[selection] for column in self))


def find_pairs(
    tracks: np.ndarray,
    deviations: np.ndarray,
    models: np.ndarray,
    min_gates: np.ndarray,
    boxes: np.ndarray,
    box_models: np.ndarray,
    params: AssociationParams,
    seconds: float = NOMINAL_PERIOD_S,
) -> Pairs:
    """Find the detections that can belong to each track, and the cost of assigning them.

    Args:
        tracks: (N, 7) predicted boxes.
        deviations: (N,) standard deviations of measured centres from predicted ones, metres.
        models: (N,) motion models of the tracks, indices into MOTION_MODELS.
        min_gates: (N,) minimum gate radii, metres.
        boxes: (M, 7) detected boxes in the same frame as the tracks.
        box_models: (M,) motion models of the detections, indices into MOTION_MODELS.
        seconds: Time since the previous frame.
    """
    max_gate = params.max_gate * max(1.0, seconds / NOMINAL_PERIOD_S)
    gates = np.minimum(np.maximum(params.sigmas * deviations, min_gates), max_gate)
    order = np.argsort(boxes[:, 0], kind="stable")
    i, j, distances, ious = _find_pairs_in_gates(
        np.ascontiguousarray(tracks), gates, np.ascontiguousarray(boxes), order, params.overlap > 0
    )
    costs = (1.0 - params.overlap) * distances / gates[i]
    if params.overlap > 0:
        costs += params.overlap * (1.0 - ious)
    is_other_model = models[i] != box_models[j]
    are_both_persons = (models[i] > 0) & (box_models[j] > 0)
    costs += params.other_kind * is_other_model * np.where(are_both_persons, 0.5, 1.0)
    allowed_pairs = np.flatnonzero(costs <= MAX_COST)
    return Pairs(i, j, costs).select(allowed_pairs[np.lexsort((j[allowed_pairs], i[allowed_pairs]))])


@njit(cache=True, nogil=True)
def _find_pairs_in_gates(tracks, gates, boxes, order, with_iou):
    """Find the pairs of tracks (N, 7) and boxes (M, 7) within the gates, whose radii are gates (N,).

    `order` (M,) sorts the boxes by x. Returns the track, the box, the distance of the centres, and
    the BEV IoU (0 without with_iou) of each pair, (P,).
    """
    x = boxes[order, 0]
    track_radii, box_radii = footprint_radii(tracks), footprint_radii(boxes)
    buffer = np.empty((4, MAX_CORNERS))
    i, j, distances, ious = [0], [0], [0.0], [0.0]  # the first items define the types for Numba
    for track in range(len(tracks)):
        a = tracks[track]
        # The margin is slightly wider than the gate, so that rounding loses no pair.
        margin = gates[track] + 1e-9 * (abs(a[0]) + gates[track])
        for position in range(lower_bound(x, a[0] - margin), len(x)):
            if x[position] > a[0] + margin:
                break
            b = boxes[order[position]]
            dx, dy = a[0] - b[0], a[1] - b[1]
            distance = np.sqrt(dx * dx + dy * dy)
            if distance <= gates[track]:
                overlap = 0.0
                if with_iou:
                    overlap = overlap_area(a, b, track_radii[track] + box_radii[order[position]], buffer)
                i.append(track)
                j.append(order[position])
                distances.append(distance)
                ious.append(overlap / (a[3] * a[4] + b[3] * b[4] - overlap) if overlap > 0 else 0.0)
    return np.array(i)[1:], np.array(j)[1:], np.array(distances)[1:], np.array(ious)[1:]


def assign(pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Assign as many detections as possible to tracks, at the minimum total cost.

    Returns the indices of the tracks (P,), ascending, and of their detections (P,).
    """
    components = _label_components(pairs)
    is_single = np.bincount(components)[components] == 1
    parts = [np.flatnonzero(is_single)]
    conflicting_pairs = np.flatnonzero(~is_single)
    conflicting_pairs = conflicting_pairs[np.argsort(components[conflicting_pairs], kind="stable")]
    for group in np.split(conflicting_pairs, np.flatnonzero(np.diff(components[conflicting_pairs])) + 1):
        if len(group):
            parts.append(group[_assign_component(pairs.select(group))])
    assigned_pairs = np.sort(np.concatenate(parts))
    return pairs.tracks[assigned_pairs], pairs.boxes[assigned_pairs]


def _label_components(pairs: Pairs) -> np.ndarray:
    """Label the connected components (P,) of pairs; pairs with a common track or box are connected."""
    first_box = pairs.tracks.max(initial=-1) + 1
    count = first_box + pairs.boxes.max(initial=-1) + 1
    graph = coo_array((np.ones(len(pairs.tracks)), (pairs.tracks, first_box + pairs.boxes)), shape=(count, count))
    return connected_components(graph, directed=False)[1][pairs.tracks]


def _assign_component(pairs: Pairs) -> np.ndarray:
    """Return the indices of the assigned pairs within one connected component."""
    tracks, i = np.unique(pairs.tracks, return_inverse=True)
    boxes, j = np.unique(pairs.boxes, return_inverse=True)
    costs = np.full((len(tracks), len(boxes)), FORBIDDEN_COST)
    pair_indices = np.full(costs.shape, -1)
    costs[i, j], pair_indices[i, j] = pairs.costs, np.arange(len(i))
    assigned_pairs = pair_indices[linear_sum_assignment(costs)]
    return assigned_pairs[assigned_pairs >= 0]
