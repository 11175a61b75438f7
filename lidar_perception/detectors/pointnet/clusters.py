"""Clusters of a cloud, and what the network reads of them.

Every cluster is seen from the same side: moved to its mean, and turned about the sensor until it
lies straight ahead, so that no heading of the cloud matters and the network learns from where a
thing is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from lidar_perception.geometry import counting_sort, points_in_boxes
from lidar_perception.groups import group_by_id
from lidar_perception.types import SENSOR_HEIGHT, PointCloud

POINT, CONTEXT = 5, 6  # numbers that the network reads of a point, and of a whole cluster
NEAR = (3.0, 6.0, 12.0)  # m: so far around a cluster the ground is looked for
FEWEST = 3               # points of it
CELLS = 64               # of NEAR[0] m along x and y, then they begin anew: far places share them


@dataclass(frozen=True)
class Clusters:
    """K clusters, K may be 0: points (P, 4) float32 [x y z intensity], those of cluster i from
    first[i] to first[i + 1], first (K + 1,) int64; metres, from a level sensor at SENSOR_HEIGHT.
    ids (K,) int64: the numbers that they had. ground (K,) float64: z of the ground under each; None
    for a flat one under the sensor."""

    points: np.ndarray
    first: np.ndarray
    ids: np.ndarray
    ground: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def sizes(self) -> np.ndarray:
        """(K,) points of each."""
        return np.diff(self.first)

    def take(self, chosen: np.ndarray) -> Clusters:
        """The clusters at indices (M,)."""
        sizes = self.sizes[chosen]
        first = np.concatenate([[0], np.cumsum(sizes)])
        rows = np.repeat(self.first[chosen] - first[:-1], sizes) + np.arange(first[-1])
        return Clusters(self.points[rows], first, self.ids[chosen],
                        None if self.ground is None else self.ground[chosen])

    def nearest(self, most: int) -> Clusters:
        """At most so many, those whose means are nearest to the sensor, in their order."""
        if len(self) <= most:
            return self
        away = np.hypot(*middles(self.points, self.first).T)
        return self.take(np.sort(np.argsort(away, kind="stable")[:most]))

    def on(self, ground: np.ndarray) -> Clusters:
        """The same clusters, none of them empty, over the ground's points (G, 3)."""
        return replace(self, ground=ground_under(ground, middles(self.points, self.first)))

    @property
    def floor(self) -> np.ndarray:
        """(K,) z of the ground under each."""
        return np.full(len(self), -SENSOR_HEIGHT) if self.ground is None else self.ground


@dataclass(frozen=True)
class ClusterInput:
    """What the network reads of K clusters, N = config.points each.

    points (K, N, 5) float32: x y z from the mean, turned, metres; intensity; height over the
    ground there, metres. valid (K, N) bool: False for repeated ones. context (K, 6)
    float32: range, height of the mean, of the lowest and of the highest point, numbers of points,
    and log of the range, all about 0 .. 2. centres (K, 3) float64: the means; azimuths (K,) float64
    of them.
    """

    points: np.ndarray
    valid: np.ndarray
    context: np.ndarray
    centres: np.ndarray
    azimuths: np.ndarray


def clusters_of(frame: PointCloud, cluster_ids: np.ndarray, min_points: int = 1,
                ground: np.ndarray | None = None) -> Clusters:
    """The clusters of a frame of N points, with numbers (N,) int, 0 and below for none, that have
    enough points, by their numbers. Without an intensity it is 0. ground (N,) bool: the points
    that say how high the ground is under each; None for a flat one."""
    groups = group_by_id(np.asarray(cluster_ids), min_points)
    points = np.zeros((len(groups.rows), 4), np.float32)
    points[:, :3] = frame.xyz[groups.rows]
    if frame.intensity is not None:
        points[:, 3] = frame.intensity[groups.rows]
    found = Clusters(points, groups.start, groups.numbers)
    return found if ground is None else found.on(frame.xyz.compress(ground, axis=0))


def points_of(boxes: np.ndarray, frame: PointCloud, margin: float) -> Clusters:
    """Return one cluster for each of boxes (K, 7), in their order: the points of a frame within the
    box, grown by margin metres. A point can be in several; a cluster can be without points."""
    indices, first = points_in_boxes(frame.xyz, boxes, margin)
    points = np.zeros((len(indices), 4), np.float32)
    points[:, :3] = frame.xyz[indices]
    if frame.intensity is not None:
        points[:, 3] = frame.intensity[indices]
    return Clusters(points, first, np.arange(1, len(boxes) + 1))


