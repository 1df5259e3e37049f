"""Calibration of a simulation by readings, with its score at readings held back."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

import torch
from scipy.stats import rankdata

from autdtorch.methods.calibration.calibration import (
    Calibration,
    HeldBack,
    fit_doubts,
    gain_to,
    relative_error,
)
from autdtorch.methods.calibration.fit import CalibrationFit, CalibrationStart, LinearChanges, fitted
from autdtorch.methods.doubtful_readings import saturation_doubts
from autdtorch.methods.gain_trend import trend_of_fit
from autdtorch.methods.prior import Prior, prior_of
from autdtorch.objectives.readings import Readings
from autdtorch.propagators import Propagator
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, integer_at_least, invalid

logger = logging.getLogger(__name__)

_INTERVAL = 1.96  # standard deviations of a 95 % interval
_LEAST_DRIVES = 2  # for each fold, to hold back drives; else readings are held back one by one
_SHIFTS = (-3, -2, -1, 1, 2, 3)  # rows by which readings and drives may be shifted
_COMPARED = 24  # least number of drives to look for a shift or a failed sensor
_VARIES = 0.1  # least relative deviation of the expected readings, to see whether a sensor follows them
_CLEAR = 2.0  # least deviation of the expected readings, in those that a sensor states, likewise
_FOLLOWS = 0.3  # least rank correlation with the drives of a sensor that follows them


@one_library_thread()
def calibrate(
    propagator_or_matrix: Propagator | ArrayLike,
    readings: Readings,
    prior: Prior | None = None,
    *,
    folds: int = 5,
    seed: int = 0,
) -> Calibration:
    """Fit a simulation to readings: gains and phases of transducers, a scale, changes of the scene.

    The model is p = c G(t) diag(g e^{i b}) q, with errors of single entries of the matrix besides, all with
    the widths of the prior. Readings of the magnitude constrain it, and phases where they were read, up to a
    common one. The likeliest values are sought by Gauss-Newton steps, with echoes and without simulations on
    grids also from amounts half a wavelength aside. Deviations are those of the posterior linearised there
    (Laplace's approximation). Readings that stay beyond six deviations are left out and named.

    Args:
        propagator_or_matrix: of the scene, or its transfer matrix G (P, M) [Pa].
        readings: drives and pressures; at the scene's control points if they have no points.
        prior: how far to trust the simulation; ``variants={"obstacles.x": 2e-3}`` names changes of the scene.
        folds: parts of the readings that are held back in turn for `Calibration.held_back`; 0 to leave it
            out. Each costs a fit.
        seed: of the parts.

    Raises:
        ValueError: readings of another array or other points, variants that do not fit, readings that fit
            other drives, shifted or conjugate, or fewer readings than folds.
    """
    if not isinstance(readings, Readings):
        raise invalid("readings", readings, "must be Readings, which load_readings(path) returns")
    prior = prior_of("prior", prior) or Prior()
    folds, seed = integer_at_least("folds", folds, 0), integer_at_least("seed", seed, 0)
    if not (readings.pressure > 0).any():
        raise invalid("readings", readings, "must have at least one reading above 0 Pa")
    if folds == 1 or folds > readings.count:
        raise invalid("folds", folds, f"must be 0, or 2 to {readings.count}, the number of readings")
    simulation = CalibrationStart.of(propagator_or_matrix, readings, prior)
    start = simulation.changes.matrix(torch.zeros_like(simulation.widths)).to("cpu", torch.complex128)
    expected = (readings.drives @ start.T).abs()
    if not (expected > 0).any():
        raise invalid("propagator_or_matrix", 0, "must make a pressure with the drives of the readings")
    _require_in_step(expected, readings.pressure)
    _require_sign((readings.drives.conj() @ start.T).abs(), expected, readings.pressure)
    fit, failed = _fit_without_failed(simulation, readings, prior, expected)
    used = _without(readings, failed.expand_as(readings.pressure))
    doubts = [*_sensor_doubts(failed, expected, readings.pressure)]
    if not fit.converged:
        names = ", ".join(simulation.changes.names)
        doubts.append(f"the amounts of {names} have not converged: their deviations are too small")
    if simulation.changes.simulates and simulation.aside:
        doubts.append('amounts half a wavelength aside may fit better: method "tmatrix" looks there, too')
    for point in range(len(failed)):
        doubts += saturation_doubts(fit.read, point)
    doubts += trend_of_fit(fit.posterior, used.drives, fit.read).doubts()
    calibration = Calibration(simulation, start, used, prior, fit, None, tuple(doubts))
    for row, column in calibration.outliers:
        logger.warning(
            "calibration: the reading of drive %d at point %d, %.4g Pa, is far from the fit, and left out",
            row,
            column,
            float(readings.pressure[row, column]),
        )
    if folds:
        calibration = replace(calibration, held_back=_held_back(calibration, folds, seed))
    calibration = replace(calibration, doubts=(*doubts, *fit_doubts(calibration)))
    for doubt in calibration.doubts:
        logger.warning("calibration: %s", doubt)
    return calibration


def _held_back(calibration: Calibration, folds: int, seed: int) -> HeldBack:
    """Return errors at readings held back in turn, from fits around the amounts of all readings."""
    readings = calibration.readings
    observed, known = readings.pressure, ~readings.pressure.isnan() & ~calibration.fit.read.outliers
    clean = _without(readings, ~known)
    # a saturated sensor says how far a prediction is off at least
    scored = known & ~calibration.fit.read.limit
    simulation = calibration.simulation
    linear = LinearChanges(*calibration.fit.changes, simulation.changes.names)
    here = replace(simulation, changes=linear)
    simulated = (readings.drives @ calibration.simulated.T).abs()
    predicted, scaled, deviation = (torch.full_like(observed, torch.nan) for _ in range(3))
    for away in _parts(known, folds, seed):
        rest, taken, seen = _without(clean, away), away & scored, scored & ~away
        fit = fitted(here, rest, calibration.settings)
        part = replace(calibration, simulation=here, readings=rest, fit=fit)
        prediction = part.predict(readings.drives)
        predicted[taken] = prediction.pressure[taken]
        noise = prediction.of_reading
        if readings.deviation is not None:
            noise = torch.hypot(prediction.deviation, part.noise / part.fit.read.stated * readings.deviation)
        deviation[taken] = noise[taken]
        scaled[taken] = gain_to(observed[seen], simulated[seen]) * simulated[taken]
    inside = ((predicted - observed).abs() < _INTERVAL * deviation)[scored]
    error, before = (relative_error(each, observed, readings.deviation) for each in (predicted, scaled))
    return HeldBack(error, before, float(inside.double().mean()), len(inside), predicted, scaled)


def _parts(known: torch.Tensor, folds: int, seed: int) -> Iterator[torch.Tensor]:
    """Yield masks (N, P) of readings to hold back: of whole drives, or of readings where drives are few."""
    generator = torch.Generator().manual_seed(seed)
    places = known.any(dim=1).nonzero()
    if len(places) < _LEAST_DRIVES * folds:
        places = known.nonzero()
    for part in torch.randperm(len(places), generator=generator, device="cpu").tensor_split(folds):
        away = torch.zeros_like(known)
        away[tuple(places[part].T)] = True
        yield away


def _without(readings: Readings, gaps: torch.Tensor) -> Readings:
    """Return readings with gaps (N, P) where they are not used."""
    return replace(readings, pressure=readings.pressure.masked_fill(gaps, torch.nan))


def _require_in_step(expected: torch.Tensor, observed: torch.Tensor) -> None:
    """Refuse readings (N, P) that fit the drives of other rows far better than their own."""
    if len(observed) < _COMPARED:
        return
    level = _correlation(expected, observed)
    for shift in _SHIFTS:
        pair = (expected[shift:], observed[:-shift]) if shift > 0 else (expected[:shift], observed[-shift:])
        if (shifted := _correlation(*pair)) > max(_FOLLOWS, level + 4 / observed.numel() ** 0.5):
            follow = f"{counted(abs(shift), 'row')} {'later' if shift > 0 else 'earlier'}"
            pairs = (f"{shift}:", f":{-shift}") if shift > 0 else (f":{shift}", f"{-shift}:")
            raise ValueError(
                f"readings.pressure: shifted against the drives: they follow those {follow} (correlation "
                f"{shifted:.2f}, {level:.2f} as given); must be drives[{pairs[0]}] with pressure[{pairs[1]}]"
            )


def _require_sign(conjugate: torch.Tensor, expected: torch.Tensor, observed: torch.Tensor) -> None:
    """Refuse readings (N, P) that fit the conjugate drives far better than the drives."""
    if len(observed) < _COMPARED:
        return
    level, turned = _correlation(expected, observed), _correlation(conjugate, observed)
    if turned > max(_FOLLOWS, level + 4 / observed.numel() ** 0.5):
        raise ValueError(
            f"readings.drives: the pressures follow their conjugates (correlation {turned:.2f}, {level:.2f} "
            "as given); must have phases of the other sign: load_readings(..., phases='arg deg' or 'arg rad')"
        )


def _sensor_doubts(failed: torch.Tensor, expected: torch.Tensor, observed: torch.Tensor) -> Iterator[str]:
    """Describe points whose sensor has `failed` (P,), or reads what is `expected` (N, P) of another."""
    for point in failed.nonzero()[:, 0].tolist():
        column = observed[:, point, None]
        levels = [_correlation(other[:, None], column) for other in expected.T]
        nearest = max(range(len(levels)), key=levels.__getitem__)
        cause = "has its sensor failed?"
        if levels[nearest] > _FOLLOWS + 4 / len(observed) ** 0.5:
            cause = f"it reads as point {nearest} should: are sensors interchanged?"
        yield f"point {point} does not follow the drives, and is left out: {cause}"


def _fit_without_failed(
    simulation: CalibrationStart, readings: Readings, prior: Prior, expected: torch.Tensor
) -> tuple[CalibrationFit, torch.Tensor]:
    """Return the fit, and the points (P,), bool, that neither simulation nor other readings explain."""
    observed = readings.pressure
    suspects = _failed(expected, readings)
    if not suspects.any() or suspects.all():
        return fitted(simulation, readings, prior), torch.zeros_like(suspects)
    fit = fitted(simulation, _without(readings, suspects.expand_as(observed)), prior)
    failed = suspects & _failed((readings.drives @ fit.posterior.matrix.T).abs(), readings)
    if not torch.equal(failed, suspects):
        fit = fitted(simulation, _without(readings, failed.expand_as(observed)), prior)
    return fit, failed


def _failed(expected: torch.Tensor, readings: Readings) -> torch.Tensor:
    """Return the points (P,), bool, whose readings do not follow the expected ones (N, P).

    Few readings, and drives that are expected to give nearly the same, show nothing of a sensor, nor does a
    point that is dark beside the deviations of its readings.
    """
    failed = []
    least = torch.zeros_like(expected[0])
    if readings.deviation is not None:
        least = _CLEAR * readings.deviation.nanmedian(dim=0).values
    for wanted, read, dark in zip(expected.T, readings.pressure.T, least, strict=True):
        known = ~read.isnan()
        varies = torch.maximum(_VARIES * wanted[known].mean(), dark)
        judged = int(known.sum()) >= _COMPARED and bool(wanted[known].std() > varies)
        failed.append(judged and _correlation(wanted[:, None], read[:, None]) < _FOLLOWS)
    return torch.tensor(failed, dtype=torch.bool, device="cpu")


def _correlation(expected: torch.Tensor, observed: torch.Tensor) -> float:
    """Return the mean over points of the rank correlation of magnitudes (N, P), without gaps."""
    levels = []
    for pair in zip(expected.T, observed.T, strict=True):
        known = ~pair[1].isnan()
        if known.sum() > 2:
            ranks = torch.from_numpy(rankdata([values[known].numpy() for values in pair], axis=1))
            levels.append(torch.corrcoef(ranks)[0, 1].nan_to_num())
    return float(torch.stack(levels).mean()) if levels else 0.0
