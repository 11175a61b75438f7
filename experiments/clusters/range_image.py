"""Clustering on a range image, as a substitute for the fast channel clustering (FCC) in paper C.

It follows Bogoslavskyi and Stachniss, "Fast Range Image-Based Segmentation of Sparse 3D Laser
Scans for Online Operation" (IROS 2016): neighbouring pixels belong to the same object if the line
between their points makes a large enough angle with the beam.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

# (row, column) offsets of neighbours. An offset of 2 bridges a missing return.
NEIGHBOUR_OFFSETS = ((0, 1), (0, 2), (1, 0), (2, 0))


@dataclass(frozen=True)
class RangeImageParams:
    """Parameters of the clustering on a range image.

    Attributes:
        column, row: Width and height of a pixel, degrees. Rows without points are removed, so that
            the beams of a sensor with few beams are in neighbouring rows.
        min_angle: Two pixels are linked if the line between their points makes at least this angle
            with the longer beam, degrees.
        min_size: Clusters with fewer points are dropped.
    """

    column: float = 0.2
    row: float = 0.4
    min_angle: float = 10.0
    min_size: int = 10


def cluster_range_image(xyz: np.ndarray, params: RangeImageParams = RangeImageParams()) -> np.ndarray:
    """Cluster the points of obstacles.

    All points in a pixel get the cluster of the nearest one.

    Args:
        xyz: (N, 3) float32 points without ground in the sensor's frame, metres.
        params: Parameters.

    Returns:
        (N,) int32 ids: 0 for points without a cluster, 1 to K for clusters.
    """
    if len(xyz) == 0:
        return np.zeros(0, np.int32)
    x, y, z = xyz.T.astype(np.float64)
    ranges = np.linalg.norm(xyz.astype(np.float64), axis=1)
    columns = round(360 / params.column)
    column = np.floor((np.degrees(np.arctan2(y, x)) + 180) / params.column).astype(int) % columns
    elevation = np.floor(np.degrees(np.arctan2(z, np.hypot(x, y))) / params.row).astype(int)
    row = np.unique(elevation, return_inverse=True)[1].reshape(-1)
    pixel = row * columns + column
    order = np.lexsort((ranges, pixel))
    filled_pixels, first = np.unique(pixel[order], return_index=True)
    nearest = order[first]
    image = np.full((row.max() + 1, columns), -1)
    image.ravel()[filled_pixels] = np.arange(len(filled_pixels))
    pairs = [
        _link_pixels(
            image,
            xyz[nearest].astype(np.float64),
            ranges[nearest],
            row_offset,
            column_offset,
            np.radians(params.min_angle),
        )
        for row_offset, column_offset in NEIGHBOUR_OFFSETS
    ]
    a, b = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), (len(filled_pixels), len(filled_pixels)))
    component = connected_components(graph, directed=False)[1]
    label = np.empty(len(xyz), int)
    label[order] = component[np.searchsorted(filled_pixels, pixel[order])]
    is_cluster = np.bincount(label) >= params.min_size
    return np.where(is_cluster, np.cumsum(is_cluster), 0)[label].astype(np.int32)


def _link_pixels(
    image: np.ndarray, xyz: np.ndarray, ranges: np.ndarray, row_offset: int, column_offset: int, min_angle: float
) -> np.ndarray:
    """Return pairs (2, E) of linked pixels that are `row_offset` rows and `column_offset` columns apart."""
    a, b = image[: len(image) - row_offset], np.roll(image, -column_offset, axis=1)[row_offset:]
    is_pair = (a >= 0) & (b >= 0)
    a, b = a[is_pair], b[is_pair]
    long_ranges, short_ranges = np.maximum(ranges[a], ranges[b]), np.minimum(ranges[a], ranges[b])
    cosine = np.clip((xyz[a] * xyz[b]).sum(axis=1) / (long_ranges * short_ranges), -1, 1)
    angle = np.arctan2(short_ranges * np.sqrt(1 - cosine**2), long_ranges - short_ranges * cosine)
    return np.stack([a, b])[:, angle >= min_angle]
