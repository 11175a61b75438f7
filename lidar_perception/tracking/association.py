"""Assignment of detections to tracks with minimum total cost within gates.

Run time grows with the number of pairs within their gates, not with tracks times detections.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.optimize import linear_sum_assignment

from lidar_perception.geometry import MAX_CORNERS, footprint_radii, lower_bound, overlap_area
from lidar_perception.tracking.params import NOMINAL_PERIOD_S, AssociationParams

FORBIDDEN = 1e5  # more than all allowed pairs cost together
MAX_COST = 1.0


class Pairs(NamedTuple):
    """Allowed pairs of tracks and detections, sorted by track, then by detection.

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
    spread: np.ndarray,
    kinds: np.ndarray,
    reach: np.ndarray,
    boxes: np.ndarray,
    box_kinds: np.ndarray,
    params: AssociationParams,
    seconds: float = NOMINAL_PERIOD_S,
) -> Pairs:
    """Find the detections that can belong to each track, and the cost of assigning them.

    Args:
        tracks: (N, 7) predicted boxes.
        spread: (N,) standard deviation of a measured centre around the predicted one, metres.
        kinds: (N,) indices into KINDS.
        reach: (N,) minimum gate, metres.
        boxes: (M, 7) detected boxes in the same frame as the tracks.
        box_kinds: (M,) indices into KINDS.
        params: Parameters of the assignment.
        seconds: Time since the previous frame.
    """
    max_gate = params.max_gate * max(1.0, seconds / NOMINAL_PERIOD_S)
    gate = np.minimum(np.maximum(params.sigmas * spread, reach), max_gate)
    order = np.argsort(boxes[:, 0], kind="stable")
    i, j, distance, iou = _find_pairs_in_gates(
        np.ascontiguousarray(tracks), gate, np.ascontiguousarray(boxes), order, params.overlap > 0
    )
    cost = (1.0 - params.overlap) * distance / gate[i]
    if params.overlap > 0:
        cost += params.overlap * (1.0 - iou)
    is_other_kind = kinds[i] != box_kinds[j]
    are_both_persons = (kinds[i] > 0) & (box_kinds[j] > 0)
    cost += params.other_kind * is_other_kind * np.where(are_both_persons, 0.5, 1.0)
    allowed = np.flatnonzero(cost <= MAX_COST)
    return Pairs(i, j, cost).select(allowed[np.lexsort((j[allowed], i[allowed]))])


@njit(cache=True, nogil=True)
def _find_pairs_in_gates(tracks, gate, boxes, order, with_iou):
    """Return tracks, boxes, distances and BEV IoU (P,) of the pairs within the gate.

    order (M,) are the indices that sort the boxes by x.
    """
    x = boxes[order, 0]
    reach, box_reach = footprint_radii(tracks), footprint_radii(boxes)
    buffer = np.empty((4, MAX_CORNERS))
    i, j, distances, ious = [0], [0], [0.0], [0.0]  # the first item gives the types
    for track in range(len(tracks)):
        a = tracks[track]
        # Slightly wider, so that rounding loses no pair at the gate.
        margin = gate[track] + 1e-9 * (abs(a[0]) + gate[track])
        for position in range(lower_bound(x, a[0] - margin), len(x)):
            if x[position] > a[0] + margin:
                break
            b = boxes[order[position]]
            dx, dy = a[0] - b[0], a[1] - b[1]
            distance = np.sqrt(dx * dx + dy * dy)
            if distance <= gate[track]:
                shared = 0.0
                if with_iou:
                    shared = overlap_area(a, b, reach[track] + box_reach[order[position]], buffer)
                i.append(track)
                j.append(order[position])
                distances.append(distance)
                ious.append(shared / (a[3] * a[4] + b[3] * b[4] - shared) if shared > 0 else 0.0)
    return np.array(i)[1:], np.array(j)[1:], np.array(distances)[1:], np.array(ious)[1:]


def assign(pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Assign as many detections as possible to tracks, at the minimum total cost.

    Returns the indices of the tracks (P,), ascending, and of their detections (P,).
    """
    component = _label_components(pairs.tracks, pairs.boxes)
    is_single = np.bincount(component)[component] == 1
    selected_parts = [np.flatnonzero(is_single)]
    remaining = np.flatnonzero(~is_single)
    remaining = remaining[np.argsort(component[remaining], kind="stable")]
    for group in np.split(remaining, np.flatnonzero(np.diff(component[remaining])) + 1):
        if len(group):
            selected_parts.append(group[_assign_component(pairs.select(group))])
    selected = np.sort(np.concatenate(selected_parts))
    return pairs.tracks[selected], pairs.boxes[selected]


@njit(cache=True, nogil=True)
def _label_components(tracks, boxes):
    """Return the connected component (P,) int64 of each pair: the smallest index of its pairs.

    Pairs with a common track or box are connected.
    """
    parent = np.arange(len(tracks))
    for nodes in (tracks, boxes):
        first = np.full(nodes.max() + 1 if len(nodes) else 0, -1)  # the first pair of each node
        for pair in range(len(nodes)):
            if first[nodes[pair]] < 0:
                first[nodes[pair]] = pair
            root, other_root = _root(parent, first[nodes[pair]]), _root(parent, pair)
            parent[max(root, other_root)] = min(root, other_root)
    for pair in range(len(tracks)):
        parent[pair] = _root(parent, pair)
    return parent


@njit(cache=True, nogil=True)
def _root(parent, node):
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


def _assign_component(pairs: Pairs) -> np.ndarray:
    """Return the indices of the assigned pairs within one connected component."""
    tracks, i = np.unique(pairs.tracks, return_inverse=True)
    boxes, j = np.unique(pairs.boxes, return_inverse=True)
    cost = np.full((len(tracks), len(boxes)), FORBIDDEN)
    index = np.full(cost.shape, -1)
    cost[i, j], index[i, j] = pairs.costs, np.arange(len(i))
    assigned = index[linear_sum_assignment(cost)]
    return assigned[assigned >= 0]
