"""Multiple scattering between bodies apart, each a linear map from incoming to outgoing waves.

Body i has the map T_i and the incident waves d_i, and body j sends it the waves S_ij b_j. The outgoing waves
are b_i = T_i (d_i + sum_j S_ij b_j) (Waterman and Truell 1961, doi:10.1063/1.1703737). Here each map costs a
run; for T-matrices see `tmatrix.coupling`. A pass of the iteration adds one scattering order, and the orders
are combined by the least residual (`extrapolated`); weakly coupled bodies need three or four passes. Later
passes contribute little, and are simulated to looser tolerances.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from autdtorch.fdtd.grouping import MOST_PASSES
from autdtorch.fdtd.resonances import Resonance
from autdtorch.fdtd.steady_state import Observe, SteadyState
from autdtorch.propagators.box_scatterer import BoxScatterer
from autdtorch.utils.array_types import REAL

logger = logging.getLogger(__name__)

_LOOSEST = 0.1
"""Largest tolerance of a run, relative to its pass."""

_CAUTION = 2.0
"""Safety factor: what the orders so far leave is estimated as this many times their residual."""

_TINY = torch.finfo(torch.float64).tiny

_TOGETHER = 16
"""Most runs whose orders are combined."""

_MOST_FITTED = 4096
"""Most cells whose phasors decide the weights of orders."""

_NOISE = 1e-4
"""Singular values, relative to the largest, that are noise of runs: those of orders without news."""


def iterated(
    bodies: Sequence[BoxScatterer],
    incident: Sequence[torch.Tensor],
    observe: Observe,
    floors: torch.Tensor,
    tolerance: float,
) -> tuple[list[SteadyState], bool]:
    """Iterate until all that is observed of R runs has converged, or `MOST_PASSES` have passed.

    `incident` are the waves (n, R) on each body. Half of the relative tolerance is for the runs, half for the
    iteration. `observe` maps the phasors (K, R) of all bodies to quantities (k, R), Q of them; changes are
    relative to their norms, or to `floors` (Q, R) if those are more. The result is the phasors of each run,
    and whether the iteration has converged.
    """
    runs, incoming = incident[0].shape[1], list(incident)
    numbers = np.arange(runs)
    largest = torch.stack([waves.norm(dim=0) for waves in incident]).amax(dim=0).clamp_min(_TINY)
    periods, reached, unsettled = np.zeros(runs, np.int64), np.ones(runs, bool), torch.zeros(runs, **REAL)
    orders: list[torch.Tensor] = []
    rung: list[list[tuple[Resonance, ...]]] = []  # by body and run
    settled = False
    for number in range(1, MOST_PASSES + 1):
        parts, residuals = [], torch.zeros((len(bodies), runs), **REAL)
        for index, (body, waves) in enumerate(zip(bodies, incoming, strict=True)):
            share = waves.norm(dim=0) / largest
            looser = (tolerance / 2 ** (number + 1) / share).clamp(max=_LOOSEST)  # half of it in all passes
            steady = body.answers(waves, looser.tolist())
            parts.append(torch.stack([each.pressure for each in steady], dim=1).cpu())
            if number == 1:
                rung.append([each.resonances for each in steady])
            periods += [each.periods for each in steady]
            reached &= [each.converged for each in steady]
            residuals[index] = share * torch.tensor([each.residual for each in steady], **REAL)
        unsettled += residuals.amax(dim=0)
        orders.append(torch.cat(parts))
        if number == 1:
            silent = observe(torch.zeros_like(orders[0]), numbers)
            heard = [(observe(alone, numbers)[0] - silent[0]).norm(dim=0) for alone in _alone(parts)]
        else:
            phasors, remaining = _combined(orders, observe, silent, floors)
            settled = bool((remaining <= tolerance / 2).all())
            if settled or number == MOST_PASSES:
                break
        sent = [(body, body.outgoing(part)) for body, part in zip(bodies, parts, strict=True)]
        parts_of = ([body.incoming(other, waves) for other, waves in sent] for body in bodies)
        incoming = [torch.stack([part for part in each if part is not None]).sum(dim=0) for each in parts_of]
    logger.debug("%d boxes, %d passes of multiple scattering", len(bodies), number)
    residual = (unsettled + remaining).tolist()
    reached &= (remaining <= tolerance / 2).numpy()
    whole = torch.maximum(observe(phasors, numbers)[0].norm(dim=0), floors[0]).clamp_min(_TINY)
    resonances = _shared(rung, [(part / whole).tolist() for part in heard])
    states = map(SteadyState, phasors.mT, periods.tolist(), residual, reached.tolist(), resonances)
    return list(states), settled


def _combined(
    orders: Sequence[torch.Tensor], observe: Observe, silent: Sequence[torch.Tensor], floors: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the phasors (K, R) of R runs from two or more orders, and what the later ones would add (R,).

    The latter is relative to what is observed, or to the `floors`; `silent` is observed without waves.
    """
    phasors, left = extrapolated(orders)
    numbers = np.arange(phasors.shape[1])
    observed = zip(observe(left, numbers), silent, observe(phasors, numbers), floors, strict=True)
    missing = [
        (part - nothing).norm(dim=0) / torch.maximum(value.norm(dim=0), floor)
        for part, nothing, value, floor in observed
    ]
    # what K adds to the first order is a measure of what it adds to the residual
    echo = (phasors - orders[0]).norm(dim=0) / orders[0].norm(dim=0).clamp_min(_TINY)
    return phasors, _CAUTION * torch.stack(missing).amax(dim=0) * echo


