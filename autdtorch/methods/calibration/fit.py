"""The fit of a simulation to readings: gains, phases, scale, and amounts of changes by linearising again.

To the fit a simulation is its transfer matrix as a function of the amounts of named changes.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, TypeAlias

import torch

from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.linearised_readings import LinearisedReadings
from autdtorch.methods.matrix_fit import TrialReadings
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior
from autdtorch.methods.prior import Prior, gaussian_prior
from autdtorch.objectives.readings import Readings
from autdtorch.propagators import Propagator
from autdtorch.propagators.scene_changes import SceneChanges
from autdtorch.scene.changes import lever
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.process import cached_property
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, complex_tensor, invalid, within

logger = logging.getLogger(__name__)

_ROUNDS = 12  # linearisations by the amounts of changes
_ENOUGH = 0.1  # change of the amounts, in their standard deviations, at which they have converged
# of simulated matrices: moved grids change them by 0.3 %, which is as much of an amount
_ENOUGH_ON_GRIDS = 0.5
_HALVINGS = 3  # of a step of the amounts that fits worse, or that the scene cannot take
_TEMPERED = (1000.0, 300.0, 100.0, 30.0, 10.0, 3.0)
"""Factors of the assumed noise in the first fits: the maximum is followed from one that noise makes wide, and
fewer fits end in a local one (64 drives of 249 transducers: twice the negative logarithm is 232 for 261)."""

_EXPECTED = 2.5  # standard deviations within which amounts are sought

_FAR = 6.0  # standard deviations of the prior beyond which a reading is an outlier at first

_LEAST_STEP = 0.3  # of Broyden's update, in widths; shorter ones show errors of moved grids
_COARSER = 1.5  # cells for derivatives, which Broyden's updates correct; a fifth of the cost


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
        return self.posterior.prior.parts(self.posterior.factors)[-1]

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


def fitted(simulation: CalibrationStart, readings: Readings, prior: Prior) -> CalibrationFit:
    """Fit a simulation to readings, from the scene itself and from amounts aside, and return the likeliest.

    Where matrices are simulated, the scene itself is the only start.
    """
    tangent = Tangent.at(simulation.changes, torch.zeros_like(simulation.widths))
    around = prior_around(tangent, simulation.widths, prior)
    unit = around.unit_of(readings.drives, readings.pressure)
    best = _climbed(simulation, readings, prior, unit, tangent)
    for amounts in [] if simulation.changes.simulates else simulation.aside:
        try:
            start = Tangent.at(simulation.changes, amounts)
            fit = _climbed(simulation, readings, prior, unit, start)
        except ValueError as error:  # on the way, too
            logger.info("calibration: no fit from amounts %s: %s", amounts.tolist(), error)
            continue
        # both with the noise and the outliers of the best
        here = replace(fit.posterior, variance=best.posterior.variance)
        if here.misfit(best.drives, best.read) < best.posterior.misfit(best.drives, best.read):
            best = fit
    return best


def _climbed(
    simulation: CalibrationStart, readings: Readings, prior: Prior, unit: float, tangent: Tangent
) -> CalibrationFit:
    """Return the fit that begins at a tangent.

    The matrix is linearised by the amounts of changes, fitted, and linearised again at the fitted amounts
    until they no longer change (Gauss-Newton). A step that fits worse than the one before is halved.
    """
    around = prior_around(tangent, simulation.widths, prior).times(unit)
    fit = _first(around, tangent, readings, unit)
    enough = _ENOUGH_ON_GRIDS if simulation.changes.simulates else _ENOUGH
    for left in reversed(range(_ROUNDS)):
        before, around = fit, prior_around(tangent, simulation.widths, prior).times(unit)
        trial = TrialReadings.of(around, fit.before, readings).fit()
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


def _first(prior: MatrixPrior, tangent: Tangent, readings: Readings, unit: float) -> CalibrationFit:
    """Return a fit near a tangent, with the common phase of the readings and without outliers far off."""
    drives, observed = readings.drives, readings.pressure
    expected = unit * drives @ tangent.matrix.T
    shift = torch.zeros_like(prior.widths)
    shift[len(shift) - len(tangent.amounts) :] = tangent.amounts
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
    simulation: CalibrationStart, prior: Prior, before: CalibrationFit, fit: CalibrationFit, tangent: Tangent
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


@dataclass(frozen=True, eq=False)
class LinearChanges:
    """A matrix (P, M) [Pa], and its changes (K, P, M) by amounts of 1, with their names."""

    start: torch.Tensor
    steps: torch.Tensor
    names: tuple[str, ...] = ()
    simulates: ClassVar[bool] = False

    def matrix(self, amounts: torch.Tensor) -> torch.Tensor:
        """Return the matrix (P, M) [Pa]."""
        return self.start + (amounts[:, None, None] * self.steps).sum(dim=0)

    def derivatives(self, amounts: torch.Tensor) -> torch.Tensor:
        """Return the derivatives (K, P, M) of the matrix by the amounts."""
        return self.steps


_LARGEST = {"m": 0.1, "rad": 1.0, "K": 50.0}  # standard deviations, beyond which a unit is mistaken

Changes: TypeAlias = SceneChanges | LinearChanges


class Tangent(NamedTuple):
    """A matrix (P, M) [Pa] at amounts (K,) of changes, and its derivatives (K, P, M) there."""

    amounts: torch.Tensor
    matrix: torch.Tensor
    derivatives: torch.Tensor

    @classmethod
    def at(cls, changes: Changes, amounts: torch.Tensor) -> Tangent:
        """Return matrix and derivatives at amounts (K,); those on grids from larger cells."""
        matrix = changes.matrix(amounts)
        coarser = changes.coarser(_COARSER) if isinstance(changes, SceneChanges) else changes
        derivatives = coarser.derivatives(amounts)
        return cls(amounts, matrix.to("cpu", torch.complex128), derivatives.to("cpu", torch.complex128))

    def moved(self, changes: Changes, amounts: torch.Tensor, widths: torch.Tensor) -> Tangent:
        """Return the tangent at other amounts (K,), with Broyden's update where matrices are simulated.

        The update, by the new matrix, takes one matrix instead of one or two for each change. Amounts count
        in their `widths` (K,).
        """
        if not changes.simulates:
            return self.at(changes, amounts)
        matrix, step = changes.matrix(amounts).to("cpu", torch.complex128), amounts - self.amounts
        length, derivatives = (step / widths).norm(), self.derivatives
        if length > _LEAST_STEP:
            left = matrix - self.matrix - (step[:, None, None] * derivatives).sum(dim=0)
            derivatives = derivatives + (step / widths.square() / length.square())[:, None, None] * left
        return Tangent(amounts, matrix, derivatives)


@dataclass(frozen=True, eq=False)
class CalibrationStart:
    """The simulation that a calibration starts from, before its fit.

    Attributes:
        propagator: of the scene; None where a transfer matrix alone is known.
        changes: the transfer matrix at the points of the readings.
        widths: standard deviations of the amounts (K,).
        points: of the readings (P, 3) [m], None for the control points of the scene, or of the matrix.
    """

    propagator: Propagator | None
    changes: Changes
    widths: torch.Tensor
    points: torch.Tensor | None

    @classmethod
    def of(cls, model: Propagator | ArrayLike, readings: Readings, prior: Prior) -> CalibrationStart:
        """Check a propagator, or a transfer matrix (P, M) [Pa], against the readings and the prior."""
        if prior.transfer_matrix is not None:
            accepted = "must be None: calibrate takes the matrix as its first argument"
            raise invalid("prior.transfer_matrix", "given", accepted)
        propagator = model if isinstance(model, Propagator) else None
        points, variants = readings.points, prior.variants
        if propagator is None:
            if points is not None:
                accepted = (
                    "must be None with a transfer matrix, whose rows are the points; or give a propagator"
                )
                raise invalid("readings.points", points, accepted)
            accepted = "must be a propagator, as make_propagator makes it, or a transfer matrix (P, M) [Pa]"
            matrix = complex_tensor("propagator_or_matrix", model, accepted).detach().cpu()
            changes: Changes = _linear(matrix, prior)
        elif isinstance(variants, Mapping):
            with within("prior.variants"):
                changes = SceneChanges(propagator, tuple(variants), points)
                _require_small(variants, changes.units)
        else:
            matrix = propagator.transfer_matrix(points).detach().to("cpu", torch.complex128)
            changes = _linear(matrix, prior)
        widths = variants.values() if isinstance(variants, Mapping) else [1.0] * len(changes.names)
        simulation = cls(propagator, changes, torch.tensor([*widths], **REAL), points)
        simulation._require_fit(readings)
        return simulation

    @property
    def scene(self) -> Scene | None:
        """The scene of the propagator."""
        return None if self.propagator is None else self.propagator.scene

    @property
    def aside(self) -> list[torch.Tensor]:
        """Amounts (K,) with one change of half wavelengths, as far as its width lets expect.

        The echo between a panel and a body half a wavelength aside is alike, and a fit ends at the nearest
        such amount. Free space has no echoes.
        """
        scene, amounts = self.scene, list[torch.Tensor]()
        if scene is None or not isinstance(self.changes, SceneChanges):
            return amounts
        if not (scene.obstacles or scene.reflectors):
            return amounts
        changes = torch.eye(len(self.widths), **REAL)
        for name, width, change in zip(self.changes.names, self.widths, changes, strict=True):
            step = scene.wavelength / 2 / lever(name, scene)
            for count in range(1, 1 + int(_EXPECTED * width / step)):
                amounts += [count * step * change, -count * step * change]
        return amounts

    def changed_scene(self, amounts: torch.Tensor) -> Scene | None:
        """Return the scene with amounts (K,) of the changes; None where there is a matrix alone."""
        return self.changes.scene(amounts) if isinstance(self.changes, SceneChanges) else self.scene

    def elsewhere(self, points: torch.Tensor, amounts: torch.Tensor) -> Tangent:
        """Return matrix and derivatives by amounts (K,) at other points (P, 3) [m].

        Changes of one point of the readings do not concern them.
        """
        if self.propagator is None:
            raise invalid("points", points, "must be None: the calibration knows a matrix, and no propagator")
        names = self.changes.names
        if isinstance(self.changes, SceneChanges):
            shared = [place for place, name in enumerate(names) if not name.startswith("points[")]
            changes = SceneChanges(self.propagator, [names[place] for place in shared], points)
            tangent = Tangent.at(changes, amounts[shared])
            derivatives = torch.zeros(len(names), *tangent.matrix.shape, **COMPLEX)
            derivatives[shared] = tangent.derivatives
            return Tangent(amounts, tangent.matrix, derivatives)
        if len(names):
            accepted = (
                "must be None: variants that are matrices are known at their points alone; name changes"
            )
            raise invalid("points", points, accepted)
        matrix = self.propagator.transfer_matrix(points).detach().to("cpu", torch.complex128)
        return Tangent(amounts, matrix, matrix.new_empty(0, *matrix.shape))

    def _require_fit(self, readings: Readings) -> None:
        shape = (readings.pressure.shape[1], readings.drives.shape[1])
        if self.scene is not None:
            points = len(self.scene.control_points) if self.points is None else len(self.points)
            expected = (points, len(self.scene.array))
        else:
            assert isinstance(self.changes, LinearChanges)
            points, transducers = self.changes.start.shape
            expected = (points, transducers)
        if shape != expected:
            has = f"{counted(shape[0], 'point')} and {counted(shape[1], 'transducer')}"
            raise ValueError(f"readings: {has}; must be {expected[0]} and {expected[1]}, as simulated")


def _require_small(widths: Mapping[str, float], units: Sequence[str]) -> None:
    for (name, width), unit in zip(widths.items(), units, strict=True):
        if width > _LARGEST[unit]:
            accepted = f"must be at most {_LARGEST[unit]:g} {unit}, the standard deviation in SI units"
            raise ValueError(f"{name!r}: {width:g} {unit}; {accepted}")


def _linear(matrix: torch.Tensor, prior: Prior) -> LinearChanges:
    if matrix.ndim != 2:
        raise ValueError(f"propagator_or_matrix: shape {tuple(matrix.shape)}; must be (P, M)")
    variants = prior.variants
    if isinstance(variants, Mapping):
        accepted = "must be transfer matrices (K, P, M) where a matrix is calibrated; names need a propagator"
        raise invalid("prior.variants", [*variants], accepted)
    if variants is None:
        return LinearChanges(matrix, matrix.new_empty(0, *matrix.shape))
    if variants.shape[1:] != matrix.shape:
        accepted = f"must be (K, {matrix.shape[0]}, {matrix.shape[1]})"
        raise ValueError(f"prior.variants: shape {tuple(variants.shape)}; {accepted}")
    names = tuple(f"variants[{number}]" for number in range(len(variants)))
    return LinearChanges(matrix, variants - matrix, names)
