"""The sweep of a time step of R runs on a GPU, in Triton: the 27-point sum with all layers."""

# The arguments are values of Triton's compiler, which has no types for them.
# mypy: disable-error-code="assignment, no-untyped-def, untyped-decorator, var-annotated"

from __future__ import annotations

import triton
import triton.language as tl

from autdtorch.fdtd.kernels.cuda_layers import (
    CENTER,
    CORNER,
    EDGE,
    FACE,
    KEEP,
    advance,
    begin,
    field_of,
    layer_of,
    stretch_columns,
    task_of,
)


@triton.jit
def _plane(p, i, shape, tile, weights, terms_y, terms_z, terms_yz, CELLS: tl.constexpr, ROWS: tl.constexpr):
    """Return, for each of a thread's rows, the sums over plane i: for its cells, and for those beside it.

    A thread loads each row once, for the sums of three rows, and all rows before it waits for any.
    """
    ny, nz = shape.ny, shape.nz
    first, k, inside, near_y, in_z, place_z = tile
    center, face, edge, corner = weights
    plane = p + i * (tl.cast(ny, tl.int64) * nz)
    # a row's pressures, and the sum of their neighbours along z, with the layers' term
    middle, along = (), ()
    for row in tl.static_range(-1, ROWS + 1):
        j = first + row
        mask = inside & (j >= 0) & (j < ny)
        at = plane + (j * nz + k)
        both = tl.load(at - 1, mask=mask, other=0) + tl.load(at + 1, mask=mask, other=0)
        both += tl.load(terms_z + (i * ny + j) * (2 * CELLS) + place_z, mask=mask & in_z, other=0)
        middle += (tl.load(at, mask=mask, other=0),)
        along += (both,)
    faces, edges = (), ()
    for row in tl.static_range(ROWS):
        faces += (middle[row] + middle[row + 2] + along[row + 1],)
        edges += (along[row] + along[row + 2],)
    if near_y:
        faces, edges = _with_layers_of_y(faces, edges, i, shape, tile, terms_y, terms_yz, CELLS, ROWS)
    levels, besides = (), ()
    for row in tl.static_range(ROWS):
        levels += (center * middle[row + 1] + face * faces[row] + edge * edges[row],)
        besides += (face * middle[row + 1] + edge * faces[row] + corner * edges[row],)
    return levels, besides


@triton.jit
def _with_layers_of_y(faces, edges, i, shape, tile, terms_y, terms_yz, CELLS: tl.constexpr,
                      ROWS: tl.constexpr):  # fmt: skip
    """Return the sums over faces and edges with the terms of the layers across y."""
    ny, nz = shape.ny, shape.nz
    first, k, inside, _, in_z, place_z = tile
    more_faces, more_edges = (), ()
    for row in tl.static_range(ROWS):
        j = first + row
        mask = inside & (j >= 1) & (j < ny - 1) & ((j <= CELLS) | (j >= ny - 1 - CELLS))
        place_y = i * (2 * CELLS) + tl.where(j <= CELLS, j - 1, CELLS + ny - 2 - j)
        at = terms_y + place_y * nz + k
        beside = tl.load(at - 1, mask=mask, other=0) + tl.load(at + 1, mask=mask, other=0)
        beside += tl.load(terms_yz + place_y * (2 * CELLS) + place_z, mask=mask & in_z, other=0)
        more_faces += (faces[row] + tl.load(at, mask=mask, other=0),)
        more_edges += (edges[row] + beside,)
    return more_faces, more_edges


