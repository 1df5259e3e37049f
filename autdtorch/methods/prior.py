"""A simulated transfer matrix as the prior of a measurement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch

from autdtorch.methods.base import Problem
from autdtorch.methods.matrix_posterior import MatrixPrior
from autdtorch.utils.validation import complex_tensor, invalid, positive, require_known

_SCALE = 1.0
"""Standard deviation of the logarithm of the scale between readings and simulation. A sensor may be wrong by
a factor of three; the first reading fixes it."""


@dataclass(frozen=True, eq=False)
class Prior:
    """What a simulation says of the device that is measured, and how far to trust it.

    The measured matrix is that of the simulation, but for gain and phase of each transducer, for a scale that
    all readings share, for steps towards variants of the scene, and for errors of single entries.

    Attributes:
        transfer_matrix: G (P, M) [Pa] of the simulation; None for the one that the objective has: a
            `SimulatedObjective`, also within perturbations, or a `HardwareObjective` to which it was given.
        variants: transfer matrices (K, P, M) [Pa] of the scene as it may also be, each simulated with one
            change of the size that is to be expected: an obstacle 2 mm aside, the air 5 K warmer.
        gain: standard deviation of the logarithm of a transducer's gain, > 0.
        phase: of a transducer's phase [rad], > 0.
        rest: of an entry, > 0, in rms entries of its row.

    Raises:
        ValueError: a value out of range.
    """

    transfer_matrix: torch.Tensor | None = None
    variants: torch.Tensor | None = None
    gain: float = 0.1
    phase: float = 0.5
    rest: float = 0.15

    def __post_init__(self) -> None:
        """Check the values."""
        if self.transfer_matrix is not None:
            matrix = complex_tensor("transfer_matrix", self.transfer_matrix).detach().cpu()
            if matrix.ndim != 2:
                raise ValueError(f"transfer_matrix: shape {tuple(matrix.shape)}; must be (P, M)")
            object.__setattr__(self, "transfer_matrix", matrix)
        if self.variants is not None:
            object.__setattr__(self, "variants", complex_tensor("variants", self.variants).detach().cpu())
        object.__setattr__(self, "gain", positive("gain", self.gain))
        object.__setattr__(self, "phase", positive("phase", self.phase, "rad"))
        object.__setattr__(self, "rest", positive("rest", self.rest))

    @classmethod
    def of(cls, name: str, value: object) -> Prior | None:
        """Return a prior, or None, of what a setting holds; a mapping has the settings of a prior."""
        if value is None or isinstance(value, Prior):
            return value
        if isinstance(value, Mapping):
            require_known(name, value, [field.name for field in fields(cls)])
            return cls(**value)
        accepted = "must be a Prior, a mapping of its settings, or None"
        raise invalid(name, value, accepted)

    def of_matrix(self, problem: Problem) -> MatrixPrior:
        """Return the prior of the transfer matrix of a problem."""
        matrix = self.simulated(problem)
        each = torch.ones(problem.transducers, dtype=torch.float64, device="cpu")
        changes = matrix.new_empty(0, *matrix.shape) if self.variants is None else self.variants - matrix
        widths = torch.cat(
            [self.gain * each, self.phase * each, _SCALE * each[:1], each.new_ones(len(changes))]
        )
        return MatrixPrior(matrix, self.rest * matrix.abs().square().mean(dim=1).sqrt(), widths, changes)

    def simulated(self, problem: Problem) -> torch.Tensor:
        """Return the simulated matrix (P, M) for a problem."""
        matrix = problem.transfer_matrix if self.transfer_matrix is None else self.transfer_matrix
        if matrix is None:
            raise invalid("prior.transfer_matrix", None, "must be given where the objective has none")
        shape = problem.foci, problem.transducers
        if matrix.shape != shape:
            raise ValueError(f"prior.transfer_matrix: shape {tuple(matrix.shape)}; must be {shape}")
        if self.variants is not None and (self.variants.ndim != 3 or self.variants.shape[1:] != shape):
            accepted = f"must be (K, {shape[0]}, {shape[1]})"
            raise ValueError(f"prior.variants: shape {tuple(self.variants.shape)}; {accepted}")
        return matrix
