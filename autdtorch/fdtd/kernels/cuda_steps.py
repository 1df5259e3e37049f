"""One time step of R runs on a GPU, in Triton: three launches, each of programs with different tasks.

`prepare` only reads the pressures. It stretches the layers across y and z and the crossed columns, computes
the heterogeneous cells, and reads the receivers. `cuda_sweep.sweep` computes the 27-point sum with all
layers, and the columns beside it. `settle` corrects the cells that this leaves wrong: heterogeneous,
sound-hard and driven cells and those of columns.

The memory of layers and columns is read from one buffer and written to another. No program reads what another
one of the same launch writes, so their order does not matter. Programs with the same task for all runs are
neighbours, as they read the same coefficients.
"""

# The arguments are values of Triton's compiler, which has no types for them.
# mypy: disable-error-code="assignment, no-untyped-def, untyped-decorator, var-annotated"

from __future__ import annotations

import triton
import triton.language as tl

from autdtorch.fdtd.kernels.cuda_layers import (
    KEEP,
    begin,
    field_of,
    layer_of,
    stretch_columns,
    stretch_y,
    stretch_yz,
    stretch_z,
    task_of,
)


@triton.jit
def _gather_heterogeneous(p, before, shape, weights, heterogeneous, program, run, LOSSY: tl.constexpr,
                          LANES: tl.constexpr):  # fmt: skip
    n = program * LANES + tl.arange(0, LANES)
    mask = n < heterogeneous.size
    cell = tl.load(heterogeneous.cell + n, mask=mask, other=0)
    middle, old = tl.load(p + cell, mask=mask, other=0), tl.load(before + cell, mask=mask, other=0)
    keep = tl.load(weights + KEEP)
    air, change = -keep * old, tl.zeros([LANES], p.dtype.element_ty)
    plane = tl.cast(shape.ny, tl.int64) * shape.nz
    for x in tl.static_range(3):
        for y in tl.static_range(3):
            for z in tl.static_range(3):
                beside = p + cell + ((x - 1) * plane + (y - 1) * shape.nz + (z - 1))
                value = tl.load(beside, mask=mask, other=0)
                place = n + (9 * x + 3 * y + z) * heterogeneous.size
                change += tl.load(heterogeneous.weight + place, mask=mask, other=0) * (value - middle)
                if LOSSY:
                    past = before + cell + ((x - 1) * plane + (y - 1) * shape.nz + (z - 1))
                    step = value - tl.load(past, mask=mask, other=0)
                    change += tl.load(heterogeneous.loss + place, mask=mask, other=0) * step
                kind = (x - 1) * (x - 1) + (y - 1) * (y - 1) + (z - 1) * (z - 1)
                air += tl.load(weights + kind) * value
    if LOSSY:
        ground = tl.load(heterogeneous.loss + n + 27 * heterogeneous.size, mask=mask, other=0)
        change -= ground * middle
    scale = tl.load(heterogeneous.scale + n, mask=mask, other=0)
    # The sweep gives `air` and the layers' term; `settle` adds `scale` times that.
    settled = heterogeneous.settled + run * heterogeneous.size + n
    tl.store(settled, middle + keep * (middle - old) + change - scale * air, mask=mask)


@triton.jit
def _read(p, receivers, row, program, run, LANES: tl.constexpr):
    r = program * LANES + tl.arange(0, LANES)
    mask = (r < receivers.size) & (row >= 0)
    total = tl.zeros([LANES], p.dtype.element_ty)
    for node in range(receivers.width):
        place = node * receivers.size + r
        cell = tl.load(receivers.cell + place, mask=mask, other=0)
        total += tl.load(receivers.weight + place, mask=mask, other=0) * tl.load(p + cell, mask=mask, other=0)
    row += run * receivers.steps
    tl.store(receivers.recorded + tl.cast(row, tl.int64) * receivers.size + r, total, mask=mask)


