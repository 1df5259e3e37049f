"""The kernel for CPUs, in numba: the same contract as the reference, in place, on all cores.

Rows along z are contiguous and vectorise. A row of the 27-point sum is built from the row itself, the sum of
the 4 rows beside it and the sum of the 4 rows diagonal to it: 9 rows are read once each and the rest stays in
the first-level cache.

numba's threads do not survive a fork: start processes that use this module by spawn.
"""

from __future__ import annotations

import os

# An idle OpenMP thread spins unless told otherwise; on a busy machine every parallel loop then waits for the
# scheduler (16 times slower, measured with one other process on two cores). It is read once, when numba
# starts its threads.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.contract import ROWS_LAST, Coefficients, Columns, Receivers, Sources, State

_FAST = {"contract", "reassoc", "nsz"}


@njit(parallel=True, fastmath=_FAST, cache=True, nogil=True)
def _sweep(p, q, center, face, edge, corner, keep):  # type: ignore[no-untyped-def]
    nx, ny, nz = p.shape
    for i in prange(1, nx - 1):
        beside = np.empty(nz, p.dtype)
        diagonal = np.empty(nz, p.dtype)
        for j in range(1, ny - 1):
            row, out = p[i, j], q[i, j]
            a, b, c, d = p[i - 1, j], p[i + 1, j], p[i, j - 1], p[i, j + 1]
            e, f, g, h = p[i - 1, j - 1], p[i - 1, j + 1], p[i + 1, j - 1], p[i + 1, j + 1]
            for k in range(nz):
                beside[k] = (a[k] + b[k]) + (c[k] + d[k])
                diagonal[k] = (e[k] + f[k]) + (g[k] + h[k])
            for k in range(1, nz - 1):
                out[k] = (
                    center * row[k]
                    + face * (beside[k] + (row[k - 1] + row[k + 1]))
                    + edge * (diagonal[k] + (beside[k - 1] + beside[k + 1]))
                    + corner * (diagonal[k - 1] + diagonal[k + 1])
                ) - keep * out[k]


@njit(parallel=True, fastmath=_FAST, cache=True, nogil=True)
def _varying(p, q, index, weight, offsets, keep, result):  # type: ignore[no-untyped-def]
    flat, old = p.ravel(), q.ravel()
    for n in prange(len(index)):
        cell = index[n]
        own = flat[cell]
        change = own - own
        for m in range(27):
            change += weight[n, m] * (flat[cell + offsets[m]] - own)
        result[n] = own + keep * (own - old[cell]) + change


@njit(fastmath=_FAST, cache=True, nogil=True)
def _stretch(u, psi, zeta, out, decay, gain):  # type: ignore[no-untyped-def]
    """Advance the memory of a layer whose cells are the rows of u (L + 2, n); add its term to out (L, n)."""
    here, ahead, outer = u[0], u[1], psi[0]
    for k in range(len(here)):
        outer[k] = decay[0] * outer[k] + gain[0] * (ahead[k] - here[k])
    for depth in range(1, len(u) - 1):
        behind, here, ahead = u[depth - 1], u[depth], u[depth + 1]
        outer, memory, shift, term = psi[depth - 1], psi[depth], zeta[depth - 1], out[depth - 1]
        b_cell, a_cell = decay[2 * depth - 1], gain[2 * depth - 1]
        b_half, a_half = decay[2 * depth], gain[2 * depth]
        for k in range(len(here)):
            difference = ahead[k] - here[k]
            memory[k] = b_half * memory[k] + a_half * difference
            slope = memory[k] - outer[k]
            shift[k] = b_cell * shift[k] + a_cell * (difference - (here[k] - behind[k]) + slope)
            term[k] += slope + shift[k]


@njit(fastmath=_FAST, cache=True, nogil=True)
def _smooth(out, row, a, b, face, edge, corner):  # type: ignore[no-untyped-def]
    """Add to a row the 9-point sum across: of the row itself and of those beside it."""
    for k in range(1, len(row) - 1):
        out[k] += (
            face * row[k]
            + edge * ((a[k] + b[k]) + (row[k - 1] + row[k + 1]))
            + corner * ((a[k - 1] + a[k + 1]) + (b[k - 1] + b[k + 1]))
        )


@njit(parallel=True, fastmath=_FAST, cache=True, nogil=True)
def _stretch_planes(p, layers, terms, decay, gain):  # type: ignore[no-untyped-def]
    """The layers' terms E_y p, E_z p and E_y E_z p, plane by plane."""
    (psi_y, zeta_y), (psi_z, zeta_z), (psi_yz, zeta_yz) = layers
    e_y, e_z, e_yz = terms
    cells = len(decay) // 2
    nx, ny, nz = p.shape
    for i in prange(1, nx - 1):
        rows = np.empty((cells + 2, nz), p.dtype)
        columns = np.empty((cells + 2, ny), p.dtype)
        ends = np.empty((cells + 2, 2 * cells), p.dtype)
        e_y[i], e_z[i], e_yz[i] = 0, 0, 0
        for side in range(2):
            for j in range(ny):
                for depth in range(cells + 2):
                    columns[depth, j] = p[i, j, nz - 1 - depth if side else depth]
            _stretch(columns, psi_z[side, i], zeta_z[side, i], e_z[i, side], decay, gain)
        for side in range(2):
            for depth in range(cells + 2):
                j = ny - 1 - depth if side else depth
                rows[depth] = p[i, j]
                for end in range(2):
                    for k in range(cells):
                        ends[depth, end * cells + k] = e_z[i, end, k, j]
            _stretch(rows, psi_y[side, i], zeta_y[side, i], e_y[i, side], decay, gain)
            _stretch(ends, psi_yz[side, i], zeta_yz[side, i], e_yz[i, side], decay, gain)


