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

from autdtorch.fdtd.kernels.contract import Coefficients, Receivers, Sources, State

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
def _damp_row(u, depth, memory, outer, shift, out, decay, gain):  # type: ignore[no-untyped-def]
    """Advance the memory of one row at `depth` cells inside a layer and add its term to the row `out`."""
    behind, here, ahead = u[depth - 1], u[depth], u[depth + 1]
    b_cell, a_cell = decay[2 * depth - 1], gain[2 * depth - 1]
    b_half, a_half = decay[2 * depth], gain[2 * depth]
    for k in range(1, len(here) - 1):
        difference = ahead[k] - here[k]
        memory[k] = b_half * memory[k] + a_half * difference
        slope = memory[k] - outer[k]
        shift[k] = b_cell * shift[k] + a_cell * (difference - (here[k] - behind[k]) + slope)
        out[k] += slope + shift[k]


@njit(fastmath=_FAST, cache=True, nogil=True)
def _damp_outermost(u, memory, decay, gain):  # type: ignore[no-untyped-def]
    """Advance the memory of the half cell between a layer and the ring."""
    here, ahead = u[0], u[1]
    for k in range(1, len(here) - 1):
        memory[k] = decay[0] * memory[k] + gain[0] * (ahead[k] - here[k])


@njit(parallel=True, fastmath=_FAST, cache=True, nogil=True)
def _absorb_rows(p, q, axis, psi, zeta, decay, gain, face, edge, corner):  # type: ignore[no-untyped-def]
    """The two boundary layers across x (axis 0) or y (axis 1)."""
    cells, nz, last = len(decay) // 2, p.shape[2], p.shape[axis] - 1
    for t in prange(1, p.shape[1 - axis] - 1):
        u = np.zeros((cells + 2, nz), p.dtype)
        beside = np.empty(nz, p.dtype)
        for side in range(2):
            for depth in range(1, cells + 2):
                n = last - depth if side else depth
                row = p[n, t] if axis == 0 else p[t, n]
                a = p[n, t - 1] if axis == 0 else p[t - 1, n]
                b = p[n, t + 1] if axis == 0 else p[t + 1, n]
                for k in range(nz):
                    beside[k] = a[k] + b[k]
                _smooth_row(u[depth], row, beside, face, edge, corner)
            _damp_outermost(u, psi[side, 0, t] if axis == 0 else psi[side, t, 0], decay, gain)
            for depth in range(1, cells + 1):
                n = last - depth if side else depth
                if axis == 0:
                    _damp_row(
                        u,
                        depth,
                        psi[side, depth, t],
                        psi[side, depth - 1, t],
                        zeta[side, depth - 1, t],
                        q[n, t],
                        decay,
                        gain,
                    )
                else:
                    _damp_row(
                        u,
                        depth,
                        psi[side, t, depth],
                        psi[side, t, depth - 1],
                        zeta[side, t, depth - 1],
                        q[t, n],
                        decay,
                        gain,
                    )


@njit(fastmath=_FAST, cache=True, nogil=True)
def _smooth_row(u, row, beside, face, edge, corner):  # type: ignore[no-untyped-def]
    """Write the 9-point sum across a layer's axis into u, from a row and the sum of the rows beside it."""
    for k in range(1, len(row) - 1):
        u[k] = (
            face * row[k]
            + edge * (beside[k] + (row[k - 1] + row[k + 1]))
            + corner * (beside[k - 1] + beside[k + 1])
        )


@njit(parallel=True, fastmath=_FAST, cache=True, nogil=True)
def _absorb_ends(p, q, psi, zeta, decay, gain, face, edge, corner):  # type: ignore[no-untyped-def]
    """The two boundary layers across z: the ends of all rows, turned so that rows run along y."""
    cells = len(decay) // 2
    nx, ny, nz = p.shape
    for i in prange(1, nx - 1):
        own = np.empty((cells + 2, ny), p.dtype)
        sides = np.empty((cells + 2, ny), p.dtype)
        u = np.zeros((cells + 2, ny), p.dtype)
        term = np.empty((cells + 1, ny), p.dtype)
        for side in range(2):
            for j in range(ny):
                row, a, b = p[i, j], p[i - 1, j], p[i + 1, j]
                for depth in range(1, cells + 2):
                    k = nz - 1 - depth if side else depth
                    own[depth, j] = row[k]
                    sides[depth, j] = a[k] + b[k]
            for depth in range(1, cells + 2):
                _smooth_row(u[depth], own[depth], sides[depth], face, edge, corner)
            _damp_outermost(u, psi[side, i, 0], decay, gain)
            term[:] = 0
            for depth in range(1, cells + 1):
                _damp_row(
                    u,
                    depth,
                    psi[side, i, depth],
                    psi[side, i, depth - 1],
                    zeta[side, i, depth - 1],
                    term[depth],
                    decay,
                    gain,
                )
            for j in range(1, ny - 1):
                out = q[i, j]
                for depth in range(1, cells + 1):
                    k = nz - 1 - depth if side else depth
                    out[k] += term[depth, j]


@njit(cache=True, nogil=True)
def _advance(  # type: ignore[no-untyped-def]
    p, q, layers, weights, varying, decay, gain, driven, force, heard, hearing, signal, recorded
):
    center, face, edge, corner, keep = weights
    index, weight, offsets, buffer = varying
    (psi_x, zeta_x), (psi_y, zeta_y), (psi_z, zeta_z) = layers
    for step in range(len(signal)):
        if len(index):
            _varying(p, q, index, weight, offsets, keep, buffer)
        _sweep(p, q, center, face, edge, corner, keep)
        flat = q.ravel()
        for n in range(len(index)):
            flat[index[n]] = buffer[n]
        _absorb_rows(p, q, 0, psi_x, zeta_x, decay, gain, face, edge, corner)
        _absorb_rows(p, q, 1, psi_y, zeta_y, decay, gain, face, edge, corner)
        _absorb_ends(p, q, psi_z, zeta_z, decay, gain, face, edge, corner)
        for n in range(len(driven)):
            flat[driven[n]] += force[n].real * signal[step, 0] + force[n].imag * signal[step, 1]
        for r in range(len(heard)):
            total = 0.0
            for m in range(heard.shape[1]):
                total += hearing[r, m] * flat[heard[r, m]]
            recorded[step, r] = total
        p, q = q, p


def _rows_last(memory: torch.Tensor, axis: int) -> NDArray[np.floating]:
    """Memory of an axis with that axis never last, contiguous in the layout of `uniform_state`."""
    return (memory.transpose(2, 3) if axis == 2 else memory).numpy()


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
                (_rows_last(psi, axis), _rows_last(zeta, axis))
                for axis, (psi, zeta) in enumerate(state.layers)
            ),
            (dtype(c.center), dtype(c.face), dtype(c.edge), dtype(c.corner), dtype(c.keep)),
            varying,
            c.layer_decay.numpy(),
            c.layer_gain.numpy(),
            sources.index.numpy(),
            sources.force.numpy(),
            receivers.index.numpy(),
            receivers.weight.numpy(),
            signal.numpy(),
            recorded.numpy(),
        )
        now, before = (state.now, state.before) if len(signal) % 2 == 0 else (state.before, state.now)
        return State(now, before, state.layers), recorded
