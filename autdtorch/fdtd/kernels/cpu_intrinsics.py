"""Operations that Numba lacks: on several numbers at a time, and on counters of several threads.

Numba vectorises neither the rows around heterogeneous cells, which are scattered and whose sums keep an
order, nor the short ends of rows with the cells of absorbing layers.
"""

from __future__ import annotations

import ctypes
import os
from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.utils.array_types import Index

_WIDTH = 4  # Cells of a row that are read: three neighbours, and a lane of padding with weight zero
_MIDDLE = 13  # The cell itself among its neighbours, from which it does not differ
# Neighbour read first in each row, and the lane of padding: no read leaves the grid or the weights
_FIRST, _PADDING = (*range(0, 24, 3), 23), (*8 * (3,), 0)
VECTOR = 64
"""Bytes of a vector of `add_products`."""

ALIKE = 16
"""Neighbouring cells with equal weights that are computed at once."""


def row_offsets(shape: tuple[int, ...]) -> Index:
    """Return the flat offsets (9,) from a cell to the first cells read of the nine rows around it."""
    first = np.array(flat_offsets(shape)[::3])
    first[8] -= 1
    return first


def _item(context: Any, builder: Any, signature: Any, arguments: Any, array: int, index: Any) -> Any:
    """Return the pointer to an item of the argument number `array`."""
    kind = signature.args[array]
    items = context.make_array(kind)(context, builder, arguments[array])
    return cgutils.get_item_pointer(context, builder, kind, items, [index], wraparound=False)  # type: ignore[no-untyped-call]


def _sum_of_rows(typing_context: Any, p: Any, cell: Any, offset: Any, weight: Any, at: Any) -> Any:
    """Return the sum of weight[at + j] * (p[neighbour j] - p[cell]) over the 27 neighbours j."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number, long = context.get_data_type(p.dtype), ir.IntType(64)
        row, size = ir.VectorType(number, _WIDTH), context.get_abi_sizeof(number)
        _, at_cell, _, _, first_weight = arguments

        def pointer(array: int, index: Any) -> Any:
            return _item(context, builder, signature, arguments, array, index)

        def load(array: int, index: Any) -> Any:
            return builder.load(builder.bitcast(pointer(array, index), row.as_pointer()), align=size)

        def lane(j: int) -> Any:
            return ir.Constant(ir.IntType(32), j)

        pressure, here = builder.load(pointer(0, at_cell)), ir.Constant(row, None)
        for j in range(_WIDTH):
            here = builder.insert_element(here, pressure, lane(j))
        total = ir.Constant(row, None)
        for r, (first, padding) in enumerate(zip(_FIRST, _PADDING, strict=True)):
            step = builder.load(pointer(2, ir.Constant(long, r)))
            rise = builder.fsub(load(0, builder.add(at_cell, step)), here)
            weights = load(3, builder.add(first_weight, ir.Constant(long, first)))
            weights = builder.insert_element(weights, ir.Constant(number, 0.0), lane(padding))
            total = builder.fadd(total, builder.fmul(weights, rise))
        parts = [builder.extract_element(total, lane(j)) for j in range(_WIDTH)]
        return builder.fadd(builder.fadd(parts[0], parts[2]), builder.fadd(parts[1], parts[3]))

    return p.dtype(p, types.int64, offset, weight, types.int64), generate


def _sums_of_rows(
    typing_context: Any, p: Any, cell: Any, offset: Any, weight: Any, at: Any, out: Any, place: Any
) -> Any:
    """Write the sums of `_sum_of_rows` for `ALIKE` cells from `cell` on with equal weights, bit for bit."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number, long = context.get_data_type(p.dtype), ir.IntType(64)
        cells, size = ir.VectorType(number, ALIKE), context.get_abi_sizeof(number)
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), ALIKE), None)
        _, first_cell, _, _, first_weight, _, first_out = arguments

        def pointer(array: int, index: Any) -> Any:
            return _item(context, builder, signature, arguments, array, index)

        def load(index: Any) -> Any:
            return builder.load(builder.bitcast(pointer(0, index), cells.as_pointer()), align=size)

        def repeated(value: Any) -> Any:
            first = builder.insert_element(ir.Constant(cells, ir.Undefined), value, ir.IntType(32)(0))
            return builder.shuffle_vector(first, first, zeros)

        here, parts = load(first_cell), 4 * [ir.Constant(cells, None)]
        for r, (first, padding) in enumerate(zip(_FIRST, _PADDING, strict=True)):
            start = builder.add(first_cell, builder.load(pointer(2, ir.Constant(long, r))))
            for j in range(_WIDTH):
                if j == padding or first + j == _MIDDLE:
                    continue
                rise = builder.fsub(load(builder.add(start, ir.Constant(long, j))), here)
                share = builder.load(pointer(3, builder.add(first_weight, ir.Constant(long, first + j))))
                parts[j] = builder.fadd(parts[j], builder.fmul(repeated(share), rise))
        total = builder.fadd(builder.fadd(parts[0], parts[2]), builder.fadd(parts[1], parts[3]))
        builder.store(total, builder.bitcast(pointer(5, first_out), cells.as_pointer()), align=size)
        return context.get_dummy_value()

    return types.void(p, types.int64, offset, weight, types.int64, out, types.int64), generate