@njit(parallel=True, fastmath=_FAST, cache=True, nogil=True)
def _absorb_planes(q, terms, face, edge, corner):  # type: ignore[no-untyped-def]
    """Add the terms of the layers across y and z, smoothed across."""
    e_y, e_z, e_yz = terms
    cells = e_z.shape[2]
    nx, ny, nz = q.shape
    for i in prange(1, nx - 1):
        term = np.empty((cells, ny), q.dtype)
        for side in range(2):
            term[:] = 0
            for depth in range(cells):
                a, b = e_z[i - 1, side, depth], e_z[i + 1, side, depth]
                _smooth(term[depth], e_z[i, side, depth], a, b, face, edge, corner)
            for j in range(1, ny - 1):
                for depth in range(cells):
                    q[i, j, nz - 2 - depth if side else depth + 1] += term[depth, j]
            for depth in range(cells):
                out = q[i, ny - 2 - depth if side else depth + 1]
                a, b = e_y[i - 1, side, depth], e_y[i + 1, side, depth]
                _smooth(out, e_y[i, side, depth], a, b, face, edge, corner)
                own, a, b = e_yz[i, side, depth], e_yz[i - 1, side, depth], e_yz[i + 1, side, depth]
                for k in range(cells):
                    out[k + 1] += edge * own[k] + corner * (a[k] + b[k])
                    out[nz - 2 - k] += edge * own[cells + k] + corner * (a[cells + k] + b[cells + k])


@njit(parallel=True, fastmath=_FAST, cache=True, nogil=True)
def _absorb_x(p, q, psi, zeta, terms, decay, gain, face, edge, corner):  # type: ignore[no-untyped-def]
    """The layers across x, of the sum across it in which the layers of y and z are already stretched."""
    e_y, e_z, e_yz = terms
    cells = len(decay) // 2
    nx, ny, nz = p.shape
    for j in prange(1, ny - 1):
        u = np.empty((cells + 2, nz), p.dtype)
        term = np.empty((cells, nz), p.dtype)
        beside = min(j, ny - 1 - j) - 1
        for side in range(2):
            u[:] = 0
            term[:] = 0
            for depth in range(1, cells + 2):
                i, row = nx - 1 - depth if side else depth, u[depth]
                _smooth(row, p[i, j], p[i, j - 1], p[i, j + 1], face, edge, corner)
                if beside < cells:
                    e = e_y[i, int(2 * j > ny), beside]
                    for k in range(1, nz - 1):
                        row[k] += edge * e[k] + corner * (e[k - 1] + e[k + 1])
                    e = e_yz[i, int(2 * j > ny), beside]
                    for k in range(cells):
                        row[k + 1] += corner * e[k]
                        row[nz - 2 - k] += corner * e[cells + k]
                for k in range(cells):
                    low, high = e_z[i, 0, k], e_z[i, 1, k]
                    row[k + 1] += edge * low[j] + corner * (low[j - 1] + low[j + 1])
                    row[nz - 2 - k] += edge * high[j] + corner * (high[j - 1] + high[j + 1])
            _stretch(u, psi[side, j], zeta[side, j], term, decay, gain)
            for depth in range(cells):
                out = q[nx - 2 - depth if side else depth + 1, j]
                for k in range(nz):
                    out[k] += term[depth, k]


