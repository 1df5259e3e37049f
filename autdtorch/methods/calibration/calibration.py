"""The result of a calibration: what the readings say of array and scene, how surely, and predictions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from autdtorch.methods.calibration.fit import CalibrationFit, CalibrationStart, prior_around
from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.prior import Prior
from autdtorch.objectives.objective import validate_drives
from autdtorch.objectives.readings import Readings
from autdtorch.propagators.scene_changes import SceneChanges
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, device_of
from autdtorch.utils.process import cached_property, one_library_thread
from autdtorch.utils.text import counted, html_facts
from autdtorch.utils.validation import ArrayLike, complex_tensor, points_tensor

_LISTED = 5  # outliers or groups in a summary
_SCALED = 20.0  # scale, or its inverse, that no gain of a sensor explains
_USELESS = 0.3  # relative error at readings held back that is no calibration
_SILENT = 0.3  # share of the pressure that the simulation and the scale expect of a transducer, at most
_ALIKE = 0.9999  # cosine of two transducers' derivatives above which readings show them only together


class Amount(NamedTuple):
    """The fitted amount of a change, in SI units, and its standard deviation."""

    value: float
    deviation: float


class Prediction(NamedTuple):
    """Predicted magnitudes (N, P) [Pa].

    Attributes:
        pressure: the likeliest magnitudes.
        deviation: their standard deviations.
        of_reading: standard deviations of readings, with `Calibration.noise`.
    """

    pressure: torch.Tensor
    deviation: torch.Tensor
    of_reading: torch.Tensor


class HeldBack(NamedTuple):
    """Errors at readings that were held back from the fit, in turn.

    Attributes:
        error: rms error of the calibrated predictions over the rms reading.
        before: rms error of the simulation with one free gain, likewise.
        coverage: share of the readings within the stated 95 % intervals.
        readings: number of readings.
        predicted: by the calibrations without them (N, P) [Pa], NaN elsewhere.
        simulated: by the simulation with one free gain (N, P) [Pa], NaN elsewhere.
    """

    error: float
    before: float
    coverage: float
    readings: int
    predicted: torch.Tensor
    simulated: torch.Tensor


def gain_to(observed: torch.Tensor, simulated: torch.Tensor) -> torch.Tensor:
    """Return the gain of simulated magnitudes that fits observed ones best, where both are known."""
    known = ~(observed + simulated).isnan()
    return (simulated * observed)[known].sum() / simulated[known].square().sum()


def relative_error(
    predicted: torch.Tensor, observed: torch.Tensor, deviation: torch.Tensor | None = None
) -> float:
    """Return the rms difference over the rms of observed magnitudes, where both are known, by deviation."""
    known = ~(observed + predicted).isnan()
    weight = torch.ones_like(observed) if deviation is None else 1 / deviation
    return float((weight * (predicted - observed))[known].norm() / (weight * observed)[known].norm())


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """A simulation that was fitted to readings; `calibrate` makes it.

    Attributes:
        simulation: before the fit.
        simulated: its transfer matrix (P, M) [Pa].
        readings: that were fitted.
        settings: prior of the fit.
        fit: the posterior around the likeliest matrix.
        held_back: errors at readings that were held back; None without.
        doubts: sentences about sensors and readings that do not fit.
    """

    simulation: CalibrationStart
    simulated: torch.Tensor
    readings: Readings
    settings: Prior
    fit: CalibrationFit
    held_back: HeldBack | None
    doubts: tuple[str, ...]

    @property
    def transfer_matrix(self) -> torch.Tensor:
        """The calibrated transfer matrix (P, M) [Pa] at the points of the readings."""
        return self.fit.posterior.matrix

    @property
    def gain(self) -> torch.Tensor:
        """Gain of each transducer (M,) by the simulation's, besides the scale."""
        return self._factors[0].exp()

    @property
    def gain_deviation(self) -> torch.Tensor:
        """Standard deviations of the gains (M,), relative."""
        return self._deviations[0]

    @property
    def phase(self) -> torch.Tensor:
        """Phase of each transducer (M,) beside the simulation's [rad]: p = G e^(i phase) q."""
        return self._factors[1]

    @property
    def phase_deviation(self) -> torch.Tensor:
        """Standard deviations of the phases (M,) [rad]."""
        return self._deviations[1]

    @property
    def scale(self) -> Amount:
        """Scale of all readings by the simulation, and its standard deviation."""
        value = self.fit.unit * float(self._factors[2].exp())
        return Amount(value, value * float(self._deviations[2]))

    @property
    def amounts(self) -> Mapping[str, Amount]:
        """Amounts of the changes of the scene, by name."""
        rows = zip(self._factors[4].tolist(), self._deviations[4].tolist(), strict=True)
        return {name: Amount(*row) for name, row in zip(self.simulation.changes.names, rows, strict=True)}

    @property
    def noise(self) -> float:
        """Standard deviation of the readings' noise [Pa]; of the median one where they state theirs."""
        return float(self.fit.posterior.variance.mean().sqrt())

    @property
    def outliers(self) -> list[tuple[int, int]]:
        """Drive and point of each reading that was left out, counted from 0."""
        rejected = self.fit.read.outliers & ~self.readings.pressure.isnan()
        return [(row, column) for row, column in rejected.nonzero().tolist()]

    @cached_property
    def determined(self) -> float:
        """Number of directions of gains and phases (of 2 M) that the readings determine."""
        transducers = 2 * len(self.gain)
        left = self.fit.line.covariance.of_factors[:transducers, :transducers]
        return float(transducers - torch.linalg.eigvalsh(left).clamp(0, 1).sum())

    @cached_property
    def together(self) -> list[list[int]]:
        """Groups of transducers that the readings show only together, such as rings of symmetric drives."""
        by_gain = self.fit.line.by_factors().flatten(0, 1)[:, : len(self.gain)]
        unit = by_gain / by_gain.norm(dim=0).clamp_min(torch.finfo(by_gain.dtype).tiny)
        alike, seen, groups = unit.mT @ unit > _ALIKE, set[int](), []
        for transducer, row in enumerate(alike):
            members = [each for each in row.nonzero()[:, 0].tolist() if each not in seen]
            seen |= {*members, transducer}
            if len(members) > 1:
                groups.append(members)
        return groups

    @property
    def scene(self) -> Scene | None:
        """The scene with the fitted changes, gains, phases and scale; None where a matrix was calibrated."""
        scene = self.simulation.changed_scene(self._factors[4])
        if scene is None:
            return None
        array = scene.array.calibrated(self.scale.value * self.gain, self.phase)
        return replace(scene, array=array)

    @property
    def prior(self) -> Prior:
        """The prior of a method that reads on at the same points: the matrix, and what is left unsure."""
        steps = self._deviations[4][:, None, None] * self.fit.posterior.changes
        matrix = self.transfer_matrix
        return Prior(
            matrix,
            matrix + steps if len(steps) else None,
            gain=float(self.gain_deviation.square().mean().sqrt()),
            phase=float(self.phase_deviation.square().mean().sqrt()),
            rest=self.settings.rest,
        )

    @property
    def prior_with_readings(self) -> Prior:
        """The prior of a method that takes the readings, too: the widths before, at the fitted amounts."""
        matrix, changes = self.fit.changes
        steps = self.simulation.widths[:, None, None] * changes
        variants = matrix + steps if len(steps) else None
        return replace(self.settings, transfer_matrix=matrix, variants=variants)

    @one_library_thread()
    def predict(self, drives: ArrayLike, points: ArrayLike | None = None) -> Prediction:
        """Predict magnitudes of drives (..., M), flattened to (N, M), at points.

        Args:
            drives: (..., M), |q| <= 1.
            points: (P, 3) [m]; None for those of the readings, whose rows of the matrix are known best.

        Raises:
            ValueError: drives of another shape, or points where a matrix alone was calibrated.
        """
        played = validate_drives(complex_tensor("drives", drives), self.readings.drives.shape[1], "drives")
        played = played.reshape(-1, played.shape[-1]).to(**COMPLEX)
        posterior = self.fit.posterior
        if points is not None:
            tangent = self.simulation.elsewhere(points_tensor("points", points), self.fit.amounts)
            around = prior_around(tangent, self.simulation.widths, self.settings).times(self.fit.unit)
            entries = around.rows.new_zeros(around.rows.shape)
            variance = posterior.variance.mean().expand_as(around.spread)
            posterior = replace(posterior, prior=around, entries=entries, variance=variance)
        magnitudes = (played @ posterior.matrix.T).abs()
        others = posterior.linearised(
            played, Magnitudes(magnitudes, torch.zeros_like(magnitudes, dtype=torch.bool))
        )
        deviation = self.fit.line.covariance.deviations_of(others, same_points=points is None)
        parts = magnitudes, deviation, (deviation.square() + posterior.variance).sqrt()
        return Prediction(*(part.to(device_of(drives)) for part in parts))

    @property
    def _factors(self) -> tuple[torch.Tensor, ...]:
        """Gains, phases, scale, common phase and amounts."""
        return self.fit.posterior.prior.parts(self.fit.posterior.factors)

    @property
    def _deviations(self) -> tuple[torch.Tensor, ...]:
        return self.fit.posterior.prior.parts(self.fit.deviations)

    def summary(self) -> str:
        """Return the facts as lines of text."""
        width = max(len(name) for name, _ in self._facts())
        return "\n".join(f"{name:{width}}  {value}" for name, value in self._facts())

    def __repr__(self) -> str:
        return f"Calibration({', '.join(f'{name} {value}' for name, value in self._facts())})"

    def _repr_html_(self) -> str:
        """Return the facts as a table, for Jupyter."""
        return html_facts("Calibration", self._facts())

    def _facts(self) -> list[tuple[str, str]]:
        (drives, points), count = self.readings.pressure.shape, self.readings.count
        facts = [("readings", f"{count}, of {counted(drives, 'drive')} at {counted(points, 'point')}")]
        if (held := self.held_back) is not None:
            error = f"{_percent(held.error)} after, {_percent(held.before)} before with one gain"
            error += "" if held.error < held.before else ": no better than the simulation"
            facts += [
                ("error at readings held back", error),
                ("within 95 % intervals", f"{100 * held.coverage:.0f} % of {held.readings}"),
            ]
        sounding = ~_silent(self)
        gains, phases = _spreads(self, sounding)
        gain_error, phase_error = (
            float(deviation[sounding].mean()) for deviation in (self.gain_deviation, self.phase_deviation)
        )
        facts += [
            ("scale", f"{self.scale.value:.4g} +- {self.scale.deviation:.2g}"),
            ("gains", f"spread {_percent(gains)}, each +- {_percent(gain_error)}"),
            ("phases", f"spread {phases:.3f} rad, each +- {phase_error:.3f} rad"),
            ("noise", f"{self.noise:.3g} Pa, standard deviation of a reading"),
            ("determined", f"{self.determined:.0f} of {2 * len(self.gain)} directions of gains and phases"),
        ]
        changes = self.simulation.changes
        units = changes.units if isinstance(changes, SceneChanges) else [""] * len(changes.names)
        for (name, amount), unit in zip(self.amounts.items(), units, strict=True):
            facts.append((name, f"{amount.value:.4g} +- {amount.deviation:.2g} {unit}".rstrip()))
        if groups := ["+".join(map(str, group)) for group in self.together]:
            more = ", ..." if len(groups) > _LISTED else ""
            shown = f"transducers {', '.join(groups[:_LISTED])}{more}"
            facts.append(("seen only together", shown))
        if self.outliers:
            places = ", ".join(f"drive {row} at point {column}" for row, column in self.outliers[:_LISTED])
            more = f" and {len(self.outliers) - _LISTED} more" if len(self.outliers) > _LISTED else ""
            facts.append(("outliers left out", places + more))
        return facts + [("doubt", doubt) for doubt in self.doubts]


