"""The fit of transfer matrices to readings without outliers, from phase retrieval or from a prior on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch

from autdtorch.methods.doubtful_readings import Magnitudes, gross_outliers, range_ends, reads_finely
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior
from autdtorch.objectives.readings import Readings
from autdtorch.utils.process import one_library_thread

_OF_POSTERIOR = ("factors", "entries", "variance")  # its tensors, from which the next fit goes on
_SCREENINGS = 8  # fits, each without the outliers that the one before shows
_BETTER = 0.5  # largest ratio of the deviations with and without limits at which limits are believed

_GUESSES = 16  # rows from which the search for each row begins
_LEAST_READINGS = 2.3  # for each transducer, so that a long search finds the row
_APART = 0.5  # random part of these rows, relative to the common part
_RELAXATION = 0.7  # of the splitting; 1 takes half as many steps again
_SEARCHED = 500  # readings for each transducer, at most; the fit that follows has all
_SEARCH_STEPS = 300
_LONG_SEARCH_STEPS = 1000  # with fewer than 3 M - 2 readings, unless all are explained; 10,000 find as many
_CHECKED = 100  # steps of a long search after which the rows are compared with the readings
_EXPLAINED = 1e-3  # relative error of the readings, rms, at which a row explains them
_LEAST_SQUARES_STEPS = 100
_FAINT = 0.02  # least intensity in the weights of readings, relative to the mean


class MatrixFit(NamedTuple):
    """The posterior of a trial, and the readings as they were taken.

    Attributes:
        posterior: of the matrix.
        read: magnitudes (N, P), of which some are outliers or limits.
        ends: end of each sensor's range (P,) [Pa]; infinite where it was not reached.
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
    deviation: torch.Tensor | None = None,
) -> list[MatrixFit]:
    """Return the posteriors of T trials by all their readings but outliers.

    Args:
        prior: of the matrix; None if nothing is known, for at least 3 M - 2 readings.
        search: tensors of `tensors_of` after fewer readings, if there were any.
        drives: (T, N, M).
        observed: magnitudes (T, N, P); NaN is a gap, which is taken like an outlier.
        generators: of the trials, for the first search without a prior.
        variance: of the magnitudes' noise (T, P) [Pa^2]; None to infer it.
        deviation: of the magnitudes (T, N, P) [Pa], as `Readings.deviation`; None if unknown.
    """
    fits = []
    for trial, generator in enumerate(generators):
        # Copies: products of a part of a tensor may round by its place in memory.
        played, seen = drives[trial].clone(), observed[trial].clone()
        names = [name for name in (*_OF_POSTERIOR, "spread", "outliers") if name in search]
        before = {name: search[name][trial].clone() for name in names}
        scaled = None if prior is None else prior.in_units_of(played, seen)
        noise = None if variance is None else variance[trial]
        errors = None if deviation is None else deviation[trial].clone()
        fits.append(TrialReadings(scaled, before, played, seen, generator, noise, deviation=errors).fit())
    return fits


def least_readings(transducers: int) -> int:
    """Return the number of readings at a point by which a row of the matrix is found without a prior."""
    return min(3 * transducers - 2, math.ceil(_LEAST_READINGS * transducers))


def tensors_of(fits: Sequence[MatrixFit]) -> dict[str, torch.Tensor]:
    """Return tensors from which `posteriors` goes on."""
    tensors = {name: torch.stack([getattr(fit.posterior, name) for fit in fits]) for name in _OF_POSTERIOR}
    return {
        **tensors,
        "spread": torch.stack([fit.posterior.prior.spread for fit in fits]),
        "outliers": torch.stack([fit.read.outliers for fit in fits]),
        "ends": torch.stack([fit.ends for fit in fits]),
    }


@dataclass(frozen=True, eq=False)
class TrialReadings:
    """The data of a trial's fit; see `posteriors`.

    The generator is for the first search without a prior. The phases of the pressures (N, P) [rad] are
    fitted, too, where they are read. Readings count by their deviations (N, P) [Pa], where these are known.
    """

    prior: MatrixPrior | None
    before: Mapping[str, torch.Tensor]
    drives: torch.Tensor
    observed: torch.Tensor
    generator: torch.Generator = field(default_factory=torch.Generator)
    variance: torch.Tensor | None = None
    phase: torch.Tensor | None = None
    deviation: torch.Tensor | None = None

    @classmethod
    def of(cls, prior: MatrixPrior, before: Mapping[str, torch.Tensor], readings: Readings) -> TrialReadings:
        """Return the trial of readings, with all that they state."""
        parts = readings.drives, readings.pressure
        return cls(prior, before, *parts, phase=readings.phase, deviation=readings.deviation)

    def fit(self) -> MatrixFit:
        """Return the fit without outliers, where readings at the end of a sensor's range are limits.

        A sensor that reads in coarse steps has equal highest readings near the best drive, too. These fit
        like all others; readings at the end of a range spoil a fit that does not take them as limits.
        """
        ends = range_ends(self.drives, self.observed)
        limited = self._screened(ends, None)
        unsure = ends.isfinite() & ~reads_finely(self.observed, ends)
        if not unsure.any():
            return limited
        plain = self._screened(ends.masked_fill(unsure, torch.inf), limited.posterior.matrix)
        rest, plain_rest = (fit.posterior.deviations(self.drives, fit.read) for fit in (limited, plain))
        ends = ends.masked_fill(unsure & (rest > _BETTER * plain_rest), torch.inf)
        for fit in (limited, plain):
            if torch.equal(ends, fit.ends):
                return fit
        return self._screened(ends, plain.posterior.matrix)

    def _screened(self, ends: torch.Tensor, matrix: torch.Tensor | None) -> MatrixFit:
        """Return the fit that shows no further outlier; the first begins at a matrix (P, M), if any."""
        outliers = gaps = self.observed.isnan()
        if self.before:
            known = self.before["outliers"]
            outliers = torch.cat([known, gaps[len(known) :]])
        elif self.prior is None:
            outliers = gaps | gross_outliers(self.observed)
        for _ in range(_SCREENINGS):
            read = Magnitudes.of(self.observed, outliers, ends, self.phase, self.deviation)
            start = self._start(read, matrix)
            if self.variance is not None:
                start = replace(start, variance=self.variance)
            fit = start.fitted(self.drives, read, infer_noise=self.variance is None)
            shown, matrix = fit.outliers(self.drives, read, self.observed) | gaps, fit.matrix
            if torch.equal(shown, outliers):
                break
            outliers = shown
        return MatrixFit(fit, read, ends)

    def _start(self, read: Magnitudes, matrix: torch.Tensor | None) -> MatrixPosterior:
        """Return the posterior at which a fit begins: the one before, or the prior's.

        Without either, it begins at the matrix, or else at the rows of phase retrieval, which takes longest.
        """
        prior = self.prior or MatrixPrior.unknown(read, self.drives.shape[1])
        if before := self.before:
            known = replace(prior, spread=before["spread"])
            return MatrixPosterior(known, *(before[name] for name in _OF_POSTERIOR))
        start = MatrixPosterior.start(prior, read)
        if self.prior is not None:
            return start
        rows = retrieve(self.drives, read, self.generator).T if matrix is None else matrix
        return replace(start, entries=rows / prior.spread[:, None])


