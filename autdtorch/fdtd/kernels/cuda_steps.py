"""One time step of R runs on a GPU, in Triton: three launches, each of programs with different tasks.

`prepare` only reads the pressures. It stretches the layers across y and z and the crossed columns, computes
the heterogeneous cells, and reads the receivers. `sweep` computes the 27-point sum with all layers, and the
columns beside it. `settle` corrects the cells that this leaves wrong: heterogeneous, sound-hard and driven
cells and those of columns.

The memory of layers and columns is read from one buffer and written to another. No program reads what another
one of the same launch writes, so their order does not matter. Programs with the same task for all runs are
neighbours, as they read the same coefficients.
"""

# The arguments are values of Triton's compiler, which has no types for them.
# mypy: disable-error-code="assignment, no-untyped-def, untyped-decorator, var-annotated"

from __future__ import annotations

import triton
import triton.language as tl

from autdtorch.fdtd.kernels.contract import Layer

# Places in the tensor of weights; scalars would be passed in single precision
CENTER, FACE, EDGE, CORNER, KEEP = (tl.constexpr(place) for place in range(5))


@triton.jit
def _task(runs):
    """Return the task of a program, and its run."""
    program = tl.program_id(0)
    return program // runs, tl.cast(program % runs, tl.int64)


@triton.jit
def _field(p, shape, run):
    """Return the field of a run."""
    return p + run * (tl.cast(shape.nx, tl.int64) * shape.ny * shape.nz)


@triton.jit
def _layer(layer, across, run, CELLS: tl.constexpr):
    """Return the memory of a run at the low and the high layer, or at columns, with cells `across` it."""
    return Layer(layer.psi + run * ((CELLS + 1) * across), layer.zeta + run * (CELLS * across))


@triton.jit
def _advanced(behind, here, ahead, memory, half, cell, stride, profile, depth, mask):
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
    outer, inner, zeta = _advanced(behind, here, ahead, old, half, cell, stride, profile, depth, mask)
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
def _stretch_z(p, shape, old, new, profile, terms, program, CELLS: tl.constexpr, DEPTHS: tl.constexpr,
               LANES: tl.constexpr):  # fmt: skip
    side = program % 2
    row, depth = _lanes(program // 2, LANES, DEPTHS)
    mask = (row < shape.nx * shape.ny) & (depth <= CELLS)
    behind, here, ahead, half, cell = _row_end(p, shape, row, side, depth, mask, CELLS)
    term = _stretch(behind, here, ahead, old, new, half, cell, 1, profile, depth, mask, CELLS)
    tl.store(terms + (2 * row + side) * CELLS + depth - 1, term, mask=mask)


@triton.jit
def _stretch_y(p, shape, old, new, profile, terms, program, CELLS: tl.constexpr, DEPTHS: tl.constexpr,
               LANES: tl.constexpr):  # fmt: skip
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
    """Return E_z p, which `_stretch_z` computes elsewhere in the same launch."""
    behind, here, ahead, half, cell = _row_end(p, shape, row, side, depth, mask, CELLS)
    outer, inner, zeta = _advanced(behind, here, ahead, old, half, cell, 1, profile, depth, mask)
    return inner - outer + zeta


@triton.jit
def _stretch_yz(p, shape, old_z, old, new, profile, terms, program, CELLS: tl.constexpr,
                DEPTHS: tl.constexpr, LANES: tl.constexpr):  # fmt: skip
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
def _stretch_columns(p, columns, old, new, profile, crossed, terms, program, WIDTH: tl.constexpr,
                     CROSSED: tl.constexpr, CELLS: tl.constexpr, DEPTHS: tl.constexpr,
                     LANES: tl.constexpr):  # fmt: skip
    column, depth = _lanes(program, LANES, DEPTHS)
    mask = (column < columns.size) & (depth <= CELLS)
    behind = _across(p, columns, crossed, column, depth - 1, mask, WIDTH, CROSSED)
    here = _across(p, columns, crossed, column, depth, mask, WIDTH, CROSSED)
    ahead = _across(p, columns, crossed, column, depth + 1, mask, WIDTH, CROSSED)
    cell = (depth - 1) * columns.size + column
    term = _stretch(behind, here, ahead, old, new, cell, cell, columns.size, profile, depth, mask, CELLS)
    tl.store(terms + cell, term, mask=mask)


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
            DEPTHS: tl.constexpr, LANES: tl.constexpr):  # fmt: skip
    """The part of a step that only reads pressures; receivers are read after the step before."""
    program, run = _task(runs)
    p, ends_of_rows, rows = _field(p, shape, run), 2 * shape.nx * shape.ny, 2 * shape.nx * shape.nz
    if program < ends.z:
        old_z, new_z = _layer(old.z, ends_of_rows, run, CELLS), _layer(new.z, ends_of_rows, run, CELLS)
        term = terms.z + run * (ends_of_rows * CELLS)
        _stretch_z(p, shape, old_z, new_z, profile, term, program, CELLS, DEPTHS, LANES)
    elif program < ends.y:
        old_y, new_y = _layer(old.y, rows, run, CELLS), _layer(new.y, rows, run, CELLS)
        term = terms.y + run * (rows * CELLS)
        _stretch_y(p, shape, old_y, new_y, profile, term, program - ends.z, CELLS, DEPTHS, LANES)
    elif program < ends.yz:
        lanes = 2 * shape.nx * (2 * CELLS)
        old_yz, new_yz = _layer(old.yz, lanes, run, CELLS), _layer(new.yz, lanes, run, CELLS)
        old_z, term = _layer(old.z, ends_of_rows, run, CELLS), terms.yz + run * (lanes * CELLS)
        _stretch_yz(p, shape, old_z, old_yz, new_yz, profile, term, program - ends.y, CELLS, DEPTHS,
                    LANES)  # fmt: skip
    elif program < ends.heterogeneous:
        _gather_heterogeneous(p, _field(before, shape, run), shape, weights, heterogeneous,
                              program - ends.yz, run, LOSSY, DEPTHS * LANES)  # fmt: skip
    elif program < ends.crossed:
        size = crossed.size
        old_columns, new_columns = (
            _layer(old.crossed, size, run, CELLS),
            _layer(new.crossed, size, run, CELLS),
        )
        term = terms.crossed + run * (CELLS * size + 1)
        _stretch_columns(p, crossed, old_columns, new_columns, profile, term, term,
                         program - ends.heterogeneous, CROSSED_WIDTH, False, CELLS, DEPTHS,
                         LANES)  # fmt: skip
    else:
        _read(p, receivers, tl.load(first) + offset - 1, program - ends.crossed, run, DEPTHS * LANES)


