"""Compiled kernels of the sparse network: convolutions and sums at chosen cells of a map.

A map of H x W cells is an index (H + 2, W + 2) int32 into rows (R, C) float32; the border of the
index points at a row of zeros, which is the padding of a convolution. Many cells can share a row.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.extending import intrinsic


def _vector_width() -> int:
    """Floats in a vector of the processor that Numba compiles for; 0 where it has no fast path."""
    triple, _, features = cpu_target.target_context.codegen().magic_tuple()
    enabled = features.split(",")
    if not triple.startswith("x86_64") or "+fma" not in enabled:
        return 0
    return 16 if "+avx512f" in enabled else 8 if "+avx2" in enabled else 0


LANES = _vector_width()
BLOCK = 2 * LANES            # output channels that are computed together, in two vectors
CELLS = 12 if LANES == 16 else 6
UNROLL = 4                   # input channels in one turn of the inner loop
BATCH = 32                   # tiles whose addresses are looked up at once


@intrinsic
def _multiply_add(typingctx, addresses, taps, channels, weights, outputs, floor):
    """Add the products of one tile to its sums: CELLS cells and BLOCK output channels.

    addresses: of (taps, CELLS) addresses of input rows, channels of which are read, a multiple of
    UNROLL; weights: of (taps, channels, BLOCK) float32; outputs: of (CELLS,) addresses of the sums
    of each cell. Sums below floor become floor; NaN stays NaN.
    """
    signature = types.void(*[types.int64] * 5, types.float32)
    return signature, _emit_tile


def _emit_tile(context: Any, builder: ir.IRBuilder, signature: Any, args: Sequence[ir.Value]
               ) -> Any:
    """LLVM IR of _multiply_add: sums stay in registers over all taps and channels."""
    addresses, taps, channels, weights, outputs, floor = args
    i64, f32 = ir.IntType(64), ir.FloatType()
    vector = ir.VectorType(f32, LANES)
    fma = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fma.v{LANES}f32")

    def number(value: int) -> ir.Value:
        return ir.Constant(i64, value)

    def at(address: ir.Value, offset: ir.Value | int) -> ir.Value:
        return builder.add(address, offset if isinstance(offset, ir.Value) else number(offset))

    def load(kind: ir.Type, address: ir.Value) -> ir.Value:
        return builder.load(builder.inttoptr(address, kind.as_pointer()), align=4)

    def splat(value: ir.Value) -> ir.Value:
        first = builder.insert_element(ir.Constant(vector, ir.Undefined), value,
                                       ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), ir.Constant(
            ir.VectorType(ir.IntType(32), LANES), [0] * LANES))

    def loop(count: ir.Value, step: int, starts: list[ir.Value],
             body: Callable[[ir.Value, list[ir.Value]], list[ir.Value]]) -> list[ir.Value]:
        """Repeat values = body(counter, values) for counter 0, step .. below count."""
        before, head = builder.block, builder.append_basic_block()
        builder.branch(head)
        builder.position_at_end(head)
        counter = builder.phi(i64)
        values = [builder.phi(start.type) for start in starts]
        after = body(counter, values)
        following = builder.add(counter, number(step))
        counter.add_incoming(number(0), before)
        counter.add_incoming(following, builder.block)
        for value, start, new in zip(values, starts, after):
            value.add_incoming(start, before)
            value.add_incoming(new, builder.block)
        end = builder.append_basic_block()
        builder.cbranch(builder.icmp_signed("<", following, count), head, end)
        builder.position_at_end(end)
        return after

    places = [load(i64, at(outputs, 8 * i)) for i in range(CELLS)]
    sums = [load(vector, at(place, 4 * LANES * half)) for place in places for half in range(2)]

    def tap(number_of_tap: ir.Value, values: list[ir.Value]) -> list[ir.Value]:
        table = at(addresses, builder.mul(number_of_tap, number(8 * CELLS)))
        rows = [load(i64, at(table, 8 * i)) for i in range(CELLS)]

        def channel(first: ir.Value, state: list[ir.Value]) -> list[ir.Value]:
            weight, values = state[0], list(state[1:])
            offset = builder.mul(first, number(4))
            for i in range(UNROLL):
                halves = [load(vector, at(weight, 4 * LANES * (2 * i + half))) for half in range(2)]
                for cell in range(CELLS):
                    value = splat(load(f32, at(at(rows[cell], offset), 4 * i)))
                    for half in range(2):
                        k = 2 * cell + half
                        values[k] = builder.call(fma, [value, halves[half], values[k]])
            return [at(weight, 4 * BLOCK * UNROLL), *values]

        return loop(channels, UNROLL, values, channel)

    sums = loop(taps, 1, [weights, *sums], tap)[1:]
    limit = splat(floor)
    for i, place in enumerate(places):
        for half in range(2):
            value = sums[2 * i + half]
            value = builder.select(builder.fcmp_ordered("<", value, limit), limit, value)
            builder.store(value, builder.inttoptr(at(place, 4 * LANES * half),
                                                  vector.as_pointer()), align=4)
    return context.get_dummy_value()


@njit(cache=True, nogil=True)
def convolve(index, rows, cells, width, stride, weights, sums, floor, first, last):
    """Add a convolution of a map to sums (K, C) of the cells first .. last of cells (K,).

    index, rows: of the map. cells: numbers in a map that is `width` wide and `stride` times as
    coarse. weights (blocks, taps, channels, BLOCK) float32: 9 taps of a 3 x 3 or 1 of a 1 x 1
    convolution. C is blocks x BLOCK. Sums below floor become floor.
    """
    blocks, taps, channels, _ = weights.shape
    row_bytes, sum_bytes = 4 * rows.shape[1], 4 * sums.shape[1]
    inputs, outputs, weight = rows.ctypes.data, sums.ctypes.data, weights.ctypes.data
    across = index.shape[1]
    numbers = index.ravel()
    addresses = np.empty((BATCH, taps, CELLS), np.int64)
    places = np.empty((BATCH, CELLS), np.int64)
    for begin in range(first, last, BATCH * CELLS):
        tiles = min(BATCH, (last - begin + CELLS - 1) // CELLS)
        for tile in range(tiles):
            for i in range(CELLS):
                cell = min(begin + tile * CELLS + i, last - 1)  # the last is repeated
                row, column = divmod(np.int64(cells[cell]), width)
                corner = row * stride * across + column * stride
                if taps == 1:
                    addresses[tile, 0, i] = inputs + row_bytes * numbers[corner + across + 1]
                else:
                    for tap in range(9):
                        addresses[tile, tap, i] = inputs + row_bytes * numbers[
                            corner + tap // 3 * across + tap % 3]
                places[tile, i] = outputs + sum_bytes * cell
        for block in range(blocks):
            for tile in range(tiles):
                for i in range(CELLS):
                    places[tile, i] += 0 if block == 0 else 4 * BLOCK
                _multiply_add(addresses.ctypes.data + 8 * tile * taps * CELLS, taps, channels,
                              weight + 4 * block * taps * channels * BLOCK,
                              places.ctypes.data + 8 * tile * CELLS, floor)


@njit(cache=True, nogil=True)
def upsample(index, rows, cells, width, scale, sums, first, last):
    """Add a map, enlarged `scale` times bilinearly, to sums (K, C) of the cells first .. last of
    cells (K,), numbers in the larger map, `width` wide. As torch with align_corners False."""
    height, across = index.shape[0] - 2, index.shape[1] - 2
    for i in range(first, last):
        row, column = divmod(np.int64(cells[i]), width)
        y = max((row + np.float32(0.5)) / scale - np.float32(0.5), np.float32(0))
        x = max((column + np.float32(0.5)) / scale - np.float32(0.5), np.float32(0))
        top, left = int(y), int(x)
        down, right = min(top + 1, height - 1), min(left + 1, across - 1)
        y, x = np.float32(y - top), np.float32(x - left)
        a, b = index[top + 1, left + 1], index[top + 1, right + 1]
        c, d = index[down + 1, left + 1], index[down + 1, right + 1]
        for k in range(sums.shape[1]):
            upper = rows[a, k] + x * (rows[b, k] - rows[a, k])
            lower = rows[c, k] + x * (rows[d, k] - rows[c, k])
            sums[i, k] += upper + y * (lower - upper)


@njit(cache=True, nogil=True)
def number_cells(chosen, template, start):
    """cells (K,) int32 that are chosen (H, W) bool, and the template (H + 2, W + 2) int32 of an
    index in which they have the rows start, start + 1 .."""
    height, width = chosen.shape
    cells, index = np.empty(height * width, np.int32), template.copy()
    count = 0
    for row in range(height):
        for column in range(width):
            if chosen[row, column]:
                cells[count] = row * width + column
                index[row + 1, column + 1] = start + count
                count += 1
    return cells[:count].copy(), index


@njit(cache=True, nogil=True)
def pillar_rows(points, offsets, cells, index, weights, bias, rows):
    """Raise rows (R, C) of each pillar to the largest value of its points: relu of weights
    (P + O, C) times points (N, P) beside offsets (N, O), plus bias (C,); cells (N,) int64."""
    width, read = index.shape[1] - 2, points.shape[1]
    values = np.empty_like(bias)
    for i in range(len(points)):
        values[:] = bias
        for j in range(len(weights)):
            value = points[i, j] if j < read else offsets[i, j - read]
            for k in range(len(values)):
                values[k] += value * weights[j, k]
        row = index[1 + cells[i] // width, 1 + cells[i] % width]
        for k in range(len(values)):
            if not values[k] <= rows[row, k]:  # NaN stays
                rows[row, k] = values[k]
