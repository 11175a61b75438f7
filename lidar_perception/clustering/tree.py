"""A k-d tree for points of any density.

In a dense cloud, one neighbourhood of a grid can hold all points. A search in the tree visits few
boxes, and found points are removed and never visited again.

Each box is split at the median, so the tree is balanced even if points coincide. Distances are
float64 and computed as in the grid. Distances to boxes are rounded the same way, so that a box is
skipped or accepted as a whole only if each of its points would be.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

from lidar_perception.geometry import counting_sort

LEAF_SIZE = 16  # maximum number of points of a leaf
STACK_SIZE = 64  # maximum number of boxes waiting in a search: the levels plus one

# order (N,) are the points' rows in the input, points (N, 3) their float64 coordinates, both sorted
# by box. Box 1 holds all points, box k is halved into 2 k and 2 k + 1, and boxes from `leaves` on
# are leaves. The points of box k are begin[k] .. end[k] - 1, with corners low[k] and high[k].
Tree = namedtuple("Tree", "order points leaves begin end low high")


def build_tree(xyz: np.ndarray) -> Tree:
    """Build the tree of finite points (N, 3), N > 0."""
    return Tree(*_build(np.ascontiguousarray(xyz, np.float64).copy()))


@njit(cache=True, nogil=True)
def _build(points):
    n, leaves = len(points), 1
    while leaves * LEAF_SIZE < n:
        leaves *= 2
    order = np.arange(n)
    begin, end = np.zeros(2 * leaves, np.int64), np.zeros(2 * leaves, np.int64)
    low, high = np.full((2 * leaves, 3), np.inf), np.full((2 * leaves, 3), -np.inf)
    end[1] = n
    for k in range(1, 2 * leaves):
        for i in range(begin[k], end[k]):
            for axis in range(3):
                low[k, axis] = min(low[k, axis], points[i, axis])
                high[k, axis] = max(high[k, axis], points[i, axis])
        if k < leaves:
            middle = (begin[k] + end[k]) // 2
            axis = (high[k] - low[k]).argmax()
            _partition(points, order, begin[k], end[k] - 1, middle, axis)
            begin[2 * k], end[2 * k] = begin[k], middle
            begin[2 * k + 1], end[2 * k + 1] = middle, end[k]
    return order, points, leaves, begin, end, low, high


@njit(cache=True, nogil=True)
def _partition(points, order, first, last, middle, axis):
    """Reorder rows first..last so that none before `middle` exceeds one after it (Hoare)."""
    state = np.uint64(0x632BE59BD9B4E019)
    while first < last:
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        pivot = points[first + np.int64((state >> np.uint64(33)) % np.uint64(last - first + 1)), axis]
        i, j = first, last
        while i <= j:
            while points[i, axis] < pivot:
                i += 1
            while points[j, axis] > pivot:
                j -= 1
            if i <= j:
                for c in range(3):
                    points[i, c], points[j, c] = points[j, c], points[i, c]
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            last = j
        elif middle >= i:
            first = i
        else:
            return


@njit(cache=True, nogil=True)
def compute_squared_distance(p, q):
    """Return the squared distance between points p (3,) and q (3,)."""
    dx, dy, dz = p[0] - q[0], p[1] - q[1], p[2] - q[2]
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _compute_min_squared_distance(tree, k, p):
    """Return the squared distance from p to box k; no point in the box is nearer."""
    dx = max(tree.low[k, 0] - p[0], 0.0, p[0] - tree.high[k, 0])
    dy = max(tree.low[k, 1] - p[1], 0.0, p[1] - tree.high[k, 1])
    dz = max(tree.low[k, 2] - p[2], 0.0, p[2] - tree.high[k, 2])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _compute_max_squared_distance(tree, k, p):
    """Return the squared distance from p to the farthest corner of box k."""
    dx = max(tree.high[k, 0] - p[0], p[0] - tree.low[k, 0])
    dy = max(tree.high[k, 1] - p[1], p[1] - tree.low[k, 1])
    dz = max(tree.high[k, 2] - p[2], p[2] - tree.low[k, 2])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _push_halves(tree, stack, stack_size, k, p):
    """Push the halves of box k onto the stack, the nearer one on top."""
    bottom, top = 2 * k, 2 * k + 1
    if _compute_min_squared_distance(tree, bottom, p) < _compute_min_squared_distance(tree, top, p):
        bottom, top = top, bottom
    stack[stack_size], stack[stack_size + 1] = bottom, top
    return stack_size + 2


@njit(cache=True, nogil=True)
def find_nearest_distances(tree):
    """Find each point's squared distance to the nearest other point.

    Returns:
        (N,) squared distances in the order of the tree, inf for a single point, and the number of
        distances computed.
    """
    squared, stack, work = np.full(len(tree.points), np.inf), np.empty(STACK_SIZE, np.int64), 0
    for i in range(len(squared)):
        p, best, stack_size = tree.points[i], np.inf, 1
        stack[0] = 1
        while stack_size:
            stack_size -= 1
            k = stack[stack_size]
            if _compute_min_squared_distance(tree, k, p) >= best:
                continue
            if k < tree.leaves:
                stack_size = _push_halves(tree, stack, stack_size, k, p)
                continue
            for j in range(tree.begin[k], tree.end[k]):
                if j != i:
                    best = min(best, compute_squared_distance(p, tree.points[j]))
            work += tree.end[k] - tree.begin[k]
        squared[i] = best
    return squared, work


@njit(cache=True, nogil=True)
def find_core_points_in_tree(tree, reach2, min_points):
    """Find the points with at least min_points points within reach, themselves included.

    Args:
        reach2: (N,) squared reach of each point, in the order of the tree.

    Returns:
        (N,) bool in the order of the tree; the number of distances computed.
    """
    is_core, stack, work = np.zeros(len(tree.points), np.bool_), np.empty(STACK_SIZE, np.int64), 0
    for i in range(len(is_core)):
        p, count, stack_size = tree.points[i], 0, 1
        stack[0] = 1
        while stack_size and count < min_points:
            stack_size -= 1
            k = stack[stack_size]
            if _compute_min_squared_distance(tree, k, p) > reach2[i]:
                continue
            if _compute_max_squared_distance(tree, k, p) <= reach2[i]:
                count += tree.end[k] - tree.begin[k]
            elif k < tree.leaves:
                stack_size = _push_halves(tree, stack, stack_size, k, p)
            else:
                for j in range(tree.begin[k], tree.end[k]):
                    count += 1 if compute_squared_distance(p, tree.points[j]) <= reach2[i] else 0
                work += tree.end[k] - tree.begin[k]
        is_core[i] = count >= min_points
    return is_core, work


@njit(cache=True, nogil=True)
def _find_box_maxima(tree, values, selected):
    """Return the largest value of each box's selected points (-1 if it has none), and their count."""
    max_values, counts = np.full(2 * tree.leaves, -1.0), np.zeros(2 * tree.leaves, np.int64)
    for k in range(2 * tree.leaves - 1, 0, -1):
        if k < tree.leaves:
            max_values[k] = max(max_values[2 * k], max_values[2 * k + 1])
            counts[k] = counts[2 * k] + counts[2 * k + 1]
        else:
            for i in range(tree.begin[k], tree.end[k]):
                if selected[i]:
                    max_values[k] = max(max_values[k], values[i])
                    counts[k] += 1
    return max_values, counts


