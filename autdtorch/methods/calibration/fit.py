"""The fit of a simulation to readings: gains, phases, scale, and amounts of changes by linearising again."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import torch

from autdtorch.methods.calibration.simulation import Simulation, Tangent
from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.linearised_readings import LinearisedReadings
from autdtorch.methods.matrix_fit import Trial
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior
from autdtorch.methods.prior import Prior, gaussian_prior
from autdtorch.objectives.readings import Readings
from autdtorch.utils.process import cached_property

logger = logging.getLogger(__name__)

_ROUNDS = 12  # linearisations by the amounts of changes
_ENOUGH = 0.1  # change of the amounts, in their standard deviations, at which they have converged
_ENOUGH_ON_GRIDS = (
    0.5  # of simulated matrices: moved grids change them by 0.3 %, which is as much of an amount
)
_HALVINGS = 3  # of a step of the amounts that fits worse, or that the scene cannot take
_TEMPERED = (1000.0, 300.0, 100.0, 30.0, 10.0, 3.0)
"""Factors of the assumed noise in the first fits: the maximum is followed from one that noise makes wide, and
fewer fits end in a local one (64 drives of 249 transducers: twice the negative logarithm is 232 for 261)."""

_FAR = 6.0  # standard deviations of the prior beyond which a reading is an outlier at first


@dataclass(frozen=True, eq=False)
class CalibrationFit:
    """The posterior of a calibration, and the readings as they were taken.

    Attributes:
        posterior: of the transfer matrix, linearised by the amounts around the last ones but one.
        read: magnitudes (N, P) and phases; outliers and gaps say nothing.
        drives: (N, M).
        unit: scale of the readings by the simulation before the fit.
        converged: whether the amounts of the changes have.
    """

    posterior: MatrixPosterior
    read: Magnitudes
    drives: torch.Tensor
    unit: float
    converged: bool = True

    @property
    def amounts(self) -> torch.Tensor:
        """The fitted amounts of the changes (K,)."""
        return self.posterior.factors[2 * self.drives.shape[1] + 2 :]

    @property
    def changes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The simulated matrix (P, M) at amounts of 0, and its derivatives (K, P, M), by the last tangent."""
        prior = self.posterior.prior
        return prior.rows / self.unit, prior.changes / self.unit

    @cached_property
    def line(self) -> LinearisedReadings:
        """The readings, linearised at the maximum."""
        return self.posterior.linearised(self.drives, self.read)

    @cached_property
    def deviations(self) -> torch.Tensor:
        """The standard deviations of the factors, as those of `MatrixPrior.widths`."""
        return self.posterior.prior.widths * self.line.covariance.of_factors.diagonal().clamp_min(0).sqrt()

    @property
    def before(self) -> dict[str, torch.Tensor]:
        """Tensors from which another fit goes on."""
        posterior = self.posterior
        return {
            "factors": posterior.factors,
            "entries": posterior.entries,
            "variance": posterior.variance,
            "spread": posterior.prior.spread,
            "outliers": self.read.outliers,
        }


def fitted(simulation: Simulation, readings: Readings, prior: Prior) -> CalibrationFit:
    """Fit a simulation to readings.

    The matrix is linearised by the amounts of changes, fitted, and linearised again at the fitted amounts
    until they no longer change (Gauss-Newton). A step that fits worse than the one before is halved.
    """
    tangent = Tangent.at(simulation.changes, torch.zeros_like(simulation.widths))
    around = prior_around(tangent, simulation.widths, prior)
    unit = around.unit_of(readings.drives, readings.pressure)
    fit = _first(around.times(unit), readings, unit)
    enough = _ENOUGH_ON_GRIDS if simulation.changes.simulates else _ENOUGH
    for left in reversed(range(_ROUNDS)):
        before, around = fit, prior_around(tangent, simulation.widths, prior).times(unit)
        trial = Trial.of(around, fit.before, readings).fit()
        fit = replace(fit, posterior=trial.posterior, read=trial.read)
        step = fit.amounts - tangent.amounts
        if not len(step) or (step.abs() < enough * fit.deviations[-len(step) :]).all():
            return fit
        if left:  # the last fit stays at its readings
            fit, tangent = _moved(simulation, prior, before, fit, tangent)
            logger.debug("calibration: amounts %s", tangent.amounts.tolist())
    return replace(fit, converged=False)


def prior_around(tangent: Tangent, widths: torch.Tensor, prior: Prior) -> MatrixPrior:
    """Return the prior of a matrix by changes of widths (K,), as linear as its tangent."""
    return gaussian_prior(prior, tangent.matrix, tangent.derivatives, widths, tangent.amounts)


def _first(prior: MatrixPrior, readings: Readings, unit: float) -> CalibrationFit:
    """Return the maximum of the prior, with the common phase of the readings and without outliers far off."""
    drives, observed = readings.drives, readings.pressure
    expected = drives @ prior.rows.T
    shift = torch.zeros_like(prior.widths)
    if readings.phase is not None:
        parts = torch.polar(observed, readings.phase) * expected.conj()
        shift[2 * drives.shape[1] + 1] = parts[parts.abs().isfinite()].sum().angle()
    errors = prior.errors(drives)
    if readings.deviation is not None:
        errors = torch.hypot(errors, readings.deviation)
    far = (observed - expected.abs()).abs() > _FAR * errors
    outliers = far | observed.isnan()
    ends = torch.full_like(observed[0], torch.inf)
    read = Magnitudes.of(observed, outliers, ends, readings.phase, readings.deviation)
    start = replace(MatrixPosterior.start(prior, read), factors=shift)
    usual = start.variance
    for factor in _TEMPERED:
        start = replace(start, variance=factor * usual).fitted(drives, read, infer_noise=False)
    return CalibrationFit(start, read, drives, unit)


def _moved(
    simulation: Simulation,
    prior: Prior,
    before: CalibrationFit,
    fit: CalibrationFit,
    tangent: Tangent,
) -> tuple[CalibrationFit, Tangent]:
    """Return a fit with its amounts, or nearer to those of the tangent, where it fits better than before."""
    start = tangent.amounts
    factors = len(fit.posterior.factors) - len(start)
    worst = replace(before.posterior, variance=fit.posterior.variance).misfit(fit.drives, fit.read)
    for halving in range(_HALVINGS + 1):
        amounts = start + 0.5**halving * (fit.amounts - start)
        try:
            after = tangent.moved(simulation.changes, amounts, simulation.widths)
        except ValueError as error:
            if halving == _HALVINGS:
                raise
            logger.info("calibration: amounts %s are no scene: %s", amounts.tolist(), error)
            continue
        moved = torch.cat([fit.posterior.factors[:factors], amounts])
        there = replace(
            fit.posterior, prior=prior_around(after, simulation.widths, prior).times(fit.unit), factors=moved
        )
        if there.misfit(fit.drives, fit.read) < worst:
            break
    return replace(fit, posterior=there), after