@triton.jit
def _tile(low_y, low_z, shape, CELLS: tl.constexpr, Y: tl.constexpr, Z: tl.constexpr,
          ROWS: tl.constexpr):  # fmt: skip
    """Return the first row of each thread of a tile, cells along z, and where they are in layers."""
    ny, nz = shape.ny, shape.nz
    j, k = low_y + ROWS * tl.arange(0, Y // ROWS)[:, None], low_z + tl.arange(0, Z)[None, :]
    inside = (k >= 1) & (k < nz - 1)
    near_y = (low_y <= CELLS) | (low_y + Y >= ny - CELLS)
    in_z = inside & ((k <= CELLS) | (k >= nz - 1 - CELLS))
    return j, k, inside, near_y, in_z, tl.where(k <= CELLS, k - 1, CELLS + nz - 2 - k)


@triton.jit
def _stretch_rows(values, behind, here, ahead, old, new, half, cell, shape, tile, profile, depth,
                  CELLS: tl.constexpr, ROWS: tl.constexpr):  # fmt: skip
    """Advance the memory of a layer across x in rows of a plane; return `values` with their terms.

    The plane's memory begins at `half` and `cell`. All rows are loaded before any is stored.
    """
    ny, nz = shape.ny, shape.nz
    first, k, inside = tile[0], tile[1], tile[2]
    advanced, results = (), ()
    for row in tl.static_range(ROWS):
        column, mask = (first + row) * nz + k, inside & (first + row >= 1) & (first + row < ny - 1)
        advanced += (
            advance(behind[row], here[row], ahead[row], old, half + column, cell + column, ny * nz, profile,
                      depth, mask),
        )  # fmt: skip
    for row in tl.static_range(ROWS):
        column, mask = (first + row) * nz + k, inside & (first + row >= 1) & (first + row < ny - 1)
        outer, inner, zeta = advanced[row]
        tl.store(new.psi + half + column, outer, mask=mask)
        tl.store(new.psi + half + column + ny * nz, inner, mask=mask & (depth == CELLS))
        tl.store(new.zeta + cell + column, zeta, mask=mask)
        results += (values[row] + (inner - outer + zeta),)
    return results


@triton.jit
def _march(p, q, shape, weights, profile, old, new, terms_y, terms_z, terms_yz, program,
           CELLS: tl.constexpr, X: tl.constexpr, Y: tl.constexpr, Z: tl.constexpr,
           ROWS: tl.constexpr):  # fmt: skip
    """Step a tile of y and z through X planes along x; each plane is summed once."""
    nx, ny, nz = shape.nx, shape.ny, shape.nz
    tiles_y, tiles_z = tl.cdiv(ny, Y), tl.cdiv(nz, Z)
    tile = _tile(program // tiles_z % tiles_y * Y, program % tiles_z * Z, shape, CELLS, Y, Z, ROWS)
    first_row, k, inside = tile[0], tile[1], tile[2]
    sums = (
        tl.load(weights + CENTER), tl.load(weights + FACE), tl.load(weights + EDGE), tl.load(weights + CORNER)
    )  # fmt: skip
    keep, area = tl.load(weights + KEEP), ny * nz
    first = 1 + program // (tiles_y * tiles_z) * X
    _, behind = _plane(p, first - 1, shape, tile, sums, terms_y, terms_z, terms_yz, CELLS, ROWS)
    level, here = _plane(p, first, shape, tile, sums, terms_y, terms_z, terms_yz, CELLS, ROWS)
    for i in range(first, tl.minimum(first + X, nx - 1)):
        plane, values = q + i * tl.cast(area, tl.int64), ()
        for row in tl.static_range(ROWS):
            j = first_row + row
            before = tl.load(plane + (j * nz + k), mask=inside & (j >= 1) & (j < ny - 1), other=0)
            values += (level[row] - keep * before,)
        level, ahead = _plane(p, i + 1, shape, tile, sums, terms_y, terms_z, terms_yz, CELLS, ROWS)
        summed = ()
        for row in tl.static_range(ROWS):
            summed += (values[row] + (behind[row] + ahead[row]),)
        if i <= CELLS:
            half = (i - 1) * area
            summed = _stretch_rows(summed, behind, here, ahead, old, new, half, half, shape, tile, profile, i,
                                   CELLS, ROWS)  # fmt: skip
        elif i >= nx - 1 - CELLS:
            depth = nx - 1 - i
            cell = (CELLS + depth - 1) * area
            summed = _stretch_rows(summed, ahead, here, behind, old, new, cell + area, cell, shape, tile,
                                   profile, depth, CELLS, ROWS)  # fmt: skip
        for row in tl.static_range(ROWS):
            j = first_row + row
            tl.store(plane + (j * nz + k), summed[row], mask=inside & (j >= 1) & (j < ny - 1))
        behind, here = here, ahead


@triton.jit(do_not_specialize=["tiles", "runs"])
def sweep(p, q, shape, weights, profile, old, new, terms, columns, crossed, tiles, runs,
          COLUMNS_WIDTH: tl.constexpr, CELLS: tl.constexpr, DEPTHS: tl.constexpr, LANES: tl.constexpr,
          X: tl.constexpr, Y: tl.constexpr, Z: tl.constexpr, ROWS: tl.constexpr,
          EARLY: tl.constexpr):  # fmt: skip
    """The 27-point sum with all layers, in place of the pressures before, and the columns."""
    begin(EARLY)
    program, run = task_of(runs)
    p = field_of(p, shape, run)
    if program < tiles:
        area = 2 * shape.ny * shape.nz
        old_x, new_x = layer_of(old.x, area, run, CELLS), layer_of(new.x, area, run, CELLS)
        at_y = terms.y + run * (2 * shape.nx * shape.nz * CELLS)
        at_z = terms.z + run * (2 * shape.nx * shape.ny * CELLS)
        at_yz = terms.yz + run * (shape.nx * (2 * CELLS) * (2 * CELLS))
        _march(p, field_of(q, shape, run), shape, weights, profile, old_x, new_x, at_y, at_z, at_yz, program,
               CELLS, X, Y, Z, ROWS)  # fmt: skip
    elif COLUMNS_WIDTH > 0:
        size = columns.size
        old_columns, new_columns = (
            layer_of(old.columns, size, run, CELLS),
            layer_of(new.columns, size, run, CELLS),
        )
        beside, term = (
            terms.crossed + run * (CELLS * crossed.size + 1),
            terms.columns + run * (CELLS * size + 1),
        )
        stretch_columns(p, columns, old_columns, new_columns, profile, beside, term, program - tiles,
                         COLUMNS_WIDTH, True, CELLS, DEPTHS, LANES)  # fmt: skip