@njit(parallel=True, fastmath=_FAST, cache=True, nogil=True)
def _stretch_columns(p, columns, beside, place, memory, terms, decay, gain):  # type: ignore[no-untyped-def]
    """Advance the columns' memory and write their terms (L, m); `beside` has more to sum, by `place`."""
    (index, offset, weight), (psi, zeta) = columns, memory
    flat, more = p.ravel(), beside.ravel()
    for block in prange((len(index) + 63) // 64):
        first, last = 64 * block, min(64 * block + 64, len(index))
        u = np.zeros((len(psi) + 1, last - first), p.dtype)
        for n in range(first, last):
            for depth in range(1, len(u)):
                for m in range(weight.shape[1]):
                    u[depth, n - first] += weight[n, m] * flat[index[n, depth] + offset[n, m]]
                if place[n, depth] < len(more):
                    u[depth, n - first] += more[place[n, depth]]
        out = terms[:, first:last]
        out[:] = 0
        _stretch(u, psi[:, first:last], zeta[:, first:last], out, decay, gain)


@njit(cache=True, nogil=True)
def _advance(  # type: ignore[no-untyped-def]
    p,
    q,
    layers,
    terms,
    columns,
    memory,
    weights,
    varying,
    closed,
    profile,
    sources,
    receivers,
    signal,
    recorded,
):
    (decay, gain, scaled, scale), (driven, force), (heard, hearing) = profile, sources, receivers
    center, face, edge, corner, keep = weights
    index, weight, offsets, buffer = varying
    (psi, zeta), across = layers[0], layers[1:]
    (columns, crossed, crossing), (memory, crossed_memory) = columns, memory
    places, unlayered = columns[0], np.empty(len(scaled), p.dtype)
    shares, beside = np.zeros_like(memory[1]), np.zeros_like(crossed_memory[1])
    alone, nothing = np.zeros_like(crossed[0]), np.zeros((0, 0), p.dtype)
    for step in range(len(signal)):
        if len(index):
            _varying(p, q, index, weight, offsets, keep, buffer)
        _sweep(p, q, center, face, edge, corner, keep)
        flat = q.ravel()
        for n in range(len(index)):
            flat[index[n]] = buffer[n]
        for n in range(len(scaled)):
            unlayered[n] = flat[scaled[n]]
        _stretch_planes(p, across, terms, decay, gain)
        _absorb_planes(q, terms, face, edge, corner)
        _absorb_x(p, q, psi, zeta, terms, decay, gain, face, edge, corner)
        for n in range(len(scaled)):
            flat[scaled[n]] = unlayered[n] + scale[n] * (flat[scaled[n]] - unlayered[n])
        _stretch_columns(p, crossed, nothing, alone, crossed_memory, beside, decay, gain)
        _stretch_columns(p, columns, beside, crossing, memory, shares, decay, gain)
        for n in range(len(places)):
            for depth in range(len(shares)):
                flat[places[n, depth + 1]] += shares[depth, n]
        for n in range(len(driven)):
            flat[driven[n]] += force[n].real * signal[step, 0] + force[n].imag * signal[step, 1]
        for n in range(len(closed)):
            flat[closed[n]] = 0
        for r in range(len(heard)):
            total = 0.0
            for m in range(heard.shape[1]):
                total += hearing[r, m] * flat[heard[r, m]]
            recorded[step, r] = total
        p, q = q, p


def _no_terms(shape: torch.Size, cells: int, dtype: type) -> tuple[NDArray[np.floating], ...]:
    """Room for E_y p, E_z p and E_y E_z p by plane, side and depth; the last only has ends of rows."""
    nx, ny, nz = shape
    return tuple(np.zeros((nx, 2, cells, row), dtype) for row in (nz, ny, 2 * cells))


def _arrays(columns: Columns) -> tuple[NDArray[np.generic], ...]:
    return columns.index.numpy(), columns.offset.numpy(), columns.weight.numpy()


class CpuKernel:
    """See `kernels.contract`; updates the state in place."""

    def advance(
        self,
        state: State,
        coefficients: Coefficients,
        sources: Sources,
        receivers: Receivers,
        signal: torch.Tensor,
    ) -> tuple[State, torch.Tensor]:
        """See `Kernel.advance`."""
        c = coefficients
        dtype = c.varying_weight.numpy().dtype.type
        recorded = torch.empty((len(signal), len(receivers.index)), dtype=signal.dtype)
        strides = np.array(state.now.stride())
        offsets = (np.indices((3, 3, 3)).reshape(3, -1).T - 1) @ strides
        varying = (
            c.varying_index.numpy(),
            c.varying_weight.numpy(),
            offsets,
            np.empty(len(c.varying_index), dtype),
        )
        _advance(
            state.now.numpy(),
            state.before.numpy(),
            tuple(
                (psi.permute(order).numpy(), zeta.permute(order).numpy())
                for order, (psi, zeta) in zip(ROWS_LAST, state.layers, strict=True)
            ),
            _no_terms(state.now.shape, c.layer_cells, dtype),
            (_arrays(c.columns), _arrays(c.crossed), c.crossing.numpy()),
            tuple((psi.numpy(), zeta.numpy()) for psi, zeta in (state.columns, state.crossed)),
            (dtype(c.center), dtype(c.face), dtype(c.edge), dtype(c.corner), dtype(c.keep)),
            varying,
            c.closed_index.numpy(),
            (c.layer_decay.numpy(), c.layer_gain.numpy(), c.layer_index.numpy(), c.layer_scale.numpy()),
            # contiguous: for arrays with gaps numba compiles anew, and crashed when it loaded that from disk
            (sources.index.contiguous().numpy(), sources.force.contiguous().numpy()),
            (receivers.index.contiguous().numpy(), receivers.weight.contiguous().numpy()),
            signal.numpy(),
            recorded.numpy(),
        )
        now, before = (state.now, state.before) if len(signal) % 2 == 0 else (state.before, state.now)
        return State(now, before, state.layers, state.columns, state.crossed), recorded
