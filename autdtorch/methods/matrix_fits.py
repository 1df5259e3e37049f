"""The fits of transfer matrices to the readings of several trials, without outliers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from autdtorch.methods.magnitudes import Magnitudes, gross_outliers, range_ends, reads_finely
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior
from autdtorch.methods.phase_retrieval import retrieve

_KEPT = ("factors", "entries", "variance")  # of the posterior, from which the next fit goes on
_SCREENINGS = 8  # fits, each without what the one before shows to be outliers
_BETTER = (
    0.5  # deviation of readings from the fit that takes the highest as limits, in those of one that does not
)


class Fit(NamedTuple):
    """The posterior of a trial, and the readings as they were taken.

    Attributes:
        posterior: of the matrix.
        read: magnitudes (N, P), of which some are outliers or limits.
        ends: where the range of each sensor ends (P,) [Pa]; infinite where it was not reached.
    """

    posterior: MatrixPosterior
    read: Magnitudes
    ends: torch.Tensor


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
        given = None if prior is None else prior.in_units_of(own, seen)
        noise = None if variance is None else variance[trial]
        found.append(_Trial(given, before, own, seen, generator, noise).fit())
    return found


@dataclass(frozen=True, eq=False)
class _Trial:
    """All that the fit of a trial begins with; see `posteriors`."""

    prior: MatrixPrior | None
    before: Mapping[str, torch.Tensor]
    drives: torch.Tensor
    observed: torch.Tensor
    generator: torch.Generator
    variance: torch.Tensor | None

    def fit(self) -> Fit:
        """Return the fit without outliers, where readings at the end of a sensor's range are limits.

        A sensor that reads in coarse steps has equal highest readings near the best drive, too. These fit
        like all others; readings at the end of a range spoil a fit that does not take them as limits.
        """
        ends = range_ends(self.drives, self.observed)
        found = self._screened(ends, None)
        unsure = ends.isfinite() & ~reads_finely(self.observed, ends)
        if not unsure.any():
            return found
        plain = self._screened(ends.masked_fill(unsure, torch.inf), found.posterior.matrix)
        rest, plain_rest = (own.posterior.deviations(self.drives, own.read) for own in (found, plain))
        ends = ends.masked_fill(unsure & (rest > _BETTER * plain_rest), torch.inf)
        for fit in (found, plain):
            if torch.equal(ends, fit.ends):
                return fit
        return self._screened(ends, plain.posterior.matrix)

    def _screened(self, ends: torch.Tensor, matrix: torch.Tensor | None) -> Fit:
        """Return the fit that shows no further outlier; the first begins at a matrix (P, M), if any."""
        outliers = torch.zeros_like(self.observed, dtype=torch.bool)
        if self.before:
            outliers[: len(self.before["outliers"])] = self.before["outliers"]
        elif self.prior is None:
            outliers = gross_outliers(self.observed)
        for _ in range(_SCREENINGS):
            read = Magnitudes.of(self.observed, outliers, ends)
            start = self._start(read, matrix)
            if self.variance is not None:
                start = replace(start, variance=self.variance)
            fit = start.fitted(self.drives, read, infer_noise=self.variance is None)
            shown, matrix = fit.outliers(self.drives, read, self.observed), fit.matrix
            if torch.equal(shown, outliers):
                break
            outliers = shown
        return Fit(fit, read, ends)

    def _start(self, read: Magnitudes, matrix: torch.Tensor | None) -> MatrixPosterior:
        """Return the posterior that a fit begins at: with neither one before nor a prior, that of a matrix.

        Without a matrix, it is that of phase retrieval, which takes longer than all the rest.
        """
        prior = self.prior or MatrixPrior.unknown(read, self.drives.shape[1])
        if before := self.before:
            known = replace(prior, spread=before["spread"])
            return MatrixPosterior(known, *(before[name] for name in _KEPT))
        start = MatrixPosterior.start(prior)
        if self.prior is not None:
            return start
        rows = retrieve(self.drives, read, self.generator).T if matrix is None else matrix
        return replace(start, entries=rows / prior.spread[:, None])


def kept(found: Sequence[Fit]) -> dict[str, torch.Tensor]:
    """Return tensors from which `posteriors` goes on."""
    tensors = {name: torch.stack([getattr(fit.posterior, name) for fit in found]) for name in _KEPT}
    return {
        **tensors,
        "spread": torch.stack([fit.posterior.prior.spread for fit in found]),
        "outliers": torch.stack([fit.read.outliers for fit in found]),
        "ends": torch.stack([fit.ends for fit in found]),
    }
