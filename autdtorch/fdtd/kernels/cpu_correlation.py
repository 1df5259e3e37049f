"""Derivatives by the varying cells' weights, summed over the steps: in numba, on all cores."""

from __future__ import annotations

from numba import njit, prange


@njit(parallel=True, cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def correlate(adjoint, field, index, offsets, place, total):  # type: ignore[no-untyped-def]
    """Add to `total` (n, 27) what lambda_i (p_j - p_i) sums up to over the steps.

    Of lambda (n, steps) in the cells `index` (n,) and p (k, steps) in these and their neighbours, at
    `offsets` (27,); `place` tells where a cell is in p.
    """
    for i in prange(len(index)):
        own = place[index[i]]
        for j in range(len(offsets)):
            other, product = place[index[i] + offsets[j]], total[i, j]
            for t in range(adjoint.shape[1]):
                product += adjoint[i, t] * (field[other, t] - field[own, t])
            total[i, j] = product