def fit_doubts(calibration: Calibration) -> Iterator[str]:
    """Describe a fit that needs more than the prior expects, or that predicts badly."""
    if not 1 / _SCALED < calibration.scale.value < _SCALED:
        causes = "are pressures or points in another unit, or is source_strength wrong?"
        yield f"the scale is {calibration.scale.value:.3g}: {causes}"
    settings = calibration.settings
    most = 1.5 + 3 / (2 * len(calibration.gain)) ** 0.5  # and three deviations of the rms of so many draws
    silent = _silent(calibration)
    if silent.any():
        numbers = ", ".join(map(str, silent.nonzero()[:, 0].tolist()))
        which = f"transducers {numbers} are" if silent.sum() > 1 else f"transducer {numbers} is"
        yield f"{which} silent, or below {100 * _SILENT:.0f} % of the simulation: failed, or not connected?"
    gains, phases = _spreads(calibration, ~silent)
    causes = "are transducers in another order, or is the prior too narrow?"
    if gains > most * settings.gain:
        yield f"gains spread {_percent(gains)}, prior.gain is {_percent(settings.gain)}: {causes}"
    if phases > most * settings.phase:
        yield f"phases spread {phases:.2g} rad, prior.phase is {settings.phase:.2g} rad: {causes}"
    held = calibration.held_back
    if held is not None and held.error > _USELESS:
        causes = "are there too few, in another unit (dB), or of other drives or another scene?"
        yield f"predictions are {_percent(held.error)} off readings held back: {causes}"


def _silent(calibration: Calibration) -> torch.Tensor:
    """Return the transducers (M,), bool, whose columns of the fitted matrix are nearly 0.

    Gains alone do not show it: single entries take over what is unlikely for the prior of the gains.
    """
    prior = calibration.fit.posterior.prior
    expected = prior.rows + (calibration.fit.amounts[:, None, None] * prior.changes).sum(dim=0)
    share = calibration.transfer_matrix.norm(dim=0) / expected.norm(dim=0)
    silent: torch.Tensor = share < _SILENT * share.nanmedian()
    return silent


def _spreads(calibration: Calibration, among: torch.Tensor) -> tuple[float, float]:
    """Return the rms of the logarithms of gains around their mean, and of phases [rad], of some (M,)."""
    gains, phases = calibration.gain[among].log(), calibration.phase[among]
    rms = [part.square().mean().sqrt() for part in (gains - gains.mean(), phases)]
    return float(rms[0]), float(rms[1])


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
