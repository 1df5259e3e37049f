"""Points of Bayesian optimisation: the phases of all transducers but a fixed one, in turns."""

from __future__ import annotations

import math

import torch

from autdtorch.scene.drive import drive_from_phases, phases_of
from autdtorch.utils.validation import integer_at_least, invalid


def require_transducer(fixed_transducer: int, transducers: int) -> None:
    """Check that an array has at least two transducers, and that one has the index."""
    integer_at_least("transducers of the objective's array", transducers, 2)
    if not 0 <= fixed_transducer < transducers:
        raise invalid("fixed_transducer", fixed_transducer, f"must be an integer from 0 to {transducers - 1}")


def fixed_last(transducers: int, fixed_transducer: int) -> list[int]:
    """Return the indices of all transducers, the fixed one at the end."""
    return [*(index for index in range(transducers) if index != fixed_transducer), fixed_transducer]


def points_of(drives: torch.Tensor, fixed_transducer: int) -> torch.Tensor:
    """Return points (..., M - 1) in turns with the phases of drives (..., M), relative to the fixed one."""
    phases = phases_of(drives)
    points = (phases - phases[..., [fixed_transducer]]) / (2 * math.pi) % 1
    return points[..., fixed_last(drives.shape[-1], fixed_transducer)[:-1]]


def drives_at(points: torch.Tensor, fixed_transducer: int) -> torch.Tensor:
    """Return drives (..., M) of points (..., M - 1) in turns; the fixed transducer has phase 0."""
    before, after = points[..., :fixed_transducer], points[..., fixed_transducer:]
    turns = torch.cat([before, torch.zeros_like(points[..., :1]), after], dim=-1)
    return drive_from_phases(2 * math.pi * turns)


def sobol_points(count: int, dimensions: int, seed: int) -> torch.Tensor:
    """Return the first points (count, dimensions) of a scrambled Sobol sequence."""
    sequence = torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=seed)  # type: ignore[no-untyped-call]
    points = sequence.draw(count, dtype=torch.float64)
    points[0] = sequence.shift.double() / 2**sequence.MAXBIT  # the engine rounds it to PyTorch's default
    return points