def _add_four(typing_context: Any, u: Any, at: Any, v: Any, start: Any) -> Any:
    """Add four cells of v from `start` on to those of u from `at` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.get_data_type(u.dtype)
        row, size = ir.VectorType(number, _WIDTH).as_pointer(), context.get_abi_sizeof(number)
        here, there = (
            builder.bitcast(_item(context, builder, signature, arguments, k, arguments[k + 1]), row)
            for k in (0, 2)
        )
        total = builder.fadd(builder.load(here, align=size), builder.load(there, align=size))
        builder.store(total, here, align=size)
        return context.get_dummy_value()

    return types.void(u, types.uint64, v, types.uint64), generate


def _products_added(conjugate: bool) -> Any:
    """Return the operation u + i v += sum over n of (a + i b)[at + n step] (x + i z)[of + n stride].

    Each number is a vector of `VECTOR` bytes that begins at the index. With `conjugate`, b counts as -b.
    Products are added with one rounding where the processor has an instruction for it.
    """

    def add(
        typing_context: Any, u: Any, v: Any, to: Any, a: Any, b: Any, at: Any, step: Any, x: Any, z: Any,
        of: Any, stride: Any, terms: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            number = context.get_data_type(u.dtype)
            size = context.get_abi_sizeof(number)
            lanes = VECTOR // size
            vector = ir.VectorType(number, lanes)
            kind = ir.FunctionType(vector, 3 * [vector])
            fused = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
                builder.module, kind, f"llvm.fmuladd.v{lanes}f{8 * size}"
            )
            _, _, first_out, _, _, first, step, _, _, second, stride, terms = arguments

            def pointer(array: int, index: Any) -> Any:
                item = _item(context, builder, signature, arguments, array, index)
                return builder.bitcast(item, vector.as_pointer())

            def load(array: int, index: Any) -> Any:
                return builder.load(pointer(array, index), align=size)

            zero = ir.Constant(vector, None)
            sums = [cgutils.alloca_once_value(builder, zero) for _ in range(4)]  # type: ignore[no-untyped-call]
            with cgutils.for_range(builder, terms) as loop:
                left = builder.add(first, builder.mul(loop.index, step))
                right = builder.add(second, builder.mul(loop.index, stride))
                pairs = [(load(j, left), load(k, right)) for j in (3, 4) for k in (7, 8)]
                for total, pair in zip(sums, pairs, strict=True):
                    builder.store(builder.call(fused, [*pair, builder.load(total)]), total)
            ax, az, bx, bz = map(builder.load, sums)
            real, imaginary = (builder.fadd, builder.fsub) if conjugate else (builder.fsub, builder.fadd)
            for array, part in ((0, real(ax, bz)), (1, imaginary(az, bx))):
                total = builder.fadd(load(array, first_out), part)
                builder.store(total, pointer(array, first_out), align=size)
            return context.get_dummy_value()

        long = types.uint64
        return types.void(u, v, long, a, b, long, long, x, z, long, long, long), generate

    return add


def _set_to_multiples(
    typing_context: Any, u: Any, to: Any, share: Any, at: Any, x: Any, of: Any, stride: Any, terms: Any
) -> Any:
    """Set u to the sum over n of share[at + n] x[of + n stride], a pair of vectors of `VECTOR` bytes each."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.get_data_type(u.dtype)
        size = context.get_abi_sizeof(number)
        lanes = 2 * VECTOR // size
        vector = ir.VectorType(number, lanes)
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes), None)
        fused = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, ir.FunctionType(vector, 3 * [vector]), f"llvm.fmuladd.v{lanes}f{8 * size}"
        )
        _, first_out, _, first_share, _, first, stride, terms = arguments

        def pointer(array: int, index: Any) -> Any:
            item = _item(context, builder, signature, arguments, array, index)
            return builder.bitcast(item, vector.as_pointer())

        total = cgutils.alloca_once_value(builder, ir.Constant(vector, None))  # type: ignore[no-untyped-call]
        with cgutils.for_range(builder, terms) as loop:
            place = builder.add(first_share, loop.index)
            part = builder.load(_item(context, builder, signature, arguments, 2, place))
            part = builder.insert_element(ir.Constant(vector, ir.Undefined), part, ir.IntType(32)(0))
            other = builder.load(pointer(4, builder.add(first, builder.mul(loop.index, stride))), align=size)
            shares = builder.shuffle_vector(part, part, zeros)
            builder.store(builder.call(fused, [shares, other, builder.load(total)]), total)
        builder.store(builder.load(total), pointer(0, first_out), align=size)
        return context.get_dummy_value()

    long = types.uint64
    return types.void(u, long, share, long, x, long, long, long), generate


def _add_atomically(typing_context: Any, counters: Any, place: Any, amount: Any) -> Any:
    """Add to a counter and return its old value."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        counter = _item(context, builder, signature, arguments, 0, arguments[1])
        return builder.atomic_rmw("add", counter, arguments[2], "seq_cst")

    return types.int64(counters, types.int64, types.int64), generate


def _read_atomically(typing_context: Any, counters: Any, place: Any) -> Any:
    """Return a counter, with all writes before it was last added to (acquire)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        counter = _item(context, builder, signature, arguments, 0, arguments[1])
        return builder.load_atomic(counter, "acquire", 8)

    return types.int64(counters, types.int64), generate


add_products: Any = intrinsic(_products_added(False))
add_conjugate_products: Any = intrinsic(_products_added(True))
set_to_multiples: Any = intrinsic(_set_to_multiples)
sum_of_rows: Any = intrinsic(_sum_of_rows)
sums_of_rows: Any = intrinsic(_sums_of_rows)
add_four: Any = intrinsic(_add_four)
add_to_counter: Any = intrinsic(_add_atomically)
read_counter: Any = intrinsic(_read_atomically)
# The system's function that yields to other threads, by a name that kernels loaded from disk find
_SYSTEM = ctypes.CDLL("kernel32").SwitchToThread if os.name == "nt" else ctypes.CDLL(None).sched_yield
llvmlite.binding.add_symbol("autdtorch_give_way", ctypes.cast(_SYSTEM, ctypes.c_void_p).value)
give_way = types.ExternalFunction("autdtorch_give_way", types.int32())
