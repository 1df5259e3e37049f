"""Programs of R runs on a GPU, in Triton: where the numbers of each are, and its absorbing layers.

The layers have a memory, and terms of axes and columns.
"""

# The arguments are values of Triton's compiler, which has no types for them.
# mypy: disable-error-code="assignment, no-untyped-def, untyped-decorator, var-annotated"

from __future__ import annotations

import triton
import triton.language as tl
from triton.language.extra.cuda import gdc_launch_dependents, gdc_wait

from autdtorch.fdtd.kernels.contract import Layer

# Places in the tensor of weights; scalars would be passed in single precision
CENTER, FACE, EDGE, CORNER, KEEP = (tl.constexpr(place) for place in range(5))


@triton.jit
def begin(EARLY: tl.constexpr):
    """Wait for the launch before, and let the next one come: where `EARLY`, its programs wait here too."""
    if EARLY:
        gdc_wait()
        gdc_launch_dependents()


@triton.jit
def task_of(runs):
    """Return the task of a program, and its run."""
    program = tl.program_id(0)
    return program // runs, tl.cast(program % runs, tl.int64)


@triton.jit
def field_of(p, shape, run):
    """Return the field of a run."""
    return p + run * (tl.cast(shape.nx, tl.int64) * shape.ny * shape.nz)


@triton.jit
def layer_of(layer, across, run, CELLS: tl.constexpr):
    """Return the memory of a run at the low and the high layer, or at columns, with cells `across` it."""
    return Layer(layer.psi + run * ((CELLS + 1) * across), layer.zeta + run * (CELLS * across))


@triton.jit
def advance(behind, here, ahead, memory, half, cell, stride, profile, depth, mask):
    """Return the memory of a layer at cells at `depth`: psi outside and inside of them, and zeta."""
    difference = ahead - here
    decay, gain = profile.decay + 2 * depth, profile.gain + 2 * depth
    outer = tl.load(decay - 2) * tl.load(memory.psi + half, mask=mask, other=0)
    outer += tl.load(gain - 2) * (here - behind)
    inner = tl.load(decay) * tl.load(memory.psi + half + stride, mask=mask, other=0)
    inner += tl.load(gain) * difference
    zeta = tl.load(decay - 1) * tl.load(memory.zeta + cell, mask=mask, other=0)
    zeta += tl.load(gain - 1) * (difference - (here - behind) + (inner - outer))
    return outer, inner, zeta


@triton.jit
def _stretch(behind, here, ahead, old, new, half, cell, stride, profile, depth, mask, CELLS: tl.constexpr):
    """Advance the memory of a layer at cells at `depth`; return their term."""
    outer, inner, zeta = advance(behind, here, ahead, old, half, cell, stride, profile, depth, mask)
    tl.store(new.psi + half, outer, mask=mask)
    tl.store(new.psi + half + stride, inner, mask=mask & (depth == CELLS))
    tl.store(new.zeta + cell, zeta, mask=mask)
    return inner - outer + zeta


@triton.jit
def _row_end(p, shape, row, side, depth, mask, CELLS: tl.constexpr):
    """Return pressures behind, at and ahead of cells of the layers across z, and places in the memory."""
    inwards = 1 - 2 * side
    at = p + row.to(tl.int64) * shape.nz + (side * (shape.nz - 1) + inwards * depth)
    behind, here = tl.load(at - inwards, mask=mask, other=0), tl.load(at, mask=mask, other=0)
    ahead = tl.load(at + inwards, mask=mask, other=0)
    column = side * shape.nx * shape.ny + row
    return behind, here, ahead, column * (CELLS + 1) + depth - 1, column * CELLS + depth - 1


@triton.jit
def _lanes(program, LANES: tl.constexpr, DEPTHS: tl.constexpr):
    """Return a block of columns through the layers, along the second axis, and the depths in them."""
    return program * LANES + tl.arange(0, LANES)[None, :], 1 + tl.arange(0, DEPTHS)[:, None]


