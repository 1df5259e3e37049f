"""Operations on four cells of a row at a time, which Numba does not vectorise.

Rows around heterogeneous cells are scattered, and their strict sums keep an order; the ends of rows, with the
cells of boundary layers, are too short.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.utils.array_types import Index

_WIDTH = 4  # Cells of a row that are read: the three neighbours and one more, whose weight is not its own
# Neighbours read first in each row, and the one more in these four: no read leaves the grid or the weights
_FIRST, _MORE = (*range(0, 24, 3), 23), (*8 * (3,), 0)


def _item(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return cgutils.get_item_pointer(context, builder, kind, array, [index], wraparound=False)  # type: ignore[no-untyped-call]


def row_offsets(shape: tuple[int, ...]) -> Index:
    """Return the flat offsets (9,) from a cell to the first cells read of the nine rows around it."""
    first = np.array(flat_offsets(shape)[::3])
    first[8] -= 1
    return first


def _sum_of_rows(typing_context: Any, p: Any, cell: Any, offset: Any, weight: Any, at: Any) -> Any:
    """Return the sum of weight[at + j] * (p[neighbour j] - p[cell]) over the 27 neighbours j."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        kinds, long = signature.args, ir.IntType(64)
        number = context.get_data_type(p.dtype)
        row = ir.VectorType(number, _WIDTH)
        size = context.get_abi_sizeof(number)
        arrays = {k: context.make_array(kinds[k])(context, builder, given[k]) for k in (0, 2, 3)}

        def pointer(k: int, index: Any) -> Any:
            return _item(context, builder, kinds[k], arrays[k], index)

        def load(k: int, index: Any) -> Any:
            return builder.load(builder.bitcast(pointer(k, index), row.as_pointer()), align=size)

        here, own = builder.load(pointer(0, given[1])), ir.Constant(row, None)
        for j in range(_WIDTH):
            own = builder.insert_element(own, here, ir.Constant(ir.IntType(32), j))
        total = ir.Constant(row, None)
        for r, (first, more) in enumerate(zip(_FIRST, _MORE, strict=True)):
            step = builder.load(pointer(2, ir.Constant(long, r)))
            rise = builder.fsub(load(0, builder.add(given[1], step)), own)
            weights = load(3, builder.add(given[4], ir.Constant(long, first)))
            zero = ir.Constant(number, 0.0)
            weights = builder.insert_element(weights, zero, ir.Constant(ir.IntType(32), more))
            total = builder.fadd(total, builder.fmul(weights, rise))
        parts = [builder.extract_element(total, ir.Constant(ir.IntType(32), j)) for j in range(_WIDTH)]
        return builder.fadd(builder.fadd(parts[0], parts[2]), builder.fadd(parts[1], parts[3]))

    return p.dtype(p, types.int64, offset, weight, types.int64), generate


sum_of_rows: Any = intrinsic(_sum_of_rows)


def _add_four(typing_context: Any, u: Any, at: Any, v: Any, start: Any) -> Any:
    """Add four cells of v from `start` on to those of u from `at` on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        number = context.get_data_type(u.dtype)
        row, size = ir.VectorType(number, 4).as_pointer(), context.get_abi_sizeof(number)

        def pointer(k: int) -> Any:
            array = context.make_array(signature.args[k])(context, builder, given[k])
            cell = _item(context, builder, signature.args[k], array, given[k + 1])
            return builder.bitcast(cell, row)

        here, there = pointer(0), pointer(2)
        total = builder.fadd(builder.load(here, align=size), builder.load(there, align=size))
        builder.store(total, here, align=size)
        return context.get_dummy_value()

    return types.void(u, types.uint64, v, types.uint64), generate


add_four: Any = intrinsic(_add_four)
