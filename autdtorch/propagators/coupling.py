"""The multiple-scattering iteration between boxes.

In each pass every box is simulated, driven by the field that the others radiated in the pass before. A pass
adds one scattering order. The sums follow x_(n+1) = T x_n + b like the phasors of a run, and are extrapolated
in the same way; weakly coupled boxes need three or four passes. Later passes contribute little, and are
simulated to looser tolerances.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from autdtorch.fdtd.scattered_field import NearToFar, ScatteredField
from autdtorch.fdtd.steady_state import Extrapolation, SteadyState
from autdtorch.propagators.grids import MOST_PASSES

logger = logging.getLogger(__name__)

_LOOSEST = 0.1
"""Largest tolerance of a run, relative to its pass."""

_CAUTION = 2.0
"""Safety factor: neglected scattering orders are estimated as this many times the next one."""

Observe = Callable[[torch.Tensor], torch.Tensor]
"""Computes the quantity that must converge from phasors of cells."""

Simulate = Callable[[int, torch.Tensor, float, Observe], SteadyState]
"""Simulates a box, given its index, the incident field (n,), the tolerance and the observed quantity."""


def coupled_runs(
    boxes: Sequence[ScatteredField],
    transforms: Sequence[NearToFar],
    driving: Sequence[torch.Tensor],
    pressure: Observe,
    simulate: Simulate,
    tolerance: float,
) -> list[tuple[SteadyState, float]] | None:
    """Iterate until the pressure at the receivers has converged.

    Args:
        boxes: boxes whose interiors do not overlap.
        transforms: near-to-far-field transform of each box to the receivers.
        driving: incident field (n, R) of R runs, where it drives each box.
        pressure: computes the pressure (P, R) at the receivers from the phasors (k, R) of all boxes' cells.
        simulate: simulates one box.
        tolerance: relative; half of it is for the runs and half for the iteration.

    Returns:
        Phasors of all boxes' cells and seconds for each of R runs; None without convergence in `MOST_PASSES`.
    """
    begin = time.perf_counter()
    runs = driving[0].shape[1]
    largest = torch.stack([field.norm(dim=0) for field in driving]).amax(dim=0)
    sums = torch.zeros((), dtype=torch.complex128, device="cpu")
    sequences = [Extrapolation(MOST_PASSES) for _ in range(runs)]
    periods, reached = np.zeros(runs, np.int64), np.ones(runs, bool)
    cells = sum(len(transform.cells) for transform in transforms)
    value, size = pressure(driving[0].new_zeros((cells, runs))), None
    left = torch.zeros(runs, dtype=torch.float64, device="cpu")
    for number in range(1, MOST_PASSES + 1):
        parts = []
        own = tolerance / 2 ** (number + 1)  # half the tolerance in all passes
        unsettled = torch.zeros((len(boxes), runs), dtype=torch.float64, device="cpu")
        for index, field in enumerate(driving):
            share = field.norm(dim=0) / largest
            loose = (own / share).clamp(max=_LOOSEST).tolist()
            observe = transforms[index].amplitudes
            pairs = zip(field.mT, loose, strict=True)
            steady = [simulate(index, column, each, observe) for column, each in pairs]
            parts.append(torch.stack([each.pressure for each in steady], dim=1))
            periods += [each.periods for each in steady]
            reached &= [each.converged for each in steady]
            remaining = [each.residual for each in steady]
            unsettled[index] = share * torch.tensor(remaining, dtype=torch.float64, device="cpu")
        left += unsettled.amax(dim=0)
        sums = sums + torch.cat(parts)
        for sequence, column in zip(sequences, sums.mT.numpy(), strict=True):
            sequence.append(column)
        phasors = torch.from_numpy(np.stack([sequence.limit() for sequence in sequences], axis=1))
        amplitudes = [transform.amplitudes(part) for transform, part in zip(transforms, parts, strict=True)]
        before, value = value, pressure(phasors)
        smaller, size = size, torch.cat(amplitudes).norm(dim=0)
        change = (value - before).norm(dim=0) / value.norm(dim=0).clamp(min=torch.finfo(torch.float64).tiny)
        if smaller is not None:
            remaining = _CAUTION * change * (size / smaller).clamp(max=1)
            if (remaining <= tolerance / 2).all():
                seconds = (time.perf_counter() - begin) / runs
                logger.debug("%d boxes, %d passes of multiple scattering", len(boxes), number)
                return [
                    (SteadyState(column, int(count), float(distance), bool(every)), seconds)
                    for column, count, distance, every in zip(
                        phasors.mT, periods, left + remaining, reached, strict=True
                    )
                ]
        driving = [_from_others(boxes, index, amplitudes) for index in range(len(boxes))]
    return None


def _from_others(
    boxes: Sequence[ScatteredField], index: int, amplitudes: Sequence[torch.Tensor]
) -> torch.Tensor:
    """The field (n, R) that the other boxes radiate, where it drives a box."""
    others = [number for number in range(len(boxes)) if number != index]
    places = boxes[index].driven
    return torch.stack([boxes[number].radiated(amplitudes[number], places) for number in others]).sum(dim=0)
