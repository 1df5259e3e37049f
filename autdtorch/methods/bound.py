"""A certified upper bound on the weakest focus over all drives (docs/decisions/bound.md).

The bound holds for any weights w >= 0 of the P foci with sum 1 and any z > 0 of the M transducers. For all
drives |q_i| <= 1,

    min_p |(G q)_p| <= |W G q| <= |W G / Z| |Z q| <= |W G / Z| |z|,    W = diag(sqrt(w)), Z = diag(z),

with the spectral norm of the matrix. The minimum of the right side is the value of the semidefinite
relaxation, whose dual this is. If the search ends a little above the minimum, the bound still holds.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from autdtorch.utils.validation import ArrayLike, complex_tensor

#: Orders of Schatten norms that approach the spectral norm, which has kinks at its minima.
_ORDERS = (8, 64, 512, 4096, 32768)

#: Smallest weight, relative to its start: no step of the search may end where all weights are 0.
_LEAST_WEIGHT = 1e-12

#: Relative margin on top of the bound; rounding of the bound and of a pressure is below 1e-13.
_MARGIN = 1e-12

_Reals: TypeAlias = NDArray[np.float64]
_Complexes: TypeAlias = NDArray[np.complex128]


def focus_bound(G: ArrayLike) -> float:
    """Return an upper bound on the pressure of the weakest focus over all drives.

    Args:
        G: transfer matrix (P, M), complex [Pa].

    Returns:
        Bound [Pa] on min_p |(G q)_p| over all drives q of amplitudes <= 1, within about 1e-5 of the
        semidefinite relaxation.

    Raises:
        ValueError: not finite complex numbers, or not (P, M) with P, M >= 1.
    """
    matrix = complex_tensor("G", G).detach().cpu().numpy()
    if matrix.ndim != 2 or matrix.size == 0:
        raise ValueError(f"G: shape {matrix.shape}; must be (P, M) with P, M >= 1")
    alone = np.abs(matrix).sum(axis=1)  # pressure that each focus reaches alone
    if alone.min() == 0:
        return 0.0
    importance = (alone.min() / alone) ** 2  # of each focus, scaled against overflow
    rows = (matrix / alone[:, None])[:, np.abs(matrix).max(axis=0) > 0]
    x = np.concatenate([np.ones(len(rows)), np.log(np.linalg.norm(rows, axis=0))])
    for order in _ORDERS:
        x = scipy.optimize.minimize(
            _log_bound,
            x,
            args=(rows, importance, order),
            jac=True,
            method="L-BFGS-B",
            bounds=[(_LEAST_WEIGHT, None)] * len(rows) + [(None, None)] * rows.shape[1],
            options={"maxcor": 40, "maxiter": 2000, "ftol": 1e-14, "gtol": 1e-10},
        ).x
    return float(alone.min() * np.exp(_log_bound(x, rows, importance, np.inf)[0]) * (1 + _MARGIN))


def _log_bound(x: _Reals, rows: _Complexes, importance: _Reals, order: float) -> tuple[float, _Reals]:
    """Return the logarithm of the bound over the least of `alone`, and its gradient.

    The Schatten norm of this `order` replaces the spectral norm.

    Args:
        x: the weights w over `importance`, then log z (P + M,).
        rows: transfer matrix (P, M), its rows divided by `alone`.
        importance: (min(alone) / alone)^2 (P,).
        order: >= 2; infinite for the spectral norm.
    """
    weights, log_z = np.split(x, [len(rows)])
    z = np.exp(log_z - log_z.max())
    columns = rows / z
    _, singular, right = np.linalg.svd(np.sqrt(weights)[:, None] * columns, full_matrices=False)
    ratios = singular / singular[0]
    norm = np.linalg.norm(ratios, order)
    mean = weights @ importance
    log_bound = np.log(singular[0] * norm * np.linalg.norm(z)) - np.log(mean) / 2

    # Derivative of the logarithm of the norm by the squares of the singular values
    growth = (ratios / norm) ** (order - 2) / (singular[0] * norm) ** 2 / 2
    slope_weights = np.abs(columns @ right.conj().T) ** 2 @ growth - importance / mean / 2
    slope_log_z = z**2 / np.sum(z**2) - 2 * (growth * singular**2) @ np.abs(right) ** 2
    return float(log_bound), np.concatenate([slope_weights, slope_log_z])