@triton.jit
def _plane(p, i, shape, tile, weights, terms_y, terms_z, terms_yz, CELLS: tl.constexpr, ROWS: tl.constexpr):
    """Return, for each of a thread's rows, the sums over plane i: for its cells, and for those beside it.

    A thread loads each row once, for the sums of three rows, and all rows before it waits for any.
    """
    ny, nz = shape.ny, shape.nz
    first, k, inside, near_y, in_z, place_z = tile
    center, face, edge, corner = weights
    plane = p + i * (tl.cast(ny, tl.int64) * nz)
    middle, along = (
        (),
        (),
    )  # a row's pressures, and the sum of their neighbours along z, with the layers' term
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
            _advanced(behind[row], here[row], ahead[row], old, half + column, cell + column, ny * nz, profile,
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
          X: tl.constexpr, Y: tl.constexpr, Z: tl.constexpr, ROWS: tl.constexpr):  # fmt: skip
    """The 27-point sum with all layers, in place of the pressures before, and the columns."""
    program, run = _task(runs)
    p = _field(p, shape, run)
    if program < tiles:
        area = 2 * shape.ny * shape.nz
        old_x, new_x = _layer(old.x, area, run, CELLS), _layer(new.x, area, run, CELLS)
        at_y = terms.y + run * (2 * shape.nx * shape.nz * CELLS)
        at_z = terms.z + run * (2 * shape.nx * shape.ny * CELLS)
        at_yz = terms.yz + run * (shape.nx * (2 * CELLS) * (2 * CELLS))
        _march(p, _field(q, shape, run), shape, weights, profile, old_x, new_x, at_y, at_z, at_yz, program,
               CELLS, X, Y, Z, ROWS)  # fmt: skip
    elif COLUMNS_WIDTH > 0:
        size = columns.size
        old_columns, new_columns = (
            _layer(old.columns, size, run, CELLS),
            _layer(new.columns, size, run, CELLS),
        )
        beside, term = (
            terms.crossed + run * (CELLS * crossed.size + 1),
            terms.columns + run * (CELLS * size + 1),
        )
        _stretch_columns(p, columns, old_columns, new_columns, profile, beside, term, program - tiles,
                         COLUMNS_WIDTH, True, CELLS, DEPTHS, LANES)  # fmt: skip


@triton.jit(do_not_specialize=["runs", "offset"])
def settle(q, shape, heterogeneous, settled, driven, terms, columns, signal, runs, first, offset,
           SHARES: tl.constexpr, SIGNALS: tl.constexpr, CELLS: tl.constexpr,
           LANES: tl.constexpr):  # fmt: skip
    """Correct the cells that the sweep leaves wrong."""
    program, run = _task(runs)
    n = program * LANES + tl.arange(0, LANES)
    mask, still = n < driven.size, n < driven.settled
    at = _field(q, shape, run) + tl.load(driven.cell + n, mask=mask, other=0)
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
    program, run = _task(runs)
    _read(_field(p, shape, run), receivers, row, program, run, LANES)