def ground_under(xyz: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(K,) float64: the mean z of the ground's points (G, 3) around each position xy (K, 2), within
    the first of NEAR that has FEWEST of them; -SENSOR_HEIGHT where none has. Metres."""
    return _ground_under(xyz, np.ascontiguousarray(xy, np.float64))


@njit(cache=True, nogil=True)
def _ground_under(xyz, xy):
    cell = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        cell[i] = _cell(xyz[i, 0], 0) * CELLS + _cell(xyz[i, 1], 0)
    order, start = counting_sort(cell, CELLS * CELLS, np.arange(len(xyz)))
    heights = np.full(len(xy), -SENSOR_HEIGHT)
    for k in range(len(xy)):
        x, y = xy[k]
        for reach in NEAR:
            cells = int(np.ceil(reach / NEAR[0]))
            count, total = 0, 0.0
            for row in range(-cells, cells + 1):
                for column in range(-cells, cells + 1):
                    own = _cell(x, row) * CELLS + _cell(y, column)
                    for j in order[start[own]:start[own + 1]]:
                        if (xyz[j, 0] - x) ** 2 + (xyz[j, 1] - y) ** 2 <= reach * reach:
                            count += 1
                            total += xyz[j, 2]
            if count >= FEWEST:
                heights[k] = total / count
                break
    return heights


@njit(cache=True, nogil=True)
def _cell(along, off):
    return int((np.floor(along / NEAR[0]) + off) % CELLS)


def middles(points: np.ndarray, first: np.ndarray) -> np.ndarray:
    """(K, 2) means of x and y of clusters, none of them empty."""
    if len(first) == 1:
        return np.zeros((0, 2))
    sums = np.add.reduceat(points[:, :2].astype(np.float64), first[:-1], axis=0)
    return sums / np.diff(first)[:, None]


def network_input(clusters: Clusters, count: int, seed: int = 0) -> ClusterInput:
    """At most `count` points of each cluster, drawn at random by the seed (Eq. 13): the same for
    the same points in the same order, whatever clusters are beside them."""
    points, valid, low_high, centres = _sampled(clusters.points, clusters.first, count, seed)
    azimuths = np.arctan2(centres[:, 1], centres[:, 0])
    reach = np.maximum(np.hypot(centres[:, 0], centres[:, 1]), 1e-3)
    inputs = np.empty((*points.shape[:2], 5), np.float32)
    cos, sin = (f(azimuths)[:, None].astype(np.float32) for f in (np.cos, np.sin))
    x, y = points[..., 0], points[..., 1]
    inputs[..., 0], inputs[..., 1] = cos * x + sin * y, cos * y - sin * x
    inputs[..., 2:4] = points[..., 2:]
    floor = clusters.floor
    inputs[..., 4] = points[..., 2] + (centres[:, 2] - floor)[:, None].astype(np.float32)
    context = np.column_stack([
        reach / 50, centres[:, 2] - floor, low_high - floor[:, None],
        np.log(np.maximum(clusters.sizes, 1)) / 5, np.log(reach) / 4])
    return ClusterInput(inputs, valid, context.astype(np.float32), centres, azimuths)


@njit(cache=True, nogil=True)
def _sampled(points, first, count, seed):
    clusters = len(first) - 1
    out = np.zeros((clusters, count, 4), np.float32)
    valid = np.zeros((clusters, count), np.bool_)
    low_high, centres = np.zeros((clusters, 2)), np.zeros((clusters, 3))
    for k in range(clusters):
        begin, size = first[k], first[k + 1] - first[k]
        if size == 0:
            continue
        own = points[begin:begin + size]
        low, high = np.inf, -np.inf
        for i in range(size):
            for axis in range(3):
                centres[k, axis] += own[i, axis]
            low, high = min(low, own[i, 2]), max(high, own[i, 2])
        centres[k] /= size
        low_high[k, 0], low_high[k, 1] = low, high
        indices = np.arange(size)
        state = np.uint64(seed * 0x9E3779B97F4A7C15 + 0x632BE59BD9B4E019)
        kept = min(size, count)
        for i in range(kept):  # the beginning of a shuffle (Fisher and Yates)
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            j = i + int((state >> np.uint64(33)) % np.uint64(size - i))
            indices[i], indices[j] = indices[j], indices[i]
            valid[k, i] = True
        for i in range(count):
            row = own[indices[i % kept]]
            for axis in range(3):
                out[k, i, axis] = row[axis] - centres[k, axis]
            out[k, i, 3] = row[3]
    return out, valid, low_high, centres