def _alone(parts: Sequence[torch.Tensor]) -> Iterator[torch.Tensor]:
    """Yield the phasors (K, R) of all bodies where only one radiates, from those of each."""
    for index in range(len(parts)):
        yield torch.cat([part if n == index else torch.zeros_like(part) for n, part in enumerate(parts)])


def _shared(
    rung: Sequence[Sequence[tuple[Resonance, ...]]], shares: Sequence[Sequence[float]]
) -> list[tuple[Resonance, ...]]:
    """Return the resonances in each run, from those of each body and its shares (B, R) of the pressures.

    A resonance has the same part in the pressure of a body at the points as in the waves that leave its box.
    """
    runs: list[list[Resonance]] = [[] for _ in shares[0]]
    for bodies, heard in zip(rung, shares, strict=True):
        for run, resonances, share in zip(runs, bodies, heard, strict=True):
            run += [each._replace(strength=share * each.strength) for each in resonances]
    return list(map(tuple, runs))


def extrapolated(orders: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sum of all scattering orders (k, R) of R runs from two or more, and what it leaves (k, R).

    With x_(n+1) = K x_n, the sum is b = x_0 + K b. The combination v of the orders of all runs with the least
    residual x_0 + K v - v is passed through K once more (generalised minimal residuals, Saad and Schultz
    1986). Of many runs, each is combined from its orders alone.
    """
    count, runs = orders[0].shape
    if runs > _TOGETHER:
        each = [extrapolated([order[:, [run]] for order in orders]) for run in range(runs)]
        sums, left = zip(*each, strict=True)
        return torch.cat(sums, dim=1), torch.cat(left, dim=1)
    some = slice(None, None, -(-count // _MOST_FITTED))
    sources, answers = torch.cat(list(orders[:-1]), dim=1), torch.cat(list(orders[1:]), dim=1)
    size = sources[some].norm(dim=0).clamp_min(_TINY)
    change = (sources - answers) / size
    fitted = np.linalg.lstsq(change[some].numpy(), orders[0][some].numpy(), rcond=_NOISE)[0]
    weights = torch.from_numpy(fitted)
    return orders[0] + answers / size @ weights, orders[0] - change @ weights
