"""Phase retrieval: rows of a transfer matrix from the magnitudes that random drives make."""

from __future__ import annotations

import torch

from autdtorch.utils.threads import one_torch_thread

_GUESSES = 16  # rows from which the search for each row begins
_SEARCH_STEPS = 300
_LONG_SEARCH_STEPS = 10_000  # with fewer than 3 M - 2 readings, unless all rows are found
_CHECKED = 500  # steps of a long search after which the rows are compared with the readings
_FOUND = 1e-3  # relative error of the readings, rms, of a row that is found
_FIT_STEPS = 100


@one_torch_thread()
def retrieve(drives: torch.Tensor, observed: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return rows of the transfer matrix (M, P) that explain magnitudes (N, P) observed for `drives` (N, M).

    Douglas-Rachford splitting seeks phasors that have the observed magnitudes and that some row produces. It
    leaves the local minima that trap a fit, after many steps where readings are few. The rows are then
    fitted, and the best fit is taken.
    """
    transducers, foci = drives.shape[1], observed.shape[1]
    size = transducers, foci * _GUESSES
    guesses = torch.randn(size, dtype=torch.complex128, generator=generator, device="cpu")
    magnitudes = observed.repeat_interleave(_GUESSES, dim=1)
    inverse = torch.linalg.pinv(drives)
    phasors = drives @ guesses
    steps = _SEARCH_STEPS if len(drives) >= 3 * transducers - 2 else _LONG_SEARCH_STEPS
    for step in range(1, steps + 1):
        right = magnitudes * phasors.sgn()
        phasors = phasors + drives @ (inverse @ (2 * right - phasors)) - right
        if step % _CHECKED == 0:
            left = _misfit(drives, magnitudes, inverse @ phasors).reshape(foci, -1).amin(dim=1)
            if (left <= _FOUND**2 * observed.square().sum(dim=0)).all():
                break
    rows = _fit(drives, magnitudes, inverse @ phasors)
    misfit = _misfit(drives, magnitudes, rows).reshape(foci, _GUESSES)
    every = torch.arange(foci, device="cpu")
    return rows.reshape(transducers, foci, _GUESSES)[:, every, misfit.argmin(dim=1)]


@one_torch_thread()
def _fit(drives: torch.Tensor, observed: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return the least-squares fit of rows (M, K) to magnitudes (N, K): phases and rows in turn."""
    inverse = torch.linalg.pinv(drives)
    for _ in range(_FIT_STEPS):
        rows = inverse @ (observed * (drives @ rows).sgn())
    return rows


def _misfit(drives: torch.Tensor, magnitudes: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return the sum of squares (K,) of what rows (M, K) leave of magnitudes (N, K)."""
    return ((drives @ rows).abs() - magnitudes).square().sum(dim=0)
