"""Compiled kernels of PointNet: grouping of points, and maxima over groups.

The rows of several clusters or groups are concatenated. Cluster k has the rows first[k] to
first[k + 1], where first is (K + 1,) int64.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.detectors.matrix_kernel import UNROLL


@njit(cache=True, nogil=True)
def compute_group_maxima(rows, first, columns):
    """Compute the maximum of each group of rows in each of the first `columns` columns.

    Returns:
        (K, columns) float32, NaN if a value is NaN or the group is empty.
    """
    maxima = np.full((len(first) - 1, columns), np.nan, np.float32)
    for k in range(len(maxima)):
        if first[k] < first[k + 1]:
            maxima[k] = rows[first[k], :columns]
        for i in range(first[k] + 1, first[k + 1]):
            for j in range(columns):
                value, current = rows[i, j], maxima[k, j]
                maxima[k, j] = value if value > current or value != value else current
    return maxima


@njit(cache=True, nogil=True)
def _find_nearest(points, begin, end, centre, count, distances, indices):
    """Find up to `count` points among begin to end that are nearest to the point `centre`.

    Writes their squared distances, in ascending order, and their indices. Returns their number.
    """
    neighbour_count = 0
    for i in range(begin, end):
        x = points[centre, 0] - points[i, 0]
        y = points[centre, 1] - points[i, 1]
        z = points[centre, 2] - points[i, 2]
        squared = x * x + y * y + z * z
        if neighbour_count == count and not squared < distances[neighbour_count - 1]:
            continue
        slot = min(neighbour_count, count - 1)
        while slot > 0 and squared < distances[slot - 1]:
            distances[slot], indices[slot] = distances[slot - 1], indices[slot - 1]
            slot -= 1
        distances[slot], indices[slot] = squared, i
        neighbour_count = min(neighbour_count + 1, count)
    return neighbour_count


@njit(cache=True, nogil=True)
def _count_within(points, begin, end, centre, squared_radius):
    """Count the points among begin to end that are within a radius of the point `centre`."""
    count = 0
    for i in range(begin, end):
        x = points[centre, 0] - points[i, 0]
        y = points[centre, 1] - points[i, 1]
        z = points[centre, 2] - points[i, 2]
        count += x * x + y * y + z * z <= squared_radius
    return count


@njit(cache=True, nogil=True)
def group_neighbours(points, first, max_centres, radii, counts, use_ball_density):
    """Group points (P, 5 or more) around the first `max_centres` points of each cluster, at S scales.

    Args:
        radii: (S,) float32 radius of the groups, in ascending order.
        counts: (S,) int64 maximum size of the groups. A group contains the nearest points.
        use_ball_density: True to compute the density from all points within the radius.

    Returns:
        relative: (S, R, 8) float32 members of the groups: x y z relative to the centre, in units
            of the radius, and two more columns of `points`, padded with zeros.
        starts: (S, C + 1) int64 first row in `relative` of each group.
        density: (C, S) float32 size of a group divided by counts x radius, or number of points in
            the ball divided by radius cubed.
        first_centre: (K + 1,) int64 first centre of each cluster.
    """
    clusters, scales = len(first) - 1, len(radii)
    first_centre = np.zeros(clusters + 1, np.int64)
    for k in range(clusters):
        first_centre[k + 1] = first_centre[k] + min(max_centres, first[k + 1] - first[k])
    centres = first_centre[clusters]
    relative = np.zeros((scales, centres * counts.max(), 2 * UNROLL), np.float32)
    starts = np.zeros((scales, centres + 1), np.int64)
    density = np.empty((centres, scales), np.float32)
    distances, indices = np.empty(counts.max(), np.float32), np.empty(counts.max(), np.int64)
    for k in range(clusters):
        for c in range(first_centre[k], first_centre[k + 1]):
            centre = first[k] + c - first_centre[k]
            neighbour_count = _find_nearest(points, first[k], first[k + 1], centre, counts.max(), distances, indices)
            for s in range(scales):
                row, radius = starts[s, c], radii[s]
                for i in range(min(neighbour_count, counts[s])):
                    if distances[i] <= radius * radius:
                        neighbour = points[indices[i]]
                        for axis in range(3):
                            relative[s, row, axis] = (neighbour[axis] - points[centre, axis]) / radius
                        relative[s, row, 3], relative[s, row, 4] = neighbour[3], neighbour[4]
                        row += 1
                if use_ball_density:
                    points_in_ball = _count_within(points, first[k], first[k + 1], centre, radius * radius)
                    density[c, s] = points_in_ball / (radius * radius * radius)
                else:
                    density[c, s] = (row - starts[s, c]) / (counts[s] * radius)
                starts[s, c + 1] = row
    return relative, starts, density, first_centre


@njit(cache=True, nogil=True)
def compute_coarse_maxima(points, first, rows, first_row, max_groups, count, radius, weights):
    """Compute the maximum of a linear layer with ReLU over the coarse groups of each cluster, (K, C) float32.

    The centres of a cluster are its first points. A group consists of up to `count` centres within
    `radius` of one of the first `max_groups` centres.

    Args:
        rows: (R, C) float32, output of the layer for the features of the centres.
        first_row: (K + 1,) first row in `rows` of each cluster.
        weights: (3, C) float32, weights of the layer for the relative position.
    """
    maxima = np.zeros((len(first) - 1, rows.shape[1]), np.float32)
    distances, indices = np.empty(count, np.float32), np.empty(count, np.int64)
    for k in range(len(maxima)):
        size = first_row[k + 1] - first_row[k]
        if size == 0:
            maxima[k] = np.nan
        for centre in range(first[k], first[k] + min(max_groups, size)):
            neighbour_count = _find_nearest(points, first[k], first[k] + size, centre, count, distances, indices)
            for i in range(neighbour_count):
                if distances[i] > radius * radius:
                    break
                row = rows[first_row[k] + indices[i] - first[k]]
                x = (points[indices[i], 0] - points[centre, 0]) / radius
                y = (points[indices[i], 1] - points[centre, 1]) / radius
                z = (points[indices[i], 2] - points[centre, 2]) / radius
                for j in range(rows.shape[1]):
                    value = row[j] + x * weights[0, j] + y * weights[1, j] + z * weights[2, j]
                    if value > maxima[k, j] or value != value:
                        maxima[k, j] = value
    return maxima
