"""The 27-point sum around a single cell, four cells of a row at a time.

Numba does not vectorise it: heterogeneous cells are scattered, and strict sums keep their order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.utils.array_types import AnyArray, Index

_WIDTH = 4  # Cells of a row that are read: the three neighbours, and one whose weight is zero


def rows_of(weight: AnyArray) -> AnyArray:
    """Return weights (n, 27) as `sum_of_rows` reads them (n * 36,).

    The cell of weight zero is the last of a row, and the first of the last row: no read leaves the grid.
    """
    rows = np.zeros((len(weight), 9, _WIDTH), weight.dtype)
    rows[:, :8, :3] = weight.reshape(-1, 9, 3)[:, :8]
    rows[:, 8, 1:] = weight[:, 24:]
    return rows.reshape(-1)


def row_offsets(shape: tuple[int, ...]) -> Index:
    """Return the flat offsets (9,) from a cell to the first cells of the rows."""
    first = np.array(flat_offsets(shape)[::3])
    first[8] -= 1
    return first


def _sum_of_rows(typing_context: Any, p: Any, cell: Any, offset: Any, weight: Any, at: Any) -> Any:
    """Return the sum of weight[at + 4 r + j] * (p[cell + offset[r] + j] - p[cell])."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        kinds = signature.args
        number = context.get_data_type(p.dtype)
        row = ir.VectorType(number, _WIDTH)
        size = context.get_abi_sizeof(number)
        arrays = {k: context.make_array(kinds[k])(context, builder, given[k]) for k in (0, 2, 3)}

        def pointer(k: int, index: Any) -> Any:
            return cgutils.get_item_pointer(context, builder, kinds[k], arrays[k], [index], wraparound=False)  # type: ignore[no-untyped-call]

        def load(k: int, index: Any) -> Any:
            return builder.load(builder.bitcast(pointer(k, index), row.as_pointer()), align=size)

        here, own = builder.load(pointer(0, given[1])), ir.Constant(row, None)
        for j in range(_WIDTH):
            own = builder.insert_element(own, here, ir.Constant(ir.IntType(32), j))
        total = ir.Constant(row, None)
        for r in range(9):
            long = ir.IntType(64)
            step = builder.load(pointer(2, ir.Constant(long, r)))
            around = load(0, builder.add(given[1], step))
            weights = load(3, builder.add(given[4], ir.Constant(long, _WIDTH * r)))
            total = builder.fadd(total, builder.fmul(weights, builder.fsub(around, own)))
        parts = [builder.extract_element(total, ir.Constant(ir.IntType(32), j)) for j in range(_WIDTH)]
        return builder.fadd(builder.fadd(parts[0], parts[2]), builder.fadd(parts[1], parts[3]))

    return p.dtype(p, types.int64, offset, weight, types.int64), generate


sum_of_rows: Any = intrinsic(_sum_of_rows)
