"""A simulation as calibration sees it: the transfer matrix by amounts of named changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeAlias

import torch

from autdtorch.methods.prior import Prior
from autdtorch.objectives.readings import Readings
from autdtorch.propagators import Propagator
from autdtorch.propagators.scene_changes import SceneChanges
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, complex_tensor, invalid, within

_LEAST_STEP = 0.3  # of Broyden's update, in widths; shorter ones show errors of moved grids
_COARSER = 1.5  # cells for derivatives, which Broyden's updates correct; a fifth of the cost


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
class Simulation:
    """The simulation that a calibration starts from.

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
    def of(cls, model: Propagator | ArrayLike, readings: Readings, prior: Prior) -> Simulation:
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
