"""Forces as an instrument reads them, such as a balance: one number for a drive, with noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.objectives.forces import ForceObjective, GoalOfForce
from autdtorch.objectives.objective import observe_drives
from autdtorch.utils.validation import ArrayLike, integer_at_least, not_negative, require_kind


@dataclass(frozen=True)
class ForceReading(GoalOfForce):
    """The goal of a `ForceSensor`: its reading, less that without sound.

    Attributes:
        of: the trap, lift or push that is read.
        load: the reading without sound, in the unit of it, >= 0.
    """

    load: float

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the force (...) of readings (..., 1)."""
        return self.checked(pressure)[..., 0] - self.load

    def check(self, points: int) -> None:
        """Check that there is one reading."""
        if points != 1:
            raise ValueError(f"pressure: {points} readings; must be 1, of a ForceSensor")


class ForceSensor:
    """An objective that reads a force and no more, as a balance does: no method sees a matrix.

    A body rests on the balance: the reading is its load, the force and the noise together, and 0 where that
    is negative. `Push` is the force of a body on its balance. A `Levitate` or `Trap` takes an instrument that
    finds the score by readings of its own at several places.

    Attributes:
        scene: its array plays the drives; `LSSG` superposes foci at its control points.
        goal: the force by a reading.
        readings: number of readings for a drive, 1.
        evaluations: number of observations so far.
    """

    readings = 1

    def __init__(
        self, objective: ForceObjective, load: float = 0.0, noise: float = 0.0, seed: int = 0
    ) -> None:
        """Read a force.

        Args:
            objective: gives the force. Perturbations of the drive go around the sensor.
            load: the reading without sound, in the unit of the goal, >= 0. Forces below minus the load, which
                lift the body off, all read as 0.
            noise: standard deviation of a reading, in the unit of the goal, >= 0.
            seed: of the noise, >= 0.
        """
        require_kind("objective", objective, ForceObjective)
        force = objective.goal
        self.goal = ForceReading(force.of, not_negative("load", load, force.unit))
        self._objective, self._noise = objective, not_negative("noise", noise, force.unit)
        self._generator = np.random.default_rng(integer_at_least("seed", seed, 0))
        self.scene, self.evaluations = objective.scene, 0

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (..., M): readings (..., 1) in the unit of the goal."""
        return observe_drives(self._observe, drive, len(self.scene.array))

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        self.evaluations += len(drive)
        force = self._objective.goal(self._objective(drive))
        noise = self._noise * torch.from_numpy(self._generator.standard_normal(len(drive)))
        return (self.goal.load + force + noise).clamp_min(0)[:, None]
