"""The fits of transfer matrices to the readings of several trials, without outliers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch

from autdtorch.methods.magnitudes import Magnitudes, gross_outliers, range_ends
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior
from autdtorch.methods.phase_retrieval import retrieve

_KEPT = ("factors", "entries", "variance")  # of the posterior, from which the next fit goes on
_SCREENINGS = 8  # fits, each without what the one before shows to be outliers


class Fit(NamedTuple):
    """The posterior of a trial, and the readings as they were taken."""

    posterior: MatrixPosterior
    read: Magnitudes


def posteriors(
    prior: MatrixPrior | None,
    search: Mapping[str, torch.Tensor],
    drives: torch.Tensor,
    observed: torch.Tensor,
    generators: Sequence[torch.Generator],
    variance: torch.Tensor | None = None,
) -> list[Fit]:
    """Return the posteriors of T trials, given all their readings but outliers.

    Args:
        prior: of the matrix; None if nothing is known, for at least 3 M - 2 readings.
        search: what `kept` returned after fewer readings, if there were any.
        drives: (T, N, M).
        observed: magnitudes (T, N, P).
        generators: of the trials, for the first search without a prior.
        variance: of the magnitudes' noise (T, P) [Pa^2]; None to infer it.
    """
    found = []
    for trial, generator in enumerate(generators):
        # Copies: products of a part of a tensor may round by its place in memory.
        own, seen = drives[trial].clone(), observed[trial].clone()
        before = {
            name: search[name][trial].clone() for name in (*_KEPT, "spread", "outliers") if name in search
        }
        noise = None if variance is None else variance[trial]
        found.append(_screened(prior, before, own, seen, generator, noise))
    return found


def _screened(
    prior: MatrixPrior | None,
    before: Mapping[str, torch.Tensor],
    drives: torch.Tensor,
    observed: torch.Tensor,
    generator: torch.Generator,
    variance: torch.Tensor | None,
) -> Fit:
    """Return the posterior of a trial, fitted until the fit shows no further outlier."""
    ends = range_ends(drives, observed)
    outliers = torch.zeros_like(observed, dtype=torch.bool)
    if before:
        outliers[: len(before["outliers"])] = before["outliers"]
    elif prior is None:
        outliers = gross_outliers(observed)
    given = None if prior is None else prior.in_units_of(drives, observed)
    for _ in range(_SCREENINGS):
        read = Magnitudes.of(observed, outliers, ends)
        start = _start(given, before, drives, read, generator)
        if variance is not None:
            start = replace(start, variance=variance)
        fit = start.fitted(drives, read, infer_noise=variance is None)
        shown = fit.outliers(drives, read, observed)
        if torch.equal(shown, outliers):
            break
        outliers = shown
    return Fit(fit, read)


def _start(
    prior: MatrixPrior | None,
    before: Mapping[str, torch.Tensor],
    drives: torch.Tensor,
    read: Magnitudes,
    generator: torch.Generator,
) -> MatrixPosterior:
    """Return the posterior that a fit begins at: the one before, or where phase retrieval ends."""
    given = MatrixPrior.unknown(read, drives.shape[1]) if prior is None else prior
    if before:
        return MatrixPosterior(replace(given, spread=before["spread"]), *(before[name] for name in _KEPT))
    start = MatrixPosterior.start(given)
    if prior is not None:
        return start
    return replace(start, entries=retrieve(drives, read, generator).T / given.spread[:, None])


def kept(found: Sequence[Fit]) -> dict[str, torch.Tensor]:
    """Return tensors from which `posteriors` goes on."""
    tensors = {name: torch.stack([getattr(fit.posterior, name) for fit in found]) for name in _KEPT}
    return {
        **tensors,
        "spread": torch.stack([fit.posterior.prior.spread for fit in found]),
        "outliers": torch.stack([fit.read.outliers for fit in found]),
    }
