"""Multiple scattering between bodies apart, each a linear map from incoming to outgoing waves.

With maps T_i, incident waves d_i and the waves S_ij b_j that body j sends to body i, the outgoing waves are
b_i = T_i (d_i + sum_j S_ij b_j) (Waterman and Truell 1961, doi:10.1063/1.1703737). Matrices are solved for;
maps that cost a run are iterated. A pass of the iteration adds one scattering order. The sums follow
x_(n+1) = T x_n + b like the phasors of a run, and are extrapolated in the same way; weakly coupled bodies
need three or four passes. Later passes contribute little, and are simulated to looser tolerances.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import Protocol, Self

import numpy as np
import torch

from autdtorch.fdtd.grouping import MOST_PASSES
from autdtorch.fdtd.steady_state import Extrapolation, SteadyState
from autdtorch.utils.array_types import COMPLEX, REAL

logger = logging.getLogger(__name__)

_LOOSEST = 0.1
"""Largest tolerance of a run, relative to its pass."""

_CAUTION = 2.0
"""Safety factor: neglected scattering orders are estimated as this many times the next one."""

Observe = Callable[[torch.Tensor], Sequence[torch.Tensor]]
"""Observe: maps phasors (k,) or (k, R) to the quantities that must all converge."""


class Scatterer(Protocol):
    """A body whose answers are simulated, as phasors (k, R) of some of its cells."""

    def answers(self, incoming: torch.Tensor, tolerances: Sequence[float]) -> list[SteadyState]:
        """Simulate the answers to incoming waves (n, R) of R runs."""
        ...

    def outgoing(self, phasors: torch.Tensor) -> torch.Tensor:
        """Return outgoing waves (m, R) of phasors (k, R)."""
        ...

    def incoming(self, other: Self, outgoing: torch.Tensor) -> torch.Tensor | None:
        """Return the waves (n, R) that come in from outgoing ones (m, R); None from a body to itself.

        With reflectors, waves of a body come back to it.
        """
        ...


def solved(
    maps: Sequence[torch.Tensor], between: Sequence[Sequence[torch.Tensor]], incident: Sequence[torch.Tensor]
) -> torch.Tensor:
    """Return the outgoing waves (N, M) of all bodies, given their maps T_i (n, n) and S_ij as matrices.

    `incident` are the waves (n, M) on each body. The diagonal of `between`, the waves that come back from a
    body, is 0 without reflectors.
    """
    alone = torch.cat([matrix @ waves for matrix, waves in zip(maps, incident, strict=True)])
    if len(maps) == 1 and not between[0][0].any():
        return alone
    rows = [torch.cat(list(row), dim=1) for row in between]
    coupled = torch.cat([matrix @ row for matrix, row in zip(maps, rows, strict=True)])
    outgoing: torch.Tensor = torch.linalg.solve(torch.eye(len(alone), **COMPLEX) - coupled, alone)
    return outgoing


def iterated(
    bodies: Sequence[Scatterer],
    incident: Sequence[torch.Tensor],
    observe: Observe,
    floors: torch.Tensor,
    tolerance: float,
) -> list[tuple[SteadyState, float]]:
    """Iterate until all that is observed of R runs has converged; return nothing without convergence.

    `incident` are the waves (n, R) on each body. Half of the relative tolerance is for the runs, half for the
    iteration. `observe` maps the phasors (K, R) of all bodies to quantities (k, R), Q of them; changes are
    relative to their norms, or to `floors` (Q, R) if those are more. The result is the phasors and the
    seconds of each run.
    """
    begin, runs, incoming = time.perf_counter(), incident[0].shape[1], list(incident)
    largest = torch.stack([waves.norm(dim=0) for waves in incident]).amax(dim=0)
    sequences = [Extrapolation(MOST_PASSES) for _ in range(runs)]
    periods, reached, unsettled = np.zeros(runs, np.int64), np.ones(runs, bool), torch.zeros(runs, **REAL)
    sums: torch.Tensor | None = None
    before: list[torch.Tensor] = []
    smaller: torch.Tensor | None = None
    for number in range(1, MOST_PASSES + 1):
        parts, residuals = [], torch.zeros((len(bodies), runs), **REAL)
        for index, (body, waves) in enumerate(zip(bodies, incoming, strict=True)):
            share = waves.norm(dim=0) / largest
            looser = (tolerance / 2 ** (number + 1) / share).clamp(max=_LOOSEST)  # half of it in all passes
            steady = body.answers(waves, looser.tolist())
            parts.append(torch.stack([each.pressure for each in steady], dim=1))
            periods += [each.periods for each in steady]
            reached &= [each.converged for each in steady]
            residuals[index] = share * torch.tensor([each.residual for each in steady], **REAL)
        unsettled += residuals.amax(dim=0)
        order = torch.cat(parts)
        sums = order if sums is None else sums + order
        for sequence, column in zip(sequences, sums.mT.numpy(), strict=True):
            sequence.append(column)
        phasors = torch.from_numpy(np.stack([sequence.limit() for sequence in sequences], axis=1))
        outgoing = [body.outgoing(part) for body, part in zip(bodies, parts, strict=True)]
        size, values = torch.cat(outgoing).norm(dim=0), observe(phasors)
        before = before or list(observe(torch.zeros_like(phasors)))
        changes = [
            (value - last).norm(dim=0) / torch.maximum(value.norm(dim=0), floor)
            for value, last, floor in zip(values, before, floors, strict=True)
        ]
        change = torch.stack(changes).amax(dim=0)
        if smaller is not None:
            remaining = _CAUTION * change * (size / smaller).clamp(max=1)
            if (remaining <= tolerance / 2).all():
                seconds = (time.perf_counter() - begin) / runs
                logger.debug("%d boxes, %d passes of multiple scattering", len(bodies), number)
                residual = (unsettled + remaining).tolist()
                states = map(SteadyState, phasors.mT, periods.tolist(), residual, reached.tolist())
                return [(state, seconds) for state in states]
        before, smaller = list(values), size
        sent = list(zip(bodies, outgoing, strict=True))
        parts_of = ([body.incoming(other, waves) for other, waves in sent] for body in bodies)
        incoming = [torch.stack([part for part in each if part is not None]).sum(dim=0) for each in parts_of]
    return []