@njit(cache=True, nogil=True)
def _find_leaves(tree):
    leaf = np.empty(len(tree.points), np.int64)
    for k in range(tree.leaves, 2 * tree.leaves):
        leaf[tree.begin[k] : tree.end[k]] = k
    return leaf


@njit(cache=True, nogil=True)
def _are_linked(squared, a, b, gamma):
    """Return True if two points at a squared distance are linked.

    With gamma 0, a and b are squared reaches, and the points are within the larger one; otherwise
    a and b are diameters, and the points are nearer than gamma times their mean.
    """
    if gamma == 0.0:
        return squared <= max(a, b)
    return np.sqrt(squared) < gamma * (a + b) / 2


@njit(cache=True, nogil=True)
def find_components(tree, size, selected, gamma, max_work):
    """Find the connected sets of the selected points.

    All arrays are in the order of the tree.

    Args:
        size: (N,) squared reach or diameter of each point, see _are_linked.
        selected: (N,) bool.
        gamma: see _are_linked.
        max_work: number of distances at which the search stops.

    Returns:
        component (N,), the set of each point, -1 for points that are not selected; the number of
        distances computed. If that exceeds max_work, the sets are incomplete.
    """
    max_sizes, remaining = _find_box_maxima(tree, size, selected)
    leaf, component = _find_leaves(tree), np.full(len(tree.points), -1)
    stack, pending, count, work = np.empty(STACK_SIZE, np.int64), np.empty(len(leaf), np.int64), 0, 0
    for seed in range(len(component)):
        if not selected[seed] or component[seed] >= 0:
            continue
        _remove_point(remaining, leaf[seed])
        component[seed], pending[0], pending_count = count, seed, 1
        while pending_count:
            # The point found last is the farthest and reaches most points that are not found yet.
            pending_count -= 1
            i = pending[pending_count]
            if work > max_work:
                return component, work
            p, stack_size = tree.points[i], 1
            stack[0] = 1
            while stack_size:
                stack_size -= 1
                k = stack[stack_size]
                if remaining[k] == 0 or not _are_linked(
                    _compute_min_squared_distance(tree, k, p), size[i], max_sizes[k], gamma
                ):
                    continue
                if k < tree.leaves:
                    stack_size = _push_halves(tree, stack, stack_size, k, p)
                    continue
                for j in range(tree.begin[k], tree.end[k]):
                    if selected[j] and component[j] < 0:
                        work += 1
                        if _are_linked(compute_squared_distance(p, tree.points[j]), size[i], size[j], gamma):
                            component[j], pending[pending_count] = count, j
                            pending_count += 1
                            _remove_point(remaining, k)
        count += 1
    return component, work


