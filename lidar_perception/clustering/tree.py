"""A k-d tree for points however dense: neighbourhoods in a grid hold all of a dense cloud, but here
a search looks into few boxes, and what is found is taken out and never looked at again.

Boxes are halves of halves by number of points, so the tree is balanced also where points coincide.
Distances are float64, computed as in the grid, and those to boxes round the same way: a box is left
out, or taken whole, only where each of its points would be.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

LEAF = 16    # points of a box that is not halved, or fewer
DEPTH = 64   # boxes that wait in a search: the levels, and one more

# The points' rows order (N,) and coordinates points (N, 3) float64, box by box. Box 1 holds all,
# box k is halved into 2 k and 2 k + 1; the second half of the boxes, from `leaves` on, are not.
# Those of box k are from begin[k] to end[k], between the corners low[k] and high[k].
Tree = namedtuple("Tree", "order points leaves begin end low high")


def tree_of(xyz: np.ndarray) -> Tree:
    """The tree of finite points (N, 3), N > 0."""
    return Tree(*_built(np.ascontiguousarray(xyz, np.float64).copy()))


@njit(cache=True, nogil=True)
def _built(points):
    n, leaves = len(points), 1
    while leaves * LEAF < n:
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
            _halve(points, order, begin[k], end[k] - 1, middle, axis)
            begin[2 * k], end[2 * k] = begin[k], middle
            begin[2 * k + 1], end[2 * k + 1] = middle, end[k]
    return order, points, leaves, begin, end, low, high


@njit(cache=True, nogil=True)
def _halve(points, order, first, last, middle, axis):
    """Put the rows first..last so that none before `middle` is above one from there on (Hoare)."""
    state = np.uint64(0x632BE59BD9B4E019)
    while first < last:
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        pivot = points[first + np.int64((state >> np.uint64(33)) % np.uint64(last - first + 1)),
                       axis]
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
def _squared(p, q):
    dx, dy, dz = p[0] - q[0], p[1] - q[1], p[2] - q[2]
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _nearest_in(tree, k, p):
    """Squared distance of p to box k; that to a point in it is never less."""
    dx = max(tree.low[k, 0] - p[0], 0.0, p[0] - tree.high[k, 0])
    dy = max(tree.low[k, 1] - p[1], 0.0, p[1] - tree.high[k, 1])
    dz = max(tree.low[k, 2] - p[2], 0.0, p[2] - tree.high[k, 2])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _farthest_in(tree, k, p):
    """Squared distance of p to the farthest corner of box k."""
    dx = max(tree.high[k, 0] - p[0], p[0] - tree.low[k, 0])
    dy = max(tree.high[k, 1] - p[1], p[1] - tree.low[k, 1])
    dz = max(tree.high[k, 2] - p[2], p[2] - tree.low[k, 2])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _push(tree, stack, waiting, k, p):
    """Put the halves of box k on the stack, the nearer on top."""
    one, other = 2 * k, 2 * k + 1
    if _nearest_in(tree, one, p) < _nearest_in(tree, other, p):
        one, other = other, one
    stack[waiting], stack[waiting + 1] = one, other
    return waiting + 2


@njit(cache=True, nogil=True)
def nearest(tree):
    """squared (N,): the distance of each point to the nearest other one, inf for one point, in the
    order of the tree; and how many distances were computed."""
    squared, stack, work = np.full(len(tree.points), np.inf), np.empty(DEPTH, np.int64), 0
    for i in range(len(squared)):
        p, best, waiting = tree.points[i], np.inf, 1
        stack[0] = 1
        while waiting:
            waiting -= 1
            k = stack[waiting]
            if _nearest_in(tree, k, p) >= best:
                continue
            if k < tree.leaves:
                waiting = _push(tree, stack, waiting, k, p)
                continue
            for j in range(tree.begin[k], tree.end[k]):
                if j != i:
                    best = min(best, _squared(p, tree.points[j]))
            work += tree.end[k] - tree.begin[k]
        squared[i] = best
    return squared, work


@njit(cache=True, nogil=True)
def crowded(tree, reach2, enough):
    """(N,) bool: at least `enough` points lie within reach, itself included; reach2 (N,) its
    squares, both in the order of the tree. And how many distances were computed."""
    leads, stack, work = np.zeros(len(tree.points), np.bool_), np.empty(DEPTH, np.int64), 0
    for i in range(len(leads)):
        p, count, waiting = tree.points[i], 0, 1
        stack[0] = 1
        while waiting and count < enough:
            waiting -= 1
            k = stack[waiting]
            if _nearest_in(tree, k, p) > reach2[i]:
                continue
            if _farthest_in(tree, k, p) <= reach2[i]:
                count += tree.end[k] - tree.begin[k]
            elif k < tree.leaves:
                waiting = _push(tree, stack, waiting, k, p)
            else:
                for j in range(tree.begin[k], tree.end[k]):
                    count += 1 if _squared(p, tree.points[j]) <= reach2[i] else 0
                work += tree.end[k] - tree.begin[k]
        leads[i] = count >= enough
    return leads, work


@njit(cache=True, nogil=True)
def _largest(tree, values, among):
    """Of each box the largest value among the points chosen, -1 where there is none; and how many
    these are."""
    most, left = np.full(2 * tree.leaves, -1.0), np.zeros(2 * tree.leaves, np.int64)
    for k in range(2 * tree.leaves - 1, 0, -1):
        if k < tree.leaves:
            most[k], left[k] = max(most[2 * k], most[2 * k + 1]), left[2 * k] + left[2 * k + 1]
        else:
            for i in range(tree.begin[k], tree.end[k]):
                if among[i]:
                    most[k] = max(most[k], values[i])
                    left[k] += 1
    return most, left


@njit(cache=True, nogil=True)
def _leaf_of(tree):
    leaf = np.empty(len(tree.points), np.int64)
    for k in range(tree.leaves, 2 * tree.leaves):
        leaf[tree.begin[k]:tree.end[k]] = k
    return leaf


@njit(cache=True, nogil=True)
def _linked(squared, a, b, gamma):
    """With gamma 0, whether points are within the larger of two reaches a, b, both squared; else
    whether they are nearer than gamma times the mean of a and b."""
    if gamma == 0.0:
        return squared <= max(a, b)
    return np.sqrt(squared) < gamma * (a + b) / 2


@njit(cache=True, nogil=True)
def connected(tree, size, among, gamma, most_work):
    """(N,) the connected set of each of the points chosen, among (N,) bool, -1 of the others: sets
    of points that are linked by their sizes (N,), see _linked, all in the order of the tree. And
    how many distances were computed; if more than most_work, the sets are not complete."""
    most, left = _largest(tree, size, among)
    leaf, component = _leaf_of(tree), np.full(len(tree.points), -1)
    stack, found, count, work = np.empty(DEPTH, np.int64), np.empty(len(leaf), np.int64), 0, 0
    for seed in range(len(component)):
        if not among[seed] or component[seed] >= 0:
            continue
        _take(left, leaf[seed])
        component[seed], found[0], last = count, seed, 1
        while last:
            # The last found is the farthest: it reaches most of what is not found yet.
            last -= 1
            i = found[last]
            if work > most_work:
                return component, work
            p, waiting = tree.points[i], 1
            stack[0] = 1
            while waiting:
                waiting -= 1
                k = stack[waiting]
                if left[k] == 0 or not _linked(_nearest_in(tree, k, p), size[i], most[k], gamma):
                    continue
                if k < tree.leaves:
                    waiting = _push(tree, stack, waiting, k, p)
                    continue
                for j in range(tree.begin[k], tree.end[k]):
                    if among[j] and component[j] < 0:
                        work += 1
                        if _linked(_squared(p, tree.points[j]), size[i], size[j], gamma):
                            component[j], found[last] = count, j
                            last += 1
                            _take(left, k)
        count += 1
    return component, work


@njit(cache=True, nogil=True)
def _take(left, k):
    """One point less in box k and those around it."""
    while k > 0:
        left[k] -= 1
        k //= 2


@njit(cache=True, nogil=True)
def nearest_leaders(tree, reach2, leads):
    """(N,) of each point that does not lead the nearest leader whose reach holds it, of equally
    near ones that of the least x, then y, then z; -1 for none, and for leaders. reach2 (N,) squares
    of reaches, leads (N,) bool, all in the order of the tree. And how many distances were
    computed."""
    most, left = _largest(tree, reach2, leads)
    leader, stack, work = np.full(len(leads), -1), np.empty(DEPTH, np.int64), 0
    for i in range(len(leads)):
        if leads[i]:
            continue
        p, best, waiting = tree.points[i], np.inf, 1
        stack[0] = 1
        while waiting:
            waiting -= 1
            k = stack[waiting]
            squared = _nearest_in(tree, k, p)
            if left[k] == 0 or squared > min(best, most[k]) or (
                    squared == best and not _before(tree.low[k], tree.points[leader[i]])):
                continue
            if k < tree.leaves:
                waiting = _push(tree, stack, waiting, k, p)
                continue
            for j in range(tree.begin[k], tree.end[k]):
                if leads[j]:
                    work += 1
                    squared, q = _squared(p, tree.points[j]), tree.points[j]
                    if squared <= reach2[j] and (squared < best or (
                            squared == best and _before(q, tree.points[leader[i]]))):
                        best, leader[i] = squared, j
    return leader, work


@njit(cache=True, nogil=True)
def _before(p, q):
    return (p[0], p[1], p[2]) < (q[0], q[1], q[2])


@njit(cache=True, nogil=True)
def touching(tree, label, side, reach2, most_work):
    """(P, 2) pairs of labels that connect what all pairs would: of points, one of either side,
    within reach of each other. label (N,) from 0 on, side (N,) 0 or 1, in the order of the tree;
    points of one label are connected. P is less than the number of labels. And how many distances
    were computed; if more than most_work, pairs are missing."""
    n = len(label)
    sides = np.empty((2, 2 * tree.leaves), np.int64)
    for s in range(2):
        sides[s] = _largest(tree, reach2 + np.zeros(n), side == s)[1]
    by_label = np.argsort(label, kind="mergesort")
    start = np.searchsorted(label[by_label], np.arange(label.max() + 2))
    leaf, pairs, count = _leaf_of(tree), np.empty((len(start), 2), np.int64), 0
    done, stack, work = np.zeros(len(start), np.bool_), np.empty(DEPTH, np.int64), 0
    queue = np.empty(n, np.int64)
    for seed in range(len(start) - 1):
        first = last = 0
        arrived = seed
        while True:
            if arrived >= 0 and not done[arrived]:
                done[arrived] = True
                for m in by_label[start[arrived]:start[arrived + 1]]:
                    _take(sides[side[m]], leaf[m])
                    queue[last] = m
                    last += 1
            if first == last or work > most_work:
                break
            i, arrived = queue[first], -1
            p, other, waiting = tree.points[i], sides[1 - side[i]], 1
            stack[0] = 1
            while waiting and arrived < 0:
                waiting -= 1
                k = stack[waiting]
                if other[k] == 0 or _nearest_in(tree, k, p) > reach2:
                    continue
                if k < tree.leaves:
                    waiting = _push(tree, stack, waiting, k, p)
                    continue
                for j in range(tree.begin[k], tree.end[k]):
                    if side[j] != side[i] and not done[label[j]]:
                        work += 1
                        if _squared(p, tree.points[j]) <= reach2:
                            arrived = label[j]
                            break
            if arrived < 0:
                first += 1
            else:
                pairs[count] = label[i], arrived
                count += 1
    return pairs[:count], work
