"""Identification: fit the transfer matrix to observed magnitudes, then maximise on the matrix.

The pressure of a control point is linear in the drive, so that enough magnitudes determine its row of the
transfer matrix, but for a phase that no magnitude shows (docs/decisions/identify.md).
"""

from __future__ import annotations

from dataclasses import replace

import torch

from autdtorch.methods.base import Ledger, Solution, Trials, trial_seeds
from autdtorch.methods.gradient import climb, random_drives
from autdtorch.objectives.perturbations import playable
from autdtorch.objectives.simulated import Objective, weakest_focus
from autdtorch.utils.threads import one_torch_thread
from autdtorch.utils.validation import integer_at_least, invalid

_GUESSES = 16  # rows from which the search for each row begins
_SEARCH_STEPS = 300
_FIT_STEPS = 100
_STARTS = 16  # drives from which the fitted matrix is climbed
_CLIMB_STEPS = 300
_ROUNDS = 3  # times that the fit is refined by drives near the best one
_SPREAD = 0.5  # their distance from it, standard deviation of the phases [rad]


def identify(objective: Objective, evaluations: int = 64, trials: Trials = 1, seed: int = 0) -> Solution:
    """Fit the transfer matrix to observed magnitudes, and maximise the weakest focus on the matrix.

    The first max(3 M - 2, evaluations / 2) drives have random phases. The others are spread around the best
    drive of the matrix fitted so far, in rounds, each after a new fit: there noise must average out. The last
    one is the best drive of the last fit.

    Args:
        objective: what is evaluated.
        evaluations: number of evaluations a trial, >= 3 M - 1; more of them average noise.
        trials: number of trials T, >= 1, or their numbers.
        seed: of the random phases, >= 0; trial t is the same for every number of trials.

    Returns:
        The last drive of each trial; with noise it is better than the one of the highest reading.

    Raises:
        ValueError: an argument out of range, or the objective's pressures are not finite.
    """
    generators = [torch.Generator("cpu").manual_seed(own) for own in trial_seeds(seed, trials)]
    ledger = Ledger(objective, len(generators), weakest_focus)
    transducers = ledger.transducers
    evaluations = integer_at_least("evaluations", evaluations, 1)
    if evaluations < 3 * transducers - 1:
        raise invalid(
            "evaluations",
            evaluations,
            f"must be an integer >= {3 * transducers - 1}, to identify {transducers} transducers",
        )
    ledger.require_memory(evaluations, 2.0 * evaluations, evaluations=evaluations)
    first = max(3 * transducers - 2, evaluations // 2)
    drives = playable(objective, torch.stack([random_drives(first, transducers, own) for own in generators]))
    observed = ledger.observe(drives)
    rows = [_search(*seen) for seen in zip(drives, observed, generators, strict=True)]
    best = _strongest(rows, generators)
    left = evaluations - first - 1
    for rounds in range(_ROUNDS, 0, -1):
        count = left // rounds
        left -= count
        if count == 0:
            continue
        spread = [_nearby(*of, count) for of in zip(best, generators, strict=True)]
        near = playable(objective, torch.stack(spread))
        drives = torch.cat([drives, near], dim=1)
        observed = torch.cat([observed, ledger.observe(near)], dim=1)
        rows = [_fit(*seen) for seen in zip(drives, observed, rows, strict=True)]
        best = _strongest(rows, generators)
    pressure = ledger.observe(best[:, None])[:, 0]
    # Not the highest reading: among many noisy ones that is a lucky one.
    chosen = playable(objective, best)
    return replace(ledger.solution(), drive=chosen, pressure=pressure, score=weakest_focus(pressure))


@one_torch_thread()
def _search(drives: torch.Tensor, observed: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Rows of the transfer matrix (M, P) that explain magnitudes (N, P) observed under `drives` (N, M).

    Phasors that have the observed magnitudes and that some row produces are sought by Douglas-Rachford
    splitting, which leaves the local minima that trap a fit; then they are fitted. The best fit is taken.
    """
    transducers, foci = drives.shape[1], observed.shape[1]
    guesses = torch.randn(
        transducers, foci * _GUESSES, dtype=torch.complex128, generator=generator, device="cpu"
    )
    magnitudes = observed.repeat_interleave(_GUESSES, dim=1)
    inverse = torch.linalg.pinv(drives)
    phasors = drives @ guesses
    for _ in range(_SEARCH_STEPS):
        right = magnitudes * phasors.sgn()
        phasors = phasors + drives @ (inverse @ (2 * right - phasors)) - right
    rows = _fit(drives, magnitudes, inverse @ phasors)
    misfit = ((drives @ rows).abs() - magnitudes).square().sum(dim=0).reshape(foci, _GUESSES)
    return rows.reshape(transducers, foci, _GUESSES)[
        :, torch.arange(foci, device="cpu"), misfit.argmin(dim=1)
    ]


@one_torch_thread()
def _fit(drives: torch.Tensor, observed: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Least-squares fit of rows (M, K) to magnitudes (N, K), from `rows` on: phases and rows in turn."""
    inverse = torch.linalg.pinv(drives)
    for _ in range(_FIT_STEPS):
        rows = inverse @ (observed * (drives @ rows).sgn())
    return rows


def _strongest(rows: list[torch.Tensor], generators: list[torch.Generator]) -> torch.Tensor:
    """The drive (T, M) of the strongest weakest focus, by each trial's rows (M, P)."""
    drives = [
        climb(own.T, random_drives(_STARTS, len(own), generator), _CLIMB_STEPS)
        for own, generator in zip(rows, generators, strict=True)
    ]
    return torch.stack(drives)


def _nearby(drive: torch.Tensor, generator: torch.Generator, count: int) -> torch.Tensor:
    """The `drive` (M,) itself, and count - 1 others around it."""
    turns = _SPREAD * torch.randn(count, len(drive), dtype=torch.float64, generator=generator, device="cpu")
    turns[0] = 0
    return drive * torch.polar(torch.ones_like(turns), turns)
