"""Phase retrieval: rows of a transfer matrix from the magnitudes that random drives make."""

from __future__ import annotations

import torch

from autdtorch.methods.magnitudes import Magnitudes
from autdtorch.utils.threads import one_library_thread

_GUESSES = 16  # rows from which the search for each row begins
_APART = 0.5  # random part of these rows, relative to the common part
_STEP = 0.7  # relaxation of the splitting; 1 takes half as many steps again
_SEARCH_STEPS = 300
_LONG_SEARCH_STEPS = 10_000  # with fewer than 3 M - 2 readings, unless all rows are found
_CHECKED = 100  # steps of a long search after which the rows are compared with the readings
_FOUND = 1e-3  # relative error of the readings, rms, of a row that is found
_FIT_STEPS = 100
_FAINT = 0.02  # intensity, relative to the mean, below which readings have the weight of this one


@one_library_thread()
def retrieve(drives: torch.Tensor, read: Magnitudes, generator: torch.Generator) -> torch.Tensor:
    """Return rows of the transfer matrix (M, P) that explain magnitudes (N, P) read for `drives` (N, M).

    Relaxed Douglas-Rachford splitting (Elser, SIAM J. Appl. Algebra Geometry 2 (2018) 150) seeks phasors that
    have the observed magnitudes and that some row produces, from spectral estimates of the rows. The rows are
    then fitted, and the best fit is taken.
    """
    inverse = torch.linalg.pinv(drives)
    short = len(drives) < 3 * drives.shape[1] - 2
    found = []
    for point in range(read.value.shape[1]):
        magnitude = read.column(point)
        rows = _searched(drives, inverse, magnitude, short, generator)
        rows = _fit(drives, inverse, magnitude, rows)
        found.append(rows[:, _misfit(drives, magnitude, rows).argmin()])
    return torch.stack(found, dim=1)


def _searched(
    drives: torch.Tensor,
    inverse: torch.Tensor,
    read: Magnitudes,
    short: bool,
    generator: torch.Generator,
) -> torch.Tensor:
    """Return candidates (M, K) for a row that explains magnitudes (N, 1), after a long search if `short`."""
    start = _spectral(drives, read)[:, None]
    guesses = torch.randn((len(start), _GUESSES), dtype=torch.complex128, generator=generator, device="cpu")
    phasors = drives @ (start + _APART * start.norm() / guesses.norm(dim=0) * guesses)
    enough = _FOUND**2 * read.value.square().sum()
    for step in range(_LONG_SEARCH_STEPS if short else _SEARCH_STEPS):
        right = read.nearest(phasors.abs()) * phasors.sgn()
        phasors = phasors + _STEP * (drives @ (inverse @ (2 * right - phasors)) - right)
        if step % _CHECKED == 0 and (_misfit(drives, read, inverse @ phasors) <= enough).any():
            break
    rows: torch.Tensor = inverse @ phasors
    return rows


def _spectral(drives: torch.Tensor, read: Magnitudes) -> torch.Tensor:
    """Return the estimate (M,) of a row from magnitudes (N, 1): the main direction of loud drives.

    The weights 1 - 1 / intensity find a direction from the fewest readings (Mondelli and Montanari, Found.
    Comput. Math. 19 (2019) 703).
    """
    intensity, least = read.value[:, 0].square(), torch.finfo(read.value.dtype).tiny
    relative = intensity / read.power.clamp(min=least)
    weight = (1 - 1 / relative.clamp(min=_FAINT)).masked_fill(read.outliers[:, 0], 0)
    direction: torch.Tensor = torch.linalg.eigh((drives.mH * weight) @ drives).eigenvectors[:, -1]
    row: torch.Tensor = direction * (read.value.norm() / (drives @ direction).norm().clamp(min=least))
    return row


def _fit(drives: torch.Tensor, inverse: torch.Tensor, read: Magnitudes, rows: torch.Tensor) -> torch.Tensor:
    """Return least-squares fits (M, K) of rows to magnitudes (N, 1): phases and rows in turn."""
    for _ in range(_FIT_STEPS):
        phasors = drives @ rows
        rows = inverse @ (read.nearest(phasors.abs()) * phasors.sgn())
    return rows


def _misfit(drives: torch.Tensor, read: Magnitudes, rows: torch.Tensor) -> torch.Tensor:
    """Return the sum of squares (K,) of what rows (M, K) leave of magnitudes (N, 1)."""
    magnitude = (drives @ rows).abs()
    return (magnitude - read.nearest(magnitude)).square().sum(dim=0)
