"""Matrix products of rows at arbitrary addresses, using the vector instructions of this processor.

The kernel is written in LLVM IR because for gathered rows this is faster than NumPy's dot and than
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


def _find_vector_width() -> int:
    """Return the number of float32 values in a vector register of this processor.

    It is 0 if JIT compilation is disabled or the kernel is untested on this type of processor.
    """
    triple, _, features = cpu_target.target_context.codegen().magic_tuple()
    enabled_features = features.split(",")
    is_jit_disabled = config.DISABLE_JIT  # type: ignore[attr-defined]  # numba sets it at run time
    if is_jit_disabled or not triple.startswith("x86_64") or "+fma" not in enabled_features:
        return 0
    return 16 if "+avx512f" in enabled_features else 8 if "+avx2" in enabled_features else 0


LANES = _find_vector_width()
BLOCK = 2 * LANES  # columns of a tile: two vectors
ROWS = 12 if LANES == 16 else 6  # rows of a tile, limited by the number of registers for the sums
UNROLL = 4  # channels per iteration of the inner loop


@intrinsic
def multiply_tile(typingctx, inputs, taps, channels, weights, starts, outputs, floor):
    """Write a tile of ROWS x BLOCK sums: start values plus products of inputs and weights.

    All arguments except taps, channels and floor are addresses.

    Args:
        inputs: (taps, ROWS) addresses of rows of float32.
        channels: Number of values per row, a multiple of UNROLL.
        weights: (taps, channels, BLOCK) float32.
        starts, outputs: (ROWS,) addresses of BLOCK float32 values each; both may be the same.
        floor: Lower limit of the sums; NaN stays NaN.
    """
    signature = types.void(*[types.int64] * 6, types.float32)
    return signature, _emit_tile


def _emit_tile(context: Any, builder: ir.IRBuilder, signature: Any, args: Sequence[ir.Value]) -> Any:
    """Generate the code of multiply_tile, which keeps the sums in registers over all taps and channels."""
    inputs, taps, channels, weights, starts, outputs, floor = args
    i64, f32 = ir.IntType(64), ir.FloatType()
    vector = ir.VectorType(f32, LANES)
    fma = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fma.v{LANES}f32")

    def make_constant(value: int) -> ir.Value:
        return ir.Constant(i64, value)

    def add_offset(address: ir.Value, offset: ir.Value | int) -> ir.Value:
        return builder.add(address, offset if isinstance(offset, ir.Value) else make_constant(offset))

    def load(value_type: ir.Type, address: ir.Value) -> ir.Value:
        return builder.load(builder.inttoptr(address, value_type.as_pointer()), align=4)

    def broadcast(value: ir.Value) -> ir.Value:
        single = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(
            single, ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        )

    def emit_loop(
        count: ir.Value, step: int, starts: list[ir.Value], body: Callable[[ir.Value, list[ir.Value]], list[ir.Value]]
    ) -> list[ir.Value]:
        """Repeat values = body(counter, values) while counter = 0, step, ... is below count."""
        entry_block, loop_block = builder.block, builder.append_basic_block()
        builder.branch(loop_block)
        builder.position_at_end(loop_block)
        counter = builder.phi(i64)
        values = [builder.phi(start.type) for start in starts]
        results = body(counter, values)
        next_counter = builder.add(counter, make_constant(step))
        counter.add_incoming(make_constant(0), entry_block)
        counter.add_incoming(next_counter, builder.block)
        for value, start, result in zip(values, starts, results):
            value.add_incoming(start, entry_block)
            value.add_incoming(result, builder.block)
        exit_block = builder.append_basic_block()
        builder.cbranch(builder.icmp_signed("<", next_counter, count), loop_block, exit_block)
        builder.position_at_end(exit_block)
        return results

    sums = [
        load(vector, add_offset(load(i64, add_offset(starts, 8 * i)), 4 * LANES * j))
        for i in range(ROWS)
        for j in range(2)
    ]

    def add_tap(tap: ir.Value, values: list[ir.Value]) -> list[ir.Value]:
        address_table = add_offset(inputs, builder.mul(tap, make_constant(8 * ROWS)))
        rows = [load(i64, add_offset(address_table, 8 * i)) for i in range(ROWS)]

        def add_channels(channel: ir.Value, state: list[ir.Value]) -> list[ir.Value]:
            weight, values = state[0], list(state[1:])
            offset = builder.mul(channel, make_constant(4))
            for i in range(UNROLL):
                weight_vectors = [load(vector, add_offset(weight, 4 * LANES * (2 * i + j))) for j in range(2)]
                for row in range(ROWS):
                    value = broadcast(load(f32, add_offset(add_offset(rows[row], offset), 4 * i)))
                    for j in range(2):
                        k = 2 * row + j
                        values[k] = builder.call(fma, [value, weight_vectors[j], values[k]])
            return [add_offset(weight, 4 * BLOCK * UNROLL), *values]

        return emit_loop(channels, UNROLL, values, add_channels)

    sums = emit_loop(taps, 1, [weights, *sums], add_tap)[1:]
    limit = broadcast(floor)
    for i in range(ROWS):
        address = load(i64, add_offset(outputs, 8 * i))
        for j in range(2):
            value = sums[2 * i + j]
            value = builder.select(builder.fcmp_ordered("<", value, limit), limit, value)
            builder.store(value, builder.inttoptr(add_offset(address, 4 * LANES * j), vector.as_pointer()), align=4)
    return context.get_dummy_value()


@njit(cache=True, nogil=True)
def multiply(rows, weights, bias, floor):
    """Compute rows (R, B) times weights plus bias, (R, C) float32.

    Args:
        weights: (blocks, 1, channels, BLOCK) float32 from pack_weights. B is at least `channels`,
            and C is blocks x BLOCK.
        bias: (C,) float32.
        floor: lower limit of the results.
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
    """Reorder weights (O, I, taps) for multiply_tile: (blocks, taps, channels, BLOCK) float32, padded with 0."""
    out, channels, taps = weights.shape
    blocks = -(-out // BLOCK)
    padded_weights = np.zeros((blocks * BLOCK, pad_channels(channels), taps), np.float32)
    padded_weights[:out, :channels] = weights
    return np.ascontiguousarray(padded_weights.reshape(blocks, BLOCK, -1, taps).transpose(0, 3, 2, 1))


def pad_channels(channels: int) -> int:
    """Round a number of channels up to a multiple of UNROLL."""
    return -(-channels // UNROLL) * UNROLL


def pad_bias(bias: np.ndarray | None, width: int) -> np.ndarray:
    """Pad a bias (O,) with zeros to (width,) float32; None is all zeros."""
    padded_bias = np.zeros(width, np.float32)
    if bias is not None:
        padded_bias[: len(bias)] = bias
    return padded_bias
