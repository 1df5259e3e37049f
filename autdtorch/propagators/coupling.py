"""Boxes that hear each other: each simulated again and again, driven by what the others radiated.

A pass adds what was scattered once more. The sums follow x_(n+1) = T x_n + b as the phasors of a run do, and
are extrapolated alike; boxes that hear little of each other need no more than three passes or four. What a
later pass simulates is a small part of the whole, and may be as much less accurate.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.fdtd.scattered_field import NearToFar, ScatteredField
from autdtorch.fdtd.steady_state import Extrapolation, SteadyState
from autdtorch.propagators.groups import MOST_PASSES

logger = logging.getLogger(__name__)

_LOOSEST = 0.1
"""Tolerance of a run, relative to the pass, however small the pass."""

_CAUTION = 2.0
"""How many times the next pass all that are left out are taken to be."""

Simulate = Callable[[int, torch.Tensor, float], SteadyState]
"""Run of a box, by its index, the field (n,) that drives it and its tolerance."""


@dataclass(frozen=True)
class Coupled:
    """A run in several boxes.

    Attributes:
        steady: phasors of all boxes' cells, one box after the other, and how sure they are.
        seconds: time it took.
    """

    steady: SteadyState
    seconds: float


def coupled_runs(
    boxes: Sequence[ScatteredField],
    reaches: Sequence[NearToFar],
    driving: Sequence[torch.Tensor],
    heard: Callable[[torch.Tensor], torch.Tensor],
    simulate: Simulate,
    tolerance: float,
) -> list[Coupled] | None:
    """Simulate boxes in passes until what is heard stands.

    Args:
        boxes: whose interiors do not overlap.
        reaches: of each box to the targets.
        driving: incident field (n, R) of R runs, where it drives each box.
        heard: pressure (P, R) at the targets, from the phasors (k, R) of all boxes' cells.
        simulate: runs one box.
        tolerance: relative; half of it is the runs' and half the coupling's.

    Returns:
        R runs, or None if they do not settle in `MOST_PASSES`.
    """
    begin = time.perf_counter()
    runs = driving[0].shape[1]
    largest = torch.stack([field.norm(dim=0) for field in driving]).amax(dim=0)
    sums = torch.zeros((), dtype=torch.complex128, device="cpu")
    sequences = [Extrapolation(MOST_PASSES) for _ in range(runs)]
    periods, reached = np.zeros(runs, np.int64), np.ones(runs, bool)
    cells = sum(len(reach.cells) for reach in reaches)
    value, size = heard(driving[0].new_zeros((cells, runs))), None
    left = torch.zeros(runs, dtype=torch.float64, device="cpu")
    for number in range(1, MOST_PASSES + 1):
        parts = []
        own = tolerance / 2 ** (number + 1)  # half the tolerance in all passes
        unsettled = torch.zeros((len(boxes), runs), dtype=torch.float64, device="cpu")
        for index, field in enumerate(driving):
            share = field.norm(dim=0) / largest
            loose = (own / share).clamp(max=_LOOSEST).tolist()
            steady = [simulate(index, column, each) for column, each in zip(field.mT, loose, strict=True)]
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
        amplitudes = [reach.amplitudes(part) for reach, part in zip(reaches, parts, strict=True)]
        before, value = value, heard(phasors)
        smaller, size = size, torch.cat(amplitudes).norm(dim=0)
        change = (value - before).norm(dim=0) / value.norm(dim=0).clamp(min=torch.finfo(torch.float64).tiny)
        if smaller is not None:
            remaining = _CAUTION * change * (size / smaller).clamp(max=1)
            if (remaining <= tolerance / 2).all():
                seconds = (time.perf_counter() - begin) / runs
                logger.info("%d boxes, coupled in %d passes", len(boxes), number)
                return [
                    Coupled(SteadyState(column, int(count), float(distance), bool(stands)), seconds)
                    for column, count, distance, stands in zip(
                        phasors.mT, periods, left + remaining, reached, strict=True
                    )
                ]
        driving = [_from_others(boxes, index, amplitudes) for index in range(len(boxes))]
    return None


def _from_others(
    boxes: Sequence[ScatteredField], index: int, amplitudes: Sequence[torch.Tensor]
) -> torch.Tensor:
    """What the other boxes radiate (n, R), where it drives a box."""
    others = [number for number in range(len(boxes)) if number != index]
    places = boxes[index].driven
    return torch.stack([boxes[number].radiated(amplitudes[number], places) for number in others]).sum(dim=0)
