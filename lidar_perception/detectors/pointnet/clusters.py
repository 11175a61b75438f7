"""Clusters of a cloud, and the network inputs made from them.

Clusters are normalized: shifted to their mean, and rotated about the sensor until they are straight
ahead. The input therefore does not depend on the azimuth of a cluster, but still shows from which
side the sensor sees the object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from lidar_perception.geometry import counting_sort, points_in_boxes
from lidar_perception.groups import group_by_id
from lidar_perception.types import SENSOR_HEIGHT, PointCloud

POINT, CONTEXT = 5, 6  # number of input features of a point, and of a cluster
RADII_M = (3.0, 6.0, 12.0)  # radii of the search for ground points around a cluster, tried in this order
MIN_GROUND_POINTS = 3
CELLS = 64  # cells per axis of the hash grid, each RADII_M[0] wide; distant positions share a cell


@dataclass(frozen=True)
class Clusters:
    """K clusters in a NormalizedView; K may be 0.

    Attributes:
        points: (P, 4) float32 [x y z intensity], metres.
        first: (K + 1,) int64; cluster i has the points first[i] to first[i + 1].
        ids: (K,) int64 ids in the cloud.
        ground: (K,) float64 z of the ground below each cluster; None: flat ground at
            -SENSOR_HEIGHT.
    """

    points: np.ndarray
    first: np.ndarray
    ids: np.ndarray
    ground: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def sizes(self) -> np.ndarray:
        """Number of points of each cluster, (K,)."""
        return np.diff(self.first)

    def take(self, indices: np.ndarray) -> Clusters:
        """Return the clusters at indices (M,)."""
        sizes = self.sizes[indices]
        first = np.concatenate([[0], np.cumsum(sizes)])
        rows = np.repeat(self.first[indices] - first[:-1], sizes) + np.arange(first[-1])
        return Clusters(
            self.points[rows], first, self.ids[indices], None if self.ground is None else self.ground[indices]
        )

    def take_nearest(self, count: int) -> Clusters:
        """Return the `count` clusters whose means are nearest to the sensor, in their original order."""
        if len(self) <= count:
            return self
        distances = np.hypot(*compute_centroids(self.points, self.first).T)
        return self.take(np.sort(np.argsort(distances, kind="stable")[:count]))

    def with_ground(self, ground: np.ndarray) -> Clusters:
        """Return these clusters, which must not be empty, with ground heights from points (G, 3)."""
        return replace(self, ground=find_ground_heights(ground, compute_centroids(self.points, self.first)))

    @property
    def floor(self) -> np.ndarray:
        """z of the ground below each cluster, (K,) float64."""
        return np.full(len(self), -SENSOR_HEIGHT) if self.ground is None else self.ground


@dataclass(frozen=True)
class ClusterInput:
    """Network input for K clusters with N = config.points points each.

    Attributes:
        points: (K, N, 5) float32: normalized x y z in metres, intensity, and height above the
            ground in metres.
        valid: (K, N) bool, False for repeated points.
        context: (K, 6) float32: range; heights of the mean, the lowest and the highest point; log
            of the number of points; and log of the range; all scaled to about 0..2.
        centres: (K, 3) float64 means.
        azimuths: (K,) float64 azimuths of the means, radians.
    """

    points: np.ndarray
    valid: np.ndarray
    context: np.ndarray
    centres: np.ndarray
    azimuths: np.ndarray


def make_clusters(
    frame: PointCloud, cluster_ids: np.ndarray, min_points: int = 1, ground: np.ndarray | None = None
) -> Clusters:
    """Return the clusters of a frame of N points, in the order of their ids.

    Args:
        cluster_ids: (N,) int, 0 or less for no cluster.
        min_points: minimum number of points; smaller clusters are dropped.
        ground: (N,) bool mask of the ground points, which define the ground heights; None: flat
            ground.
    """
    groups = group_by_id(np.asarray(cluster_ids), min_points)
    points = np.zeros((len(groups.rows), 4), np.float32)
    points[:, :3] = frame.xyz[groups.rows]
    if frame.intensity is not None:
        points[:, 3] = frame.intensity[groups.rows]
    clusters = Clusters(points, groups.start, groups.numbers)
    if ground is None:
        return clusters
    return clusters.with_ground(frame.xyz.compress(ground, axis=0))


def crop_boxes(boxes: np.ndarray, frame: PointCloud, margin: float) -> Clusters:
    """Return the points in boxes (K, 7), which are enlarged by `margin` metres, as clusters.

    A point can belong to several clusters, and clusters can be empty.
    """
    indices, first = points_in_boxes(frame.xyz, boxes, margin)
    points = np.zeros((len(indices), 4), np.float32)
    points[:, :3] = frame.xyz[indices]
    if frame.intensity is not None:
        points[:, 3] = frame.intensity[indices]
    return Clusters(points, first, np.arange(1, len(boxes) + 1))


def find_ground_heights(xyz: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return the mean z (K,) float64 of the ground points around each position.

    The smallest of RADII_M with at least MIN_GROUND_POINTS points is used. If there is none, the
    height is -SENSOR_HEIGHT.

    Args:
        xyz: (G, 3) ground points, metres.
        xy: (K, 2) positions, metres.
    """
    return _find_ground_heights(xyz, np.ascontiguousarray(xy, np.float64))