@triton.jit(do_not_specialize=["runs", "offset"])
def prepare(p, before, shape, weights, profile, old, new, terms, heterogeneous, crossed, receivers, ends,
            runs, first, offset, LOSSY: tl.constexpr, CROSSED_WIDTH: tl.constexpr, CELLS: tl.constexpr,
            DEPTHS: tl.constexpr, LANES: tl.constexpr, EARLY: tl.constexpr):  # fmt: skip
    """The part of a step that only reads pressures; receivers are read after the step before."""
    begin(EARLY)
    program, run = task_of(runs)
    p, ends_of_rows, rows = field_of(p, shape, run), 2 * shape.nx * shape.ny, 2 * shape.nx * shape.nz
    if program < ends.z:
        old_z, new_z = layer_of(old.z, ends_of_rows, run, CELLS), layer_of(new.z, ends_of_rows, run, CELLS)
        term = terms.z + run * (ends_of_rows * CELLS)
        stretch_z(p, shape, old_z, new_z, profile, term, program, CELLS, DEPTHS, LANES)
    elif program < ends.y:
        old_y, new_y = layer_of(old.y, rows, run, CELLS), layer_of(new.y, rows, run, CELLS)
        term = terms.y + run * (rows * CELLS)
        stretch_y(p, shape, old_y, new_y, profile, term, program - ends.z, CELLS, DEPTHS, LANES)
    elif program < ends.yz:
        lanes = 2 * shape.nx * (2 * CELLS)
        old_yz, new_yz = layer_of(old.yz, lanes, run, CELLS), layer_of(new.yz, lanes, run, CELLS)
        old_z, term = layer_of(old.z, ends_of_rows, run, CELLS), terms.yz + run * (lanes * CELLS)
        stretch_yz(p, shape, old_z, old_yz, new_yz, profile, term, program - ends.y, CELLS, DEPTHS,
                    LANES)  # fmt: skip
    elif program < ends.heterogeneous:
        _gather_heterogeneous(p, field_of(before, shape, run), shape, weights, heterogeneous,
                              program - ends.yz, run, LOSSY, DEPTHS * LANES)  # fmt: skip
    elif program < ends.crossed:
        size = crossed.size
        old_columns, new_columns = (
            layer_of(old.crossed, size, run, CELLS),
            layer_of(new.crossed, size, run, CELLS),
        )
        term = terms.crossed + run * (CELLS * size + 1)
        stretch_columns(p, crossed, old_columns, new_columns, profile, term, term,
                         program - ends.heterogeneous, CROSSED_WIDTH, False, CELLS, DEPTHS,
                         LANES)  # fmt: skip
    else:
        _read(p, receivers, tl.load(first) + offset - 1, program - ends.crossed, run, DEPTHS * LANES)


@triton.jit(do_not_specialize=["runs", "offset"])
def settle(q, shape, heterogeneous, settled, driven, terms, columns, signal, runs, first, offset,
           SHARES: tl.constexpr, SIGNALS: tl.constexpr, CELLS: tl.constexpr,
           LANES: tl.constexpr, EARLY: tl.constexpr):  # fmt: skip
    """Correct the cells that the sweep leaves wrong."""
    begin(EARLY)
    program, run = task_of(runs)
    n = program * LANES + tl.arange(0, LANES)
    mask, still = n < driven.size, n < driven.settled
    at = field_of(q, shape, run) + tl.load(driven.cell + n, mask=mask, other=0)
    value = tl.load(at, mask=mask, other=0)
    place = tl.load(settled.heterogeneous + n, mask=still, other=-1)
    varies = place >= 0
    scale = tl.load(heterogeneous.scale + place, mask=varies, other=1)
    swept = heterogeneous.settled + run * heterogeneous.size
    value = scale * value + tl.load(swept + place, mask=varies, other=0)
    shares = terms.columns + run * (CELLS * columns.size + 1)
    for share in tl.static_range(SHARES):
        source = tl.load(settled.share + share * driven.settled + n, mask=still, other=0)
        value += tl.load(shares + source, mask=still, other=0)
    row = SIGNALS * (tl.load(first) + offset)
    force = driven.force + run * (SIGNALS * driven.size) + n
    for s in tl.static_range(SIGNALS):
        value += tl.load(signal + row + s) * tl.load(force + s * driven.size, mask=mask, other=0)
    hard = tl.load(settled.sound_hard + n, mask=still, other=0) > 0
    tl.store(at, tl.where(hard, 0, value), mask=mask)


@triton.jit(do_not_specialize=["runs", "row"])
def read_last(p, shape, receivers, runs, row, LANES: tl.constexpr):
    """Read the receivers after the last step."""
    program, run = task_of(runs)
    _read(field_of(p, shape, run), receivers, row, program, run, LANES)
