"""Clusters of a cloud, and what the network reads of them.

Every cluster is seen from the same side: moved to its mean, and turned about the sensor until it
lies straight ahead, so that no heading of the cloud matters and the network learns from where a
thing is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from lidar_perception.detection.config import SENSOR_HEIGHT
from lidar_perception.types import LidarFrame


@dataclass(frozen=True)
class Clusters:
    """K clusters, K may be 0: points (P, 4) float32 [x y z intensity], those of cluster i from
    first[i] to first[i + 1], first (K + 1,) int64; metres, from a level sensor at SENSOR_HEIGHT.
    ids (K,) int64: the numbers that they had."""

    points: np.ndarray
    first: np.ndarray
    ids: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def sizes(self) -> np.ndarray:
        """(K,) points of each."""
        return np.diff(self.first)

    def take(self, chosen: np.ndarray) -> Clusters:
        """The clusters at places (M,)."""
        sizes = self.sizes[chosen]
        first = np.concatenate([[0], np.cumsum(sizes)])
        rows = np.repeat(self.first[chosen] - first[:-1], sizes) + np.arange(first[-1])
        return Clusters(self.points[rows], first, self.ids[chosen])


@dataclass(frozen=True)
class ClusterInput:
    """What the network reads of K clusters, N = config.points each.

    points (K, N, 5) float32: x y z from the mean, turned, metres; intensity; height over the
    ground under the sensor, metres. valid (K, N) bool: False for repeated ones. context (K, 6)
    float32: range, height of the mean, of the lowest and of the highest point, numbers of points,
    and log of the range, all about 0 .. 2. centres (K, 3) float64: the means; azimuths (K,) float64
    of them.
    """

    points: np.ndarray
    valid: np.ndarray
    context: np.ndarray
    centres: np.ndarray
    azimuths: np.ndarray


def clusters_of(frame: LidarFrame, cluster_ids: np.ndarray, least_points: int = 1) -> Clusters:
    """The clusters of a frame of N points, with numbers (N,) int, 0 and below for none, that have
    enough points, by their numbers. Without an intensity it is 0."""
    ids = np.asarray(cluster_ids)
    order = np.argsort(ids, kind="stable")
    order = order[np.searchsorted(ids[order], 1):]
    known, sizes = np.unique(ids[order], return_counts=True)
    kept = sizes >= least_points
    order = order[np.repeat(kept, sizes)]
    points = np.zeros((len(order), 4), np.float32)
    points[:, :3] = frame.xyz[order]
    if frame.intensity is not None:
        points[:, 3] = frame.intensity[order]
    return Clusters(points, np.concatenate([[0], np.cumsum(sizes[kept])]).astype(np.int64),
                    known[kept].astype(np.int64))


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
    inputs[..., 4] = points[..., 2] + (centres[:, 2:] + SENSOR_HEIGHT).astype(np.float32)
    context = np.column_stack([reach / 50, centres[:, 2] + SENSOR_HEIGHT,
                               low_high + SENSOR_HEIGHT, np.log(np.maximum(clusters.sizes, 1)) / 5,
                               np.log(reach) / 4])
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
        places = np.arange(size)
        state = np.uint64(seed * 0x9E3779B97F4A7C15 + 0x632BE59BD9B4E019)
        kept = min(size, count)
        for i in range(kept):  # the beginning of a shuffle (Fisher and Yates)
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            j = i + int((state >> np.uint64(33)) % np.uint64(size - i))
            places[i], places[j] = places[j], places[i]
            valid[k, i] = True
        for i in range(count):
            row = own[places[i % kept]]
            for axis in range(3):
                out[k, i, axis] = row[axis] - centres[k, axis]
            out[k, i, 3] = row[3]
    return out, valid, low_high, centres
