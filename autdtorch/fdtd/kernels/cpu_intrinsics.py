"""Operations that Numba lacks: on several numbers at a time, and on counters of several threads.

Numba vectorises neither the rows around heterogeneous cells, which are scattered and whose sums keep an
order, nor the short ends of rows with the cells of absorbing layers.
"""

from __future__ import annotations

import ctypes
import os
from typing import Any

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from autdtorch.fdtd.kernels.contract import BLOCK

_WIDTH = 4  # Cells of a row that are added at once
_MIDDLE = 13  # The cell itself among its neighbours, from which it does not differ
VECTOR = 64
"""Bytes of a vector of `add_products`."""


def _item(context: Any, builder: Any, signature: Any, arguments: Any, array: int, index: Any) -> Any:
    """Return the pointer to an item of the argument number `array`."""
    kind = signature.args[array]
    items = context.make_array(kind)(context, builder, arguments[array])
    return cgutils.get_item_pointer(context, builder, kind, items, [index], wraparound=False)  # type: ignore[no-untyped-call]


def _around(losses: bool) -> Any:
    """Return the operation out = sum over j of weight_j (u_j - u), for a block and the 27 neighbours j.

    The `BLOCK` cells begin at `cell`, their weights (27, `BLOCK`) at `at`, the results at `place`. With
    `losses`, u is the change p - q. Otherwise u is p, and p + keep (p - q) is added.
    """

    def sums(
        typing_context: Any, p: Any, q: Any, cell: Any, keep: Any, offset: Any, weight: Any, at: Any,
        out: Any, place: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            number, long = context.get_data_type(p.dtype), ir.IntType(64)
            cells, size = ir.VectorType(number, BLOCK), context.get_abi_sizeof(number)
            _, _, first_cell, keeping, _, _, first_weight, _, first_out = arguments

            def item(array: int, index: Any) -> Any:
                return _item(context, builder, signature, arguments, array, index)

            def load(array: int, index: Any) -> Any:
                return builder.load(builder.bitcast(item(array, index), cells.as_pointer()), align=size)

            def value(index: Any) -> Any:
                return builder.fsub(load(0, index), load(1, index)) if losses else load(0, index)

            here, parts = value(first_cell), 3 * [ir.Constant(cells, None)]
            for row in range(9):
                start = builder.add(first_cell, builder.load(item(4, ir.Constant(long, row))))
                for j in range(3):
                    if (neighbour := 3 * row + j) == _MIDDLE:
                        continue
                    rise = builder.fsub(value(builder.add(start, ir.Constant(long, j))), here)
                    weights = load(5, builder.add(first_weight, ir.Constant(long, neighbour * BLOCK)))
                    parts[j] = builder.fadd(parts[j], builder.fmul(weights, rise))
            total = builder.fadd(builder.fadd(parts[0], parts[2]), parts[1])
            if not losses:
                change = builder.fsub(here, load(1, first_cell))
                zeros = ir.Constant(ir.VectorType(ir.IntType(32), BLOCK), None)
                share = builder.insert_element(ir.Constant(cells, ir.Undefined), keeping, ir.IntType(32)(0))
                inertia = builder.fmul(builder.shuffle_vector(share, share, zeros), change)
                total = builder.fadd(builder.fadd(here, inertia), total)
            results = builder.bitcast(item(7, first_out), cells.as_pointer())
            builder.store(total, results, align=size)
            return context.get_dummy_value()

        long = types.uint64
        return types.void(p, q, long, keep, offset, weight, long, out, long), generate

    return sums


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
step_around: Any = intrinsic(_around(losses=False))
losses_around: Any = intrinsic(_around(losses=True))
add_four: Any = intrinsic(_add_four)
add_to_counter: Any = intrinsic(_add_atomically)
read_counter: Any = intrinsic(_read_atomically)
# The system's function that yields to other threads, by a name that kernels loaded from disk find
_SYSTEM = ctypes.CDLL("kernel32").SwitchToThread if os.name == "nt" else ctypes.CDLL(None).sched_yield
llvmlite.binding.add_symbol("autdtorch_give_way", ctypes.cast(_SYSTEM, ctypes.c_void_p).value)
give_way = types.ExternalFunction("autdtorch_give_way", types.int32())
