"""The waves of points or discs at many points, on a GPU in Triton: each program writes those of a tile.

All is in double precision, as the memory of the matrix takes most of the time. With TRITON_INTERPRET=1 Triton
interprets it, slowly, on the CPU.
"""

# The arguments of the kernel are values of Triton's compiler, which has no types for them.
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import math

import numpy as np
import torch
import triton
import triton.language as tl

from autdtorch.analytic.discs import along_rim
from autdtorch.utils.apertures import Discs, centers_of, even_waves
from autdtorch.utils.validation import LENGTH_TOLERANCE

_ROWS, _COLUMNS = 4, 64  # of a tile: two waves for each of 128 threads


@triton.jit
def _write_waves(
    points, centers, discs, wave, matrix, rows, columns, kinds, steps, ends,
    DISCS: tl.constexpr, ENDS: tl.constexpr, STEPS: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Write the parts of the waves (rows, columns, 2) at points (rows, 3) [m]; NaN next to a disc.

    `wave` has turns per metre, 2 pi, attenuation, least distance and the parts of 1 / k. The centres
    (columns, 3) [m] may be those of `discs`, normals (columns, 3), of different `kinds` (columns,). For each
    kind `steps` has the parts of the first coefficient, the inverse of the least distance, and
    `EvenWaves.steps` (STEPS, 9). `ends` has ENDS distances, each with the number of steps that suffices from
    there on for all kinds.
    """
    # of a row; only the first axis of a grid has room for millions of sources
    tiles = tl.cdiv(columns, COLUMNS)
    row = (tl.program_id(0) // tiles * ROWS + tl.arange(0, ROWS))[:, None]
    column = (tl.program_id(0) % tiles * COLUMNS + tl.arange(0, COLUMNS))[None, :]
    there, here = row < rows, column < columns
    x = tl.load(points + 3 * row, mask=there, other=0) - tl.load(centers + 3 * column, mask=here, other=0)
    y = tl.load(points + 3 * row + 1, mask=there, other=0)
    y -= tl.load(centers + 3 * column + 1, mask=here, other=0)
    z = tl.load(points + 3 * row + 2, mask=there, other=0)
    z -= tl.load(centers + 3 * column + 2, mask=here, other=0)
    r = tl.maximum(tl.sqrt(x * x + y * y + z * z), tl.load(wave + 3))
    near = 1 / r
    turns = r * tl.load(wave)
    angle = (turns - tl.floor(turns + 0.5)) * tl.load(wave + 1)
    size = tl.exp(-r * tl.load(wave + 2)) * near
    re, im = size * tl.cos(angle), size * tl.sin(angle)
    if DISCS:
        along = x * tl.load(discs + 3 * column, mask=here, other=0)
        along += y * tl.load(discs + 3 * column + 1, mask=here, other=0)
        along += z * tl.load(discs + 3 * column + 2, mask=here, other=0)
        cosine = (along * near) * (along * near)
        c = steps + tl.load(kinds + column, mask=here, other=0) * (3 + 9 * STEPS)
        least = tl.load(c + 2)
        close = tl.minimum(near, least)
        square = close * close
        re_sum, im_sum = tl.load(c) + 0 * r, tl.load(c + 1) + 0 * r
        re_old, im_old = tl.load(wave + 5) * close - 1, -tl.load(wave + 4) * close
        re_new, im_new, old, new = 0 * r + 1, 0 * r, 0 * r, 0 * r + 1
        nearest = tl.min(tl.min(tl.where(there & here, r, tl.load(ends + 2 * ENDS - 2)), 1), 0)
        count = tl.load(ends + 1)
        for end in range(1, ENDS):
            count = tl.where(nearest >= tl.load(ends + 2 * end), tl.load(ends + 2 * end + 1), count)
        for step in range(0, tl.cast(count, tl.int32)):
            c_n = c + 3 + 9 * step
            a, b = tl.load(c_n) * square - tl.load(c_n + 2), tl.load(c_n + 1) * square
            gamma = tl.load(c_n + 3)
            re_next = a * re_new - b * im_new - gamma * re_old
            im_next = a * im_new + b * re_new - gamma * im_old
            re_old, im_old, re_new, im_new = re_new, im_new, re_next, im_next
            further = (tl.load(c_n + 4) * cosine - tl.load(c_n + 5)) * new - tl.load(c_n + 6) * old
            old, new = new, further
            c_re, c_im = tl.load(c_n + 7), tl.load(c_n + 8)
            re_sum += new * (c_re * re_new - c_im * im_new)
            im_sum += new * (c_re * im_new + c_im * re_new)
        re, im = re * re_sum - im * im_sum, re * im_sum + im * re_sum
        re = tl.where(near > least, float("nan"), re)
    place = matrix + 2 * (row.to(tl.int64) * columns + column)
    tl.store(place, re, mask=there & here)
    tl.store(place + 1, im, mask=there & here)


def waves_on_gpu(points: torch.Tensor, sources: torch.Tensor | Discs, wavenumber: complex) -> torch.Tensor:
    """Return the waves (P, N) at points (P, 3) [m] on the device of the points; see `waves_of`."""
    points, centers = points.contiguous(), centers_of(sources).to(points).contiguous()
    matrix = points.new_empty((len(points), len(centers), 2))
    inverse = 1 / wavenumber
    turns = wavenumber.real / (2 * math.pi), 2 * math.pi, wavenumber.imag
    wave = points.new_tensor((*turns, LENGTH_TOLERANCE, inverse.real, inverse.imag))
    normals = kinds = steps = ends = wave  # of no use for points
    if isinstance(sources, Discs):
        radii, kind = sources.kinds()
        series = even_waves(wavenumber, radii)
        with np.errstate(divide="ignore"):  # of points
            nearness = 1 / series.reaches[:, 0]
        first = np.stack((series.first.real, series.first.imag, nearness), axis=1)
        table = np.concatenate((first, series.steps.reshape(len(radii), -1)), axis=1)
        limits = np.stack((series.reaches.max(axis=0), series.counts.max(axis=0)), axis=1)
        kinds = torch.from_numpy(kind).to(points.device)
        steps, ends = (torch.from_numpy(part).to(points) for part in (table, limits))
        normals = sources.normals.to(points).contiguous()
    tiles = triton.cdiv(len(points), _ROWS) * triton.cdiv(len(centers), _COLUMNS)
    _write_waves[(tiles,)](
        points, centers, normals, wave, matrix, len(points), len(centers), kinds, steps, ends,
        DISCS=isinstance(sources, Discs), ENDS=len(ends) if ends.ndim > 1 else 1,
        STEPS=steps.shape[1] // 9 if steps.ndim > 1 else 0, ROWS=_ROWS, COLUMNS=_COLUMNS,
    )  # fmt: skip
    waves = torch.view_as_complex(matrix)
    if isinstance(sources, Discs) and len(beside := waves.real.isnan().nonzero()):
        row, column = beside.unbind(dim=1)
        offsets, radius = points[row] - centers[column], sources.radii.to(points)[column]
        waves[row, column] = along_rim(offsets, normals[column], radius, wavenumber)
    return waves