@njit(cache=True, nogil=True)
def _remove_point(remaining, k):
    """Subtract one point from the counts of box k and of all boxes that contain it."""
    while k > 0:
        remaining[k] -= 1
        k //= 2


@njit(cache=True, nogil=True)
def find_nearest_core_points(tree, reach2, is_core):
    """Find, for each other point, the nearest core point whose reach includes it.

    Of equally near core points, the one with the least x, then y, then z is chosen. All arrays are
    in the order of the tree.

    Args:
        reach2: (N,) squared reach of each point.
        is_core: (N,) bool.

    Returns:
        nearest (N,), the core point of each point, -1 for none and for core points; the number of
        distances computed.
    """
    max_reach2, core_counts = _find_box_maxima(tree, reach2, is_core)
    nearest, stack, work = np.full(len(is_core), -1), np.empty(STACK_SIZE, np.int64), 0
    for i in range(len(is_core)):
        if is_core[i]:
            continue
        p, best, stack_size = tree.points[i], np.inf, 1
        stack[0] = 1
        while stack_size:
            stack_size -= 1
            k = stack[stack_size]
            squared = _compute_min_squared_distance(tree, k, p)
            if (
                core_counts[k] == 0
                or squared > min(best, max_reach2[k])
                or (squared == best and not _precedes(tree.low[k], tree.points[nearest[i]]))
            ):
                continue
            if k < tree.leaves:
                stack_size = _push_halves(tree, stack, stack_size, k, p)
                continue
            for j in range(tree.begin[k], tree.end[k]):
                if is_core[j]:
                    work += 1
                    squared, q = compute_squared_distance(p, tree.points[j]), tree.points[j]
                    if squared <= reach2[j] and (
                        squared < best or (squared == best and _precedes(q, tree.points[nearest[i]]))
                    ):
                        best, nearest[i] = squared, j
    return nearest, work


@njit(cache=True, nogil=True)
def _precedes(p, q):
    return (p[0], p[1], p[2]) < (q[0], q[1], q[2])


@njit(cache=True, nogil=True)
def find_touching_labels(tree, label, side, reach2, max_work):
    """Connect the labels that have points of opposite sides within reach of each other.

    Args:
        label: (N,) labels from 0, in the order of the tree.
        side: (N,) 0 or 1, in the order of the tree.
        reach2: squared reach.
        max_work: number of distances at which the search stops.

    Returns:
        (P, 2) pairs of labels that connect the same labels as all pairs of points within reach,
        where P is less than the number of labels; the number of distances computed. If that exceeds
        max_work, pairs are missing.
    """
    n = len(label)
    limits = np.full(n, reach2)
    remaining = (_find_box_maxima(tree, limits, side == 0)[1], _find_box_maxima(tree, limits, side == 1)[1])
    by_label, start = counting_sort(label, label.max() + 1, np.arange(n))
    leaf, pairs, count = _find_leaves(tree), np.empty((len(start), 2), np.int64), 0
    is_reached, stack, work = np.zeros(len(start), np.bool_), np.empty(STACK_SIZE, np.int64), 0
    queue = np.empty(n, np.int64)
    for seed in range(len(start) - 1):
        head = tail = 0
        reached = seed
        while True:
            if reached >= 0 and not is_reached[reached]:
                is_reached[reached] = True
                for m in by_label[start[reached] : start[reached + 1]]:
                    _remove_point(remaining[side[m]], leaf[m])
                    queue[tail] = m
                    tail += 1
            if head == tail or work > max_work:
                break
            i, reached = queue[head], -1
            p, opposite, stack_size = tree.points[i], remaining[1 - side[i]], 1
            stack[0] = 1
            while stack_size and reached < 0:
                stack_size -= 1
                k = stack[stack_size]
                if opposite[k] == 0 or _compute_min_squared_distance(tree, k, p) > reach2:
                    continue
                if k < tree.leaves:
                    stack_size = _push_halves(tree, stack, stack_size, k, p)
                    continue
                for j in range(tree.begin[k], tree.end[k]):
                    if side[j] != side[i] and not is_reached[label[j]]:
                        work += 1
                        if compute_squared_distance(p, tree.points[j]) <= reach2:
                            reached = label[j]
                            break
            if reached < 0:
                head += 1
            else:
                pairs[count] = label[i], reached
                count += 1
    return pairs[:count], work
