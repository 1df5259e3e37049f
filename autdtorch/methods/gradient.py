"""Gradient ascent on the weakest focus, through a transfer matrix that is known.

No method that sees magnitudes only can do this on a real array: it is a line to compare them with.
"""

from __future__ import annotations

import math

import torch

from autdtorch.methods.base import Ledger, Solution, Trials, trial_seeds
from autdtorch.objectives.simulated import Objective, weakest_focus
from autdtorch.utils.threads import one_torch_thread
from autdtorch.utils.validation import integer_at_least, invalid

# From first to last in equal ratios: temperature of the smooth minimum, in mean pressures of the foci, and
# step, in largest amplitudes.
_TEMPERATURE = (0.3, 1e-4)
_STEP = (0.5, 0.005)
_MOMENTUM = 0.9
_TINY = 1e-300


def gradient_ascent(
    objective: Objective, starts: int = 32, steps: int = 300, trials: Trials = 1, seed: int = 0
) -> Solution:
    """Climb the weakest focus over all drives of amplitudes <= 1, by the objective's transfer matrix.

    A trial climbs from `starts` drives of random phases and evaluates where it came highest: one evaluation.
    With 16 transducers that is the global maximum nearly always, less 1e-4; a few hundred want more `steps`.

    Args:
        objective: simulated, with a `transfer_matrix`.
        starts: drives that a trial starts from, >= 1.
        steps: of each climb, >= 2.
        trials: number of trials T, >= 1, or their numbers.
        seed: >= 0; trial t is the same for every number of trials.

    Returns:
        The drive of each trial.

    Raises:
        ValueError: an argument out of range, or an objective without a transfer matrix.
    """
    starts = integer_at_least("starts", starts, 1)
    steps = integer_at_least("steps", steps, 2)
    seeds = trial_seeds(seed, trials)
    ledger = Ledger(objective, len(seeds), weakest_focus)
    ledger.require_memory(steps, 2.0 * starts, steps=steps, starts=starts)
    matrix = getattr(objective, "transfer_matrix", None)
    if matrix is None:
        raise invalid(
            "objective",
            objective,
            'must have a transfer matrix, as SimulatedObjective has in mode "transfer"',
        )
    generators = [torch.Generator("cpu").manual_seed(own) for own in seeds]
    highest = [climb(matrix, random_drives(starts, matrix.shape[1], own), steps) for own in generators]
    ledger.evaluate(torch.stack(highest)[:, None])
    return ledger.solution()


def random_drives(count: int, transducers: int, generator: torch.Generator) -> torch.Tensor:
    """Drives (count, M) of amplitudes 1 and random phases."""
    phases = (
        2 * math.pi * torch.rand(count, transducers, dtype=torch.float64, generator=generator, device="cpu")
    )
    return torch.polar(torch.ones_like(phases), phases)


@one_torch_thread()
def climb(matrix: torch.Tensor, drive: torch.Tensor, steps: int) -> torch.Tensor:
    """The drive of the strongest weakest focus that projected gradient ascent with momentum finds.

    What is climbed is a smooth minimum, -T log sum_p exp(-|p_p| / T), whose temperature T falls until
    it is the minimum.

    Args:
        matrix: transfer matrix (P, M), complex128.
        drive: where to start (S, M).
        steps: >= 2.

    Returns:
        Drive (M,), amplitudes <= 1.
    """
    velocity = torch.zeros_like(drive)
    for progress in torch.linspace(0, 1, steps, dtype=torch.float64, device="cpu").tolist():
        temperature, step = (first * (last / first) ** progress for first, last in (_TEMPERATURE, _STEP))
        pressure = _pressure(matrix, drive)
        magnitude = pressure.abs()
        hardness = 1 / (temperature * magnitude.mean(dim=-1, keepdim=True)).clamp_min(_TINY)
        weights = torch.softmax(-magnitude * hardness, dim=-1)
        slope = ((weights * pressure.sgn())[..., None] * matrix.conj()).sum(dim=-2)
        slope = slope / slope.abs().mean(dim=-1, keepdim=True).clamp_min(_TINY)
        velocity = _MOMENTUM * velocity + (1 - _MOMENTUM) * slope
        drive = drive + step * velocity
        drive = drive / drive.abs().clamp_min(1)
    return drive[weakest_focus(_pressure(matrix, drive).abs()).argmax()]


def _pressure(matrix: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    return (drive[:, None] * matrix).sum(dim=-1)