@triton.jit
def stretch_z(p, shape, old, new, profile, terms, program, CELLS: tl.constexpr, DEPTHS: tl.constexpr,
              LANES: tl.constexpr):  # fmt: skip
    """Advance the layers across z, and store their terms."""
    side = program % 2
    row, depth = _lanes(program // 2, LANES, DEPTHS)
    mask = (row < shape.nx * shape.ny) & (depth <= CELLS)
    behind, here, ahead, half, cell = _row_end(p, shape, row, side, depth, mask, CELLS)
    term = _stretch(behind, here, ahead, old, new, half, cell, 1, profile, depth, mask, CELLS)
    tl.store(terms + (2 * row + side) * CELLS + depth - 1, term, mask=mask)


@triton.jit
def stretch_y(p, shape, old, new, profile, terms, program, CELLS: tl.constexpr, DEPTHS: tl.constexpr,
              LANES: tl.constexpr):  # fmt: skip
    """Advance the layers across y, and store their terms."""
    side = program % 2
    column, depth = _lanes(program // 2, LANES, DEPTHS)
    mask = (column < shape.nx * shape.nz) & (depth <= CELLS)
    plane, k = column // shape.nz, column % shape.nz
    inwards = (1 - 2 * side) * shape.nz
    at = p + (plane * shape.ny + side * (shape.ny - 1)).to(tl.int64) * shape.nz + (inwards * depth + k)
    behind, here = tl.load(at - inwards, mask=mask, other=0), tl.load(at, mask=mask, other=0)
    ahead = tl.load(at + inwards, mask=mask, other=0)
    slab = side * shape.nx + plane
    half = (slab * (CELLS + 1) + depth - 1) * shape.nz + k
    cell = (slab * CELLS + depth - 1) * shape.nz + k
    term = _stretch(behind, here, ahead, old, new, half, cell, shape.nz, profile, depth, mask, CELLS)
    tl.store(terms + ((2 * plane + side) * CELLS + depth - 1) * shape.nz + k, term, mask=mask)


@triton.jit
def _term_z(p, shape, old, profile, row, side, depth, mask, CELLS: tl.constexpr):
    """Return E_z p, which `stretch_z` computes elsewhere in the same launch."""
    behind, here, ahead, half, cell = _row_end(p, shape, row, side, depth, mask, CELLS)
    outer, inner, zeta = advance(behind, here, ahead, old, half, cell, 1, profile, depth, mask)
    return inner - outer + zeta


@triton.jit
def stretch_yz(p, shape, old_z, old, new, profile, terms, program, CELLS: tl.constexpr,
               DEPTHS: tl.constexpr, LANES: tl.constexpr):  # fmt: skip
    """Advance the layers where those across y and z cross, and store their terms."""
    side = program % 2
    column, depth = _lanes(program // 2, LANES, DEPTHS)
    mask = (column < 2 * CELLS * shape.nx) & (depth <= CELLS)
    plane, place = column // (2 * CELLS), column % (2 * CELLS)
    end, inside = place // CELLS, place % CELLS + 1
    inwards = 1 - 2 * side
    row = plane * shape.ny + side * (shape.ny - 1) + inwards * depth
    behind = _term_z(p, shape, old_z, profile, row - inwards, end, inside, mask, CELLS)
    here = _term_z(p, shape, old_z, profile, row, end, inside, mask, CELLS)
    ahead = _term_z(p, shape, old_z, profile, row + inwards, end, inside, mask, CELLS)
    slab = side * shape.nx + plane
    half = (slab * (CELLS + 1) + depth - 1) * (2 * CELLS) + place
    cell = (slab * CELLS + depth - 1) * (2 * CELLS) + place
    term = _stretch(behind, here, ahead, old, new, half, cell, 2 * CELLS, profile, depth, mask, CELLS)
    tl.store(terms + ((2 * plane + side) * CELLS + depth - 1) * (2 * CELLS) + place, term, mask=mask)


@triton.jit
def _across(p, columns, terms, column, depth, mask, WIDTH: tl.constexpr, CROSSED: tl.constexpr):
    """Return the sums across the columns at `depth`; zero in the ring."""
    mask = mask & (depth > 0)
    cell = p + tl.load(columns.cell + depth * columns.size + column, mask=mask, other=0)
    total = tl.zeros(cell.shape, p.dtype.element_ty)
    if CROSSED:
        place = tl.load(columns.crossing + depth * columns.size + column, mask=mask, other=0)
        total += tl.load(terms + place, mask=mask, other=0)
    for beside in tl.static_range(WIDTH):
        offset = tl.load(columns.offset + beside * columns.size + column, mask=mask, other=0)
        weight = tl.load(columns.weight + beside * columns.size + column, mask=mask, other=0)
        total += weight * tl.load(cell + offset, mask=mask, other=0)
    return total


@triton.jit
def stretch_columns(p, columns, old, new, profile, crossed, terms, program, WIDTH: tl.constexpr,
                    CROSSED: tl.constexpr, CELLS: tl.constexpr, DEPTHS: tl.constexpr,
                    LANES: tl.constexpr):  # fmt: skip
    """Advance columns of cells through the layers, and store their terms."""
    column, depth = _lanes(program, LANES, DEPTHS)
    mask = (column < columns.size) & (depth <= CELLS)
    behind = _across(p, columns, crossed, column, depth - 1, mask, WIDTH, CROSSED)
    here = _across(p, columns, crossed, column, depth, mask, WIDTH, CROSSED)
    ahead = _across(p, columns, crossed, column, depth + 1, mask, WIDTH, CROSSED)
    cell = (depth - 1) * columns.size + column
    term = _stretch(behind, here, ahead, old, new, cell, cell, columns.size, profile, depth, mask, CELLS)
    tl.store(terms + cell, term, mask=mask)
