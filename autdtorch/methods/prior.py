"""A simulated transfer matrix as the prior of a measurement."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import torch

from autdtorch.methods.gradient import highest_drive
from autdtorch.methods.linearised_readings import NUMBERS_AT_ONCE
from autdtorch.methods.matrix_posterior import MatrixPrior
from autdtorch.methods.problem import Problem
from autdtorch.objectives.objective import validate_matrix
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import (
    complex_tensor,
    invalid,
    number_between,
    positive,
    require_known,
    within,
)

_LEAST_WIDTH = 1e-6  # of gain, phase and rest
_DARK = 1e-2  # least rms entry of a row, relative to the strongest row's: simulated shadows are deep

_TURN = 1.8  # standard deviation of the phase between readings and simulation, which may be any [rad]
_SCALE = 0.3
"""Standard deviation of the logarithm of the scale between readings and simulation, after a first scaling by
the first reading."""


@dataclass(frozen=True, eq=False)
class Prior:
    """A simulated transfer matrix, and how far to trust it as one of the measured device.

    The measured matrix differs from the simulated one by gain and phase of each transducer and by a scale of
    all readings. Variants of the scene add steps towards them, and single entries have errors.

    Attributes:
        transfer_matrix: G (P, M) [Pa] of the simulation; None for the one that the objective has: a
            `SimulatedObjective`, also within perturbations, or a `HardwareObjective` made with one.
        variants: transfer matrices (K, P, M) [Pa] of the scene as it may also be, each simulated with one
            change of the size that is to be expected: an obstacle 2 mm aside, the air 5 K warmer. For
            `calibrate` also names of changes with their standard deviations, such as ``{"obstacles.x": 2e-3,
            "temperature": 5.0}``. Names are `x`, `y`, `z` [m] and `turn_x`, `turn_y`, `turn_z` [rad] of
            `obstacles` (all as one body), `obstacles[i]` and `array`; `x`, `y`, `z` [m] of `points` and
            `points[i]`; `reflectors[i].distance` [m]; `temperature` [K]; `radius` [m] of transducers.
        gain: standard deviation of the logarithm of a transducer's gain, 1e-6 to 3.
        phase: of a transducer's phase [rad], 1e-6 to 2 pi.
        rest: of an entry, in rms entries of its row, 1e-6 to 10.

    Raises:
        ValueError: a value out of range.
    """

    transfer_matrix: torch.Tensor | None = field(default=None, repr=False)
    variants: torch.Tensor | Mapping[str, float] | None = field(default=None, repr=False)
    gain: float = 0.1
    phase: float = 0.5
    rest: float = 0.15

    def __post_init__(self) -> None:
        if self.transfer_matrix is not None:
            matrix = complex_tensor("transfer_matrix", self.transfer_matrix).detach().cpu()
            if matrix.ndim != 2:
                raise ValueError(f"transfer_matrix: shape {tuple(matrix.shape)}; must be (P, M)")
            object.__setattr__(self, "transfer_matrix", matrix)
        if isinstance(self.variants, Mapping):
            widths = {name: positive(f"variants[{name!r}]", width) for name, width in self.variants.items()}
            object.__setattr__(self, "variants", widths)
        elif self.variants is not None:
            variants = complex_tensor("variants", self.variants).detach().cpu()
            if variants.ndim != 3:
                raise ValueError(f"variants: shape {tuple(variants.shape)}; must be (K, P, M)")
            object.__setattr__(self, "variants", variants)
        for name, most, unit in (("gain", 3.0, ""), ("phase", 2 * math.pi, "rad"), ("rest", 10.0, "")):
            value = number_between(name, getattr(self, name), _LEAST_WIDTH, most, unit)
            object.__setattr__(self, name, value)


def prior_of(name: str, value: object) -> Prior | None:
    """Return the prior, or None, that a setting means; a mapping of a config has the fields of a prior."""
    if value is None or isinstance(value, Prior):
        return value
    if isinstance(value, Mapping):
        require_known(name, value, [setting.name for setting in fields(Prior)])
        with within(name):
            return Prior(**value)
    raise invalid(name, value, "must be a Prior, a mapping of its settings, or None")


def prior_mean(prior: Prior, problem: Problem) -> torch.Tensor:
    """Return the simulated matrix (P, M) [Pa], after checking the prior against the problem."""
    matrix = problem.transfer_matrix if prior.transfer_matrix is None else prior.transfer_matrix
    if matrix is None:
        raise invalid("prior.transfer_matrix", None, "must be given where the objective has none")
    shape = problem.foci, problem.transducers
    matrix = validate_matrix("prior.transfer_matrix", matrix, *shape)
    if not matrix.any():
        raise invalid("prior.transfer_matrix", 0, "must not be 0 throughout")
    if isinstance(prior.variants, Mapping):
        accepted = "must be transfer matrices (K, P, M) here; calibrate takes names, and gives a prior"
        raise invalid("prior.variants", [*prior.variants], accepted)
    if prior.variants is not None and prior.variants.shape[1:] != shape:
        accepted = f"must be (K, {shape[0]}, {shape[1]})"
        raise ValueError(f"prior.variants: shape {tuple(prior.variants.shape)}; {accepted}")
    return matrix


def matrix_prior(prior: Prior, problem: Problem) -> MatrixPrior:
    """Return the Gaussian prior of the transfer matrix of a problem."""
    matrix = prior_mean(prior, problem)
    changes = matrix.new_empty(0, *matrix.shape)
    if isinstance(prior.variants, torch.Tensor):
        changes = prior.variants - matrix
    return gaussian_prior(prior, matrix, changes, torch.ones(len(changes), **REAL))


def numbers_of_factors(prior: Prior, problem: Problem) -> float:
    """Return how many numbers a fit from a prior holds for the factors that all points share."""
    variants = 0 if prior.variants is None else len(prior.variants)
    factors = 2 * problem.transducers + 2 + variants
    return 3.0 * factors**2 + 3 * NUMBERS_AT_ONCE


def gaussian_prior(
    prior: Prior,
    matrix: torch.Tensor,
    changes: torch.Tensor,
    widths: torch.Tensor,
    amounts: torch.Tensor | None = None,
) -> MatrixPrior:
    """Return the Gaussian prior around a simulated matrix (P, M) [Pa].

    Args:
        prior: trust in the simulation.
        matrix: simulated with some amounts of changes.
        changes: derivatives (K, P, M) of the matrix there.
        widths: standard deviations of the amounts (K,).
        amounts: those of the matrix (K,); None for 0.
    """
    each = torch.ones(matrix.shape[1], **REAL)
    entries = matrix.abs().square().mean(dim=1).sqrt()
    spread = prior.rest * entries.clamp_min(_DARK * float(entries.max()))
    rows = matrix if amounts is None else matrix - (amounts[:, None, None] * changes).sum(dim=0)
    of_all = each.new_tensor([_SCALE, _TURN])
    return MatrixPrior(
        rows, spread, torch.cat([prior.gain * each, prior.phase * each, of_all, widths]), changes
    )


def best_simulated_drives(
    prior: Prior, problem: Problem, generators: Sequence[torch.Generator]
) -> torch.Tensor:
    """Return drives (T, M) that focus best in the simulation, one for each generator of random starts."""
    matrix = prior_mean(prior, problem)
    return torch.stack([highest_drive(problem.goal, matrix, draws) for draws in generators])
