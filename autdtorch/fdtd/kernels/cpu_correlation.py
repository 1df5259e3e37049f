"""Derivatives by the heterogeneous cells' weights, summed over the steps, on one core."""

from __future__ import annotations

from autdtorch.fdtd.kernels.compiled import entry


@entry(fastmath={"reassoc", "nsz"})  # sums of products fill vectors; nothing is called that could be inlined
def correlate(first, last, adjoint, field, index, offsets, place, total):  # type: ignore[no-untyped-def]
    """Add to rows `first` to `last` of `total` (n, 27) what lambda_i (p_j - p_i) sums up to over the steps.

    Of lambda (n, steps) in the cells `index` (n,) and p (k, steps) in these and their neighbours, at
    `offsets` (27,); `place` tells where a cell is in p.
    """
    for i in range(first, last):
        own = place[index[i]]
        for j in range(len(offsets)):
            other, product = place[index[i] + offsets[j]], total[i, j]
            for t in range(adjoint.shape[1]):
                product += adjoint[i, t] * (field[other, t] - field[own, t])
            total[i, j] = product
