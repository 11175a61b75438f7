"""Clustering on a range image, the peer of paper C's fast channel clustering (FCC).

It follows Bogoslavskyi and Stachniss, "Fast Range Image-Based Segmentation of Sparse 3D Laser
Scans for Online Operation" (IROS 2016): neighbouring pixels belong to one object where the line
between them is steep enough as seen from the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

STEPS = ((0, 1), (0, 2), (1, 0), (2, 0))  # (row, column) offsets of neighbours; an offset of 2 bridges a lost return


@dataclass(frozen=True)
class RangeImageParams:
    """Parameters of the clustering on a range image.

    Attributes:
        column, row: Width and height of a pixel, degrees. Rows without a point are left out, so
            that a sensor with fewer beams has neighbouring rows.
        min_angle: Pixels are linked if the line between them makes at least this angle with the
            longer beam, degrees.
        min_size: Smaller clusters are dropped.
    """

    column: float = 0.2
    row: float = 0.4
    min_angle: float = 10.0
    min_size: int = 10


def cluster_range_image(xyz: np.ndarray, params: RangeImageParams = RangeImageParams()) -> np.ndarray:
    """Cluster points (N, 3) float32, metres from the sensor, without ground, as (N,) int32 ids.

    0 is no cluster, 1..K are clusters. The points of a pixel are in the cluster of the nearest one.
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
    filled, first = np.unique(pixel[order], return_index=True)
    nearest = order[first]
    image = np.full((row.max() + 1, columns), -1)
    image.ravel()[filled] = np.arange(len(filled))
    pairs = [
        _link(image, xyz[nearest].astype(np.float64), ranges[nearest], down, right, np.radians(params.min_angle))
        for down, right in STEPS
    ]
    a, b = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), (len(filled), len(filled)))
    component = connected_components(graph, directed=False)[1]
    label = np.empty(len(xyz), int)
    label[order] = component[np.searchsorted(filled, pixel[order])]
    kept = np.bincount(label) >= params.min_size
    return np.where(kept, np.cumsum(kept), 0)[label].astype(np.int32)


def _link(
    image: np.ndarray, xyz: np.ndarray, ranges: np.ndarray, down: int, right: int, min_angle: float
) -> np.ndarray:
    """Return pairs (2, E) of linked pixels, `down` rows and `right` columns apart."""
    a, b = image[: len(image) - down], np.roll(image, -right, axis=1)[down:]
    both = (a >= 0) & (b >= 0)
    a, b = a[both], b[both]
    far, near = np.maximum(ranges[a], ranges[b]), np.minimum(ranges[a], ranges[b])
    cosine = np.clip((xyz[a] * xyz[b]).sum(axis=1) / (far * near), -1, 1)
    angle = np.arctan2(near * np.sqrt(1 - cosine**2), far - near * cosine)
    return np.stack([a, b])[:, angle >= min_angle]
