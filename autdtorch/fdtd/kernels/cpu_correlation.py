"""Derivatives by stencil rows, summed over the steps, on one core."""

from __future__ import annotations

from autdtorch.fdtd.kernels.compiled import entry


@entry(fastmath={"reassoc", "nsz"})  # vectorises sums of products; nothing that could be inlined is called
def correlate(first, last, adjoint, field, index, offsets, place, total):  # type: ignore[no-untyped-def]
    """Add sums of lambda_i (p_j - p_i) over the steps to rows `first` to `last` of `total` (n, 27).

    `adjoint` is lambda (n, steps) in the cells `index` (n,), `field` is p (k, steps) in these and their
    neighbours at `offsets` (27,). `place` is the row of a cell in `field`.
    """
    for i in range(first, last):
        own = place[index[i]]
        for j in range(len(offsets)):
            other, product = place[index[i] + offsets[j]], total[i, j]
            for t in range(adjoint.shape[1]):
                product += adjoint[i, t] * (field[other, t] - field[own, t])
            total[i, j] = product