@njit(cache=True, nogil=True)
def _find_ground_heights(xyz, xy):
    cell_ids = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        cell_ids[i] = _hash_axis(xyz[i, 0], 0) * CELLS + _hash_axis(xyz[i, 1], 0)
    order, start = counting_sort(cell_ids, CELLS * CELLS, np.arange(len(xyz)))
    heights = np.full(len(xy), -SENSOR_HEIGHT)
    for k in range(len(xy)):
        x, y = xy[k]
        for radius in RADII_M:
            cells = int(np.ceil(radius / RADII_M[0]))
            count, total = 0, 0.0
            for row in range(-cells, cells + 1):
                for column in range(-cells, cells + 1):
                    cell_id = _hash_axis(x, row) * CELLS + _hash_axis(y, column)
                    for j in order[start[cell_id] : start[cell_id + 1]]:
                        if (xyz[j, 0] - x) ** 2 + (xyz[j, 1] - y) ** 2 <= radius * radius:
                            count += 1
                            total += xyz[j, 2]
            if count >= MIN_GROUND_POINTS:
                heights[k] = total / count
                break
    return heights


@njit(cache=True, nogil=True)
def _hash_axis(coordinate, offset):
    return int((np.floor(coordinate / RADII_M[0]) + offset) % CELLS)


def compute_centroids(points: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the means (K, 2) of x and y of each cluster; clusters must not be empty."""
    if len(first) == 1:
        return np.zeros((0, 2))
    sums = np.add.reduceat(points[:, :2].astype(np.float64), first[:-1], axis=0)
    return sums / np.diff(first)[:, None]


def make_network_input(clusters: Clusters, count: int, seed: int = 0, farthest_count: int = 0) -> ClusterInput:
    """Make the network input from at most `count` random points of each cluster (Eq. 13).

    The sample of a cluster depends only on `seed` and its own points, not on other clusters. Its
    first `farthest_count` points are ordered by farthest point sampling (Eq. 15 and 17): each is
    the farthest from those before it.
    """
    points, valid, z_limits, centres = _sample_points(clusters.points, clusters.first, count, seed, farthest_count)
    azimuths = np.arctan2(centres[:, 1], centres[:, 0])
    ranges = np.maximum(np.hypot(centres[:, 0], centres[:, 1]), 1e-3)
    inputs = np.empty((*points.shape[:2], 5), np.float32)
    cos, sin = (f(azimuths)[:, None].astype(np.float32) for f in (np.cos, np.sin))
    x, y = points[..., 0], points[..., 1]
    inputs[..., 0], inputs[..., 1] = cos * x + sin * y, cos * y - sin * x
    inputs[..., 2:4] = points[..., 2:]
    floor = clusters.floor
    inputs[..., 4] = points[..., 2] + (centres[:, 2] - floor)[:, None].astype(np.float32)
    context = np.column_stack(
        [
            ranges / 50,
            centres[:, 2] - floor,
            z_limits - floor[:, None],
            np.log(np.maximum(clusters.sizes, 1)) / 5,
            np.log(ranges) / 4,
        ]
    )
    return ClusterInput(inputs, valid, context.astype(np.float32), centres, azimuths)


@njit(cache=True, nogil=True)
def _sample_points(points, first, count, seed, farthest_count):
    cluster_count = len(first) - 1
    samples = np.zeros((cluster_count, count, 4), np.float32)
    valid = np.zeros((cluster_count, count), np.bool_)
    z_limits, centres = np.zeros((cluster_count, 2)), np.zeros((cluster_count, 3))
    for k in range(cluster_count):
        begin, size = first[k], first[k + 1] - first[k]
        if size == 0:
            continue
        cluster_points = points[begin : begin + size]
        low, high = np.inf, -np.inf
        for i in range(size):
            for axis in range(3):
                centres[k, axis] += cluster_points[i, axis]
            low, high = min(low, cluster_points[i, 2]), max(high, cluster_points[i, 2])
        centres[k] /= size
        z_limits[k, 0], z_limits[k, 1] = low, high
        indices = np.arange(size)
        state = np.uint64(seed * 0x9E3779B97F4A7C15 + 0x632BE59BD9B4E019)
        sample_size = min(size, count)
        for i in range(sample_size):  # the first steps of a Fisher-Yates shuffle
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            j = i + int((state >> np.uint64(33)) % np.uint64(size - i))
            indices[i], indices[j] = indices[j], indices[i]
            valid[k, i] = True
        if farthest_count > 0:
            _order_by_distance(cluster_points, indices[:sample_size], min(farthest_count, sample_size))
        for i in range(count):
            row = cluster_points[indices[i % sample_size]]
            for axis in range(3):
                samples[k, i, axis] = row[axis] - centres[k, axis]
            samples[k, i, 3] = row[3]
    return samples, valid, z_limits, centres


@njit(cache=True, nogil=True)
def _order_by_distance(points, indices, count):
    """Reorder indices in place so that each of the first `count` points is the farthest from those before it."""
    min_distances = np.full(len(indices), np.inf)  # squared distances to the nearest point before
    for position in range(1, count):
        last, farthest = points[indices[position - 1]], position
        for i in range(position, len(indices)):
            squared = 0.0
            for axis in range(3):
                squared += (np.float64(points[indices[i], axis]) - last[axis]) ** 2
            min_distances[i] = min(min_distances[i], squared)
            if min_distances[i] > min_distances[farthest]:
                farthest = i
        indices[position], indices[farthest] = indices[farthest], indices[position]
        min_distances[position], min_distances[farthest] = min_distances[farthest], min_distances[position]
