"""Compiled kernels of the sparse network, which process selected cells of a map.

A map of H x W cells is an index (H + 2, W + 2) int32 into rows (R, C) float32. The border of the
index, the padding of convolutions, refers to a row of zeros. Many cells can share a row.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.detectors.matrix_kernel import BLOCK, ROWS, multiply, multiply_tile

BATCH = 32  # number of tiles per address table
POINTS = 192  # number of points per call of multiply()


@njit(cache=True, nogil=True)
def convolve(index, rows, cells, width, stride, weights, bias, sums, floor, first, last):
    """Write a convolution of a map plus bias to sums; if the bias is empty, add it to the sums.

    Args:
        index, rows: the map.
        cells: (K,) flat indices of the output cells, in a map that is `width` cells wide and
            `stride` times coarser.
        weights: (blocks, taps, channels, BLOCK) float32, 9 taps for a 3 x 3 or 1 for a 1 x 1
            convolution.
        bias: (C,) float32 with C = blocks x BLOCK, or empty.
        sums: (K, C) float32, the output.
        floor: lower limit of the sums.
        first, last: range of `cells` to compute.
    """
    blocks, taps, channels, _ = weights.shape
    row_bytes, sum_bytes = 4 * rows.shape[1], 4 * sums.shape[1]
    inputs, outputs, weight = rows.ctypes.data, sums.ctypes.data, weights.ctypes.data
    accumulate, start = len(bias) == 0, bias.ctypes.data
    map_width = index.shape[1]
    flat_index = index.ravel()
    addresses = np.empty((BATCH, taps, ROWS), np.int64)
    destinations = np.empty((BATCH, ROWS), np.int64)
    starts = np.empty(ROWS, np.int64)
    for begin in range(first, last, BATCH * ROWS):
        tiles = min(BATCH, (last - begin + ROWS - 1) // ROWS)
        for tile in range(tiles):
            for i in range(ROWS):
                cell = min(begin + tile * ROWS + i, last - 1)  # the last cell is repeated
                row, column = divmod(np.int64(cells[cell]), width)
                corner = row * stride * map_width + column * stride
                if taps == 1:
                    addresses[tile, 0, i] = inputs + row_bytes * flat_index[corner + map_width + 1]
                else:
                    for tap in range(9):
                        source_row = flat_index[corner + tap // 3 * map_width + tap % 3]
                        addresses[tile, tap, i] = inputs + row_bytes * source_row
                destinations[tile, i] = outputs + sum_bytes * cell
        for block in range(blocks):
            starts[:] = start + 4 * BLOCK * block
            for tile in range(tiles):
                multiply_tile(
                    addresses.ctypes.data + 8 * tile * taps * ROWS,
                    taps,
                    channels,
                    weight + 4 * block * taps * channels * BLOCK,
                    destinations[tile].ctypes.data if accumulate else starts.ctypes.data,
                    destinations[tile].ctypes.data,
                    floor,
                )
            for tile in range(tiles):
                for i in range(ROWS):
                    destinations[tile, i] += 4 * BLOCK


@njit(cache=True, nogil=True)
def upsample(index, rows, cells, width, scale, bias, sums, first, last):
    """Write a bilinearly upsampled map plus bias to sums, like torch with align_corners=False.

    Args:
        index, rows: the map.
        cells: (K,) flat indices of cells in the upsampled map, which is `width` cells wide.
        bias: (C,) float32.
        sums: (K, C) float32, the output.
        first, last: range of `cells` to compute.
    """
    height, map_width = index.shape[0] - 2, index.shape[1] - 2
    for i in range(first, last):
        row, column = divmod(np.int64(cells[i]), width)
        y = max((row + np.float32(0.5)) / scale - np.float32(0.5), np.float32(0))
        x = max((column + np.float32(0.5)) / scale - np.float32(0.5), np.float32(0))
        top, left = int(y), int(x)
        down, right = min(top + 1, height - 1), min(left + 1, map_width - 1)
        y, x = np.float32(y - top), np.float32(x - left)
        a, b = index[top + 1, left + 1], index[top + 1, right + 1]
        c, d = index[down + 1, left + 1], index[down + 1, right + 1]
        for k in range(sums.shape[1]):
            upper = rows[a, k] + x * (rows[b, k] - rows[a, k])
            lower = rows[c, k] + x * (rows[d, k] - rows[c, k])
            sums[i, k] = bias[k] + (upper + y * (lower - upper))


@njit(cache=True, nogil=True)
def number_cells(mask, template, start):
    """Assign the rows start, start + 1, ... to the cells in mask (H, W).

    Returns:
        Flat indices (K,) int32 of these cells, and a copy of the index `template` (H + 2, W + 2)
        int32 with these rows.
    """
    height, width = mask.shape
    cells, index = np.empty(height * width, np.int32), template.copy()
    count = 0
    for row in range(height):
        for column in range(width):
            if mask[row, column]:
                cells[count] = row * width + column
                index[row + 1, column + 1] = start + count
                count += 1
    return cells[:count].copy(), index


@njit(cache=True, nogil=True)
def write_pillar_maxima(points, offsets, cells, index, weights, bias, rows):
    """Apply a linear layer with ReLU to each point and write the maximum per pillar to rows.

    Args:
        points, offsets: (N, P) and (N, O) float32, concatenated as the input of the layer.
        cells: (N,) int64 cell of each point.
        index, rows: the map; rows (R, C) must initially be 0.
        weights, bias: as in multiply().
    """
    width, point_width = index.shape[1] - 2, points.shape[1]
    inputs = np.zeros((POINTS, weights.shape[2]), np.float32)
    for first in range(0, len(points), POINTS):
        count = min(POINTS, len(points) - first)
        for i in range(count):
            for k in range(point_width):
                inputs[i, k] = points[first + i, k]
            for k in range(offsets.shape[1]):
                inputs[i, point_width + k] = offsets[first + i, k]
        values = multiply(inputs[:count], weights, bias, np.float32(0))
        for i in range(count):
            cell = cells[first + i]
            row = index[1 + cell // width, 1 + cell % width]
            for k in range(rows.shape[1]):
                value, current = values[i, k], rows[row, k]
                rows[row, k] = value if value > current or value != value else current  # propagates NaN