@one_library_thread()
def retrieve(drives: torch.Tensor, read: Magnitudes, generator: torch.Generator) -> torch.Tensor:
    """Return rows of the transfer matrix (M, P) that explain magnitudes (N, P) read for `drives` (N, M).

    Relaxed Douglas-Rachford splitting (Elser, SIAM J. Appl. Algebra Geometry 2 (2018) 150) seeks phasors that
    have the observed magnitudes and that some row produces, from spectral estimates of the rows. The rows are
    then fitted, and the best fit is taken. Of many readings of a point, a random part decides its row.
    """
    most = _SEARCHED * drives.shape[1]
    played, inverse = drives, None
    best = []
    for point in range(read.value.shape[1]):
        magnitude = read.column(point)
        if len(drives) > most:
            readings = torch.nonzero(~magnitude.outliers[:, 0])[:, 0]
            chosen = readings[torch.randperm(len(readings), generator=generator, device="cpu")[:most]]
            played, magnitude, inverse = drives[chosen], magnitude.rows(chosen), None
        if inverse is None:
            inverse = torch.linalg.pinv(played)
        rows = _searched(played, inverse, magnitude, generator)
        rows = _least_squares(played, inverse, magnitude, rows)
        best.append(rows[:, _misfit(played, magnitude, rows).argmin()])
    return torch.stack(best, dim=1)


def _searched(
    drives: torch.Tensor, inverse: torch.Tensor, read: Magnitudes, generator: torch.Generator
) -> torch.Tensor:
    """Return candidates (M, K) for a row that explains magnitudes (N, 1); few take a long search."""
    short = len(drives) < 3 * drives.shape[1] - 2
    start = _spectral(drives, read)[:, None]
    guesses = torch.randn((len(start), _GUESSES), dtype=torch.complex128, generator=generator, device="cpu")
    phasors = drives @ (start + _APART * start.norm() / guesses.norm(dim=0) * guesses)
    enough = _EXPLAINED**2 * read.value.square().sum()
    for step in range(_LONG_SEARCH_STEPS if short else _SEARCH_STEPS):
        right = read.nearest(phasors.abs()) * phasors.sgn()
        phasors = phasors + _RELAXATION * (drives @ (inverse @ (2 * right - phasors)) - right)
        if step % _CHECKED == 0 and (_misfit(drives, read, inverse @ phasors) <= enough).any():
            break
    rows: torch.Tensor = inverse @ phasors
    return rows


def _spectral(drives: torch.Tensor, read: Magnitudes) -> torch.Tensor:
    """Return the estimate (M,) of a row from magnitudes (N, 1): the main direction of loud drives.

    The weights 1 - 1 / intensity need the fewest readings (Mondelli and Montanari, Foundations of
    Computational Mathematics 19 (2019) 703).
    """
    intensity, least = read.value[:, 0].square(), torch.finfo(read.value.dtype).tiny
    relative = intensity / read.power.clamp(min=least)
    weight = (1 - 1 / relative.clamp(min=_FAINT)).masked_fill(read.outliers[:, 0], 0)
    direction: torch.Tensor = torch.linalg.eigh((drives.mH * weight) @ drives).eigenvectors[:, -1]
    row: torch.Tensor = direction * (read.value.norm() / (drives @ direction).norm().clamp(min=least))
    return row


def _least_squares(
    drives: torch.Tensor, inverse: torch.Tensor, read: Magnitudes, rows: torch.Tensor
) -> torch.Tensor:
    """Return least-squares fits (M, K) of rows to magnitudes (N, 1): phases and rows in turn."""
    for _ in range(_LEAST_SQUARES_STEPS):
        phasors = drives @ rows
        rows = inverse @ (read.nearest(phasors.abs()) * phasors.sgn())
    return rows


def _misfit(drives: torch.Tensor, read: Magnitudes, rows: torch.Tensor) -> torch.Tensor:
    """Return the sum of squares (K,) of the differences of rows (M, K) to magnitudes (N, 1)."""
    magnitude = (drives @ rows).abs()
    return (magnitude - read.nearest(magnitude)).square().sum(dim=0)
