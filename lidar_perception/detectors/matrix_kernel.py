"""Matrix products of rows at arbitrary addresses, with the vector instructions of this processor.

The kernel is written in LLVM IR, because on gathered rows it is faster than NumPy's dot and than
loops compiled by Numba. LANES is 0 if there is no kernel for this processor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, njit, types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.extending import intrinsic


def _vector_width() -> int:
    """Return the number of float32 in a vector register of this processor; 0 if Numba does not
    compile, or if the kernel has not been tested on this kind of processor."""
    triple, _, features = cpu_target.target_context.codegen().magic_tuple()
    enabled = features.split(",")
    disabled = config.DISABLE_JIT  # type: ignore[attr-defined]  # numba sets it at run time
    if disabled or not triple.startswith("x86_64") or "+fma" not in enabled:
        return 0
    return 16 if "+avx512f" in enabled else 8 if "+avx2" in enabled else 0


LANES = _vector_width()
BLOCK = 2 * LANES  # columns of a tile: two vectors
ROWS = 12 if LANES == 16 else 6  # rows of a tile, limited by the registers for its sums
UNROLL = 4  # channels per iteration of the inner loop


@intrinsic
def multiply_tile(typingctx, inputs, taps, channels, weights, starts, outputs, floor):
    """Write a tile of ROWS x BLOCK sums: start values plus products of inputs and weights.

    All arguments except taps, channels and floor are addresses.

    Args:
        inputs: (taps, ROWS) addresses of rows of float32.
        channels: Number of values per row, a multiple of UNROLL.
        weights: (taps, channels, BLOCK) float32.
        starts, outputs: (ROWS,) addresses of BLOCK float32 each, which may be the same.
        floor: Sums below it become floor; NaN stays NaN.
    """
    signature = types.void(*[types.int64] * 6, types.float32)
    return signature, _emit_tile


def _emit_tile(context: Any, builder: ir.IRBuilder, signature: Any, args: Sequence[ir.Value]) -> Any:
    """Emit multiply_tile. Its sums remain in registers over all taps and channels."""
    inputs, taps, channels, weights, starts, outputs, floor = args
    i64, f32 = ir.IntType(64), ir.FloatType()
    vector = ir.VectorType(f32, LANES)
    fma = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fma.v{LANES}f32")

    def number(value: int) -> ir.Value:
        return ir.Constant(i64, value)

    def at(address: ir.Value, offset: ir.Value | int) -> ir.Value:
        return builder.add(address, offset if isinstance(offset, ir.Value) else number(offset))

    def load(kind: ir.Type, address: ir.Value) -> ir.Value:
        return builder.load(builder.inttoptr(address, kind.as_pointer()), align=4)

    def splat(value: ir.Value) -> ir.Value:
        first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(
            first, ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        )

    def loop(
        count: ir.Value, step: int, starts: list[ir.Value], body: Callable[[ir.Value, list[ir.Value]], list[ir.Value]]
    ) -> list[ir.Value]:
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

    sums = [load(vector, at(load(i64, at(starts, 8 * i)), 4 * LANES * half)) for i in range(ROWS) for half in range(2)]

    def tap(number_of_tap: ir.Value, values: list[ir.Value]) -> list[ir.Value]:
        table = at(inputs, builder.mul(number_of_tap, number(8 * ROWS)))
        rows = [load(i64, at(table, 8 * i)) for i in range(ROWS)]

        def channel(first: ir.Value, state: list[ir.Value]) -> list[ir.Value]:
            weight, values = state[0], list(state[1:])
            offset = builder.mul(first, number(4))
            for i in range(UNROLL):
                halves = [load(vector, at(weight, 4 * LANES * (2 * i + half))) for half in range(2)]
                for row in range(ROWS):
                    value = splat(load(f32, at(at(rows[row], offset), 4 * i)))
                    for half in range(2):
                        k = 2 * row + half
                        values[k] = builder.call(fma, [value, halves[half], values[k]])
            return [at(weight, 4 * BLOCK * UNROLL), *values]

        return loop(channels, UNROLL, values, channel)

    sums = loop(taps, 1, [weights, *sums], tap)[1:]
    limit = splat(floor)
    for i in range(ROWS):
        place = load(i64, at(outputs, 8 * i))
        for half in range(2):
            value = sums[2 * i + half]
            value = builder.select(builder.fcmp_ordered("<", value, limit), limit, value)
            builder.store(value, builder.inttoptr(at(place, 4 * LANES * half), vector.as_pointer()), align=4)
    return context.get_dummy_value()


@njit(cache=True, nogil=True)
def multiply(rows, weights, bias, floor):
    """Return rows (R, B) times weights plus bias, (R, C) float32, limited below by `floor`.

    Args:
        weights: (blocks, 1, channels, BLOCK) float32 from pack_weights. B is at least `channels`,
            and C is blocks x BLOCK.
        bias: (C,) float32.
    """
    blocks, _, channels, _ = weights.shape
    sums = np.empty((len(rows), blocks * BLOCK), np.float32)
    inputs, starts, outputs = np.empty(ROWS, np.int64), np.empty(ROWS, np.int64), np.empty(ROWS, np.int64)
    for block in range(blocks):
        starts[:] = bias.ctypes.data + 4 * BLOCK * block
        for first in range(0, len(rows), ROWS):
            for i in range(ROWS):
                row = min(first + i, len(rows) - 1)  # the last row is repeated
                inputs[i] = rows.ctypes.data + 4 * row * rows.shape[1]
                outputs[i] = sums.ctypes.data + 4 * (row * sums.shape[1] + BLOCK * block)
            multiply_tile(
                inputs.ctypes.data,
                1,
                channels,
                weights.ctypes.data + 4 * block * channels * BLOCK,
                starts.ctypes.data,
                outputs.ctypes.data,
                floor,
            )
    return sums


def pack_weights(weights: np.ndarray) -> np.ndarray:
    """Return weights (O, I, taps) in the memory order of tiles, padded with zeros:
    (blocks, taps, channels, BLOCK) float32."""
    out, channels, taps = weights.shape
    blocks = -(-out // BLOCK)
    filled = np.zeros((blocks * BLOCK, pad_channels(channels), taps), np.float32)
    filled[:out, :channels] = weights
    return np.ascontiguousarray(filled.reshape(blocks, BLOCK, -1, taps).transpose(0, 3, 2, 1))


def pad_channels(channels: int) -> int:
    """Return `channels` rounded up to a multiple of UNROLL."""
    return -(-channels // UNROLL) * UNROLL


def pad_bias(bias: np.ndarray | None, width: int) -> np.ndarray:
    """Return a bias (O,) or None as (width,) float32, padded with zeros."""
    filled = np.zeros(width, np.float32)
    if bias is not None:
        filled[: len(bias)] = bias
    return filled
