"""Runs of a fixed number of periods, which end before the steady state.

Their fields are some per cent from it. For sources that hardly differ, these errors hardly differ either:
those known of one run correct the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from autdtorch.fdtd.kernels.contract import Kernel, Receivers, Sources
from autdtorch.fdtd.perfectly_matched_layer import Thickness
from autdtorch.fdtd.steady_state import SteadyState, in_batches
from autdtorch.fdtd.stepping import Assembly, drive_signal, fourier_sum
from autdtorch.utils.array_types import Index

THIN_MARGIN, THIN_LAYER = 4, Thickness(4, 4)
"""Cells of air around bodies, and the absorbing layers of their boxes. Nearby poses of a hand err by 0.9 %,
and by 1.1 to 1.2 % with a cell less of either. One more cell of air or two more of layers change nothing."""

_RAMP, _RECORDED = 2, 2
"""Periods of the switch-on, and the last periods, whose phasor counts."""


def short_runs(
    assembly: Assembly,
    kernel: Kernel,
    drive: Callable[[Index], Sources],
    cells: Index,
    count: int,
    periods: int,
    stepped: Callable[[int], None],
) -> list[SteadyState]:
    """Step R = `count` runs of so many periods; the other arguments are as in `run_to_steady_state`.

    Their residuals are not known.
    """
    periods = max(periods, _RAMP + _RECORDED)
    per_period = float(assembly.steps_per_period)
    steps, recorded = math.ceil(periods * per_period), math.ceil(_RECORDED * per_period)
    turn = 2 * math.pi / per_period * np.arange(steps - recorded + 1, steps + 1)
    # least squares, as the steps of a period may be no whole number
    basis = torch.from_numpy(np.linalg.pinv(np.stack((np.cos(turn), np.sin(turn)), axis=1)))
    signal = drive_signal(assembly.steps_per_period, 0, steps, _RAMP).to(assembly.dtype)
    receivers, nothing = (Receivers.at(torch.from_numpy(some), assembly.dtype) for some in (cells, cells[:0]))

    @torch.no_grad()  # holds in one thread only
    def together(bounds: tuple[int, int]) -> list[SteadyState]:
        sources = drive(np.arange(*bounds))
        state = assembly.silence(sources, kernel.device)
        state, _ = kernel.advance(state, assembly.coefficients, sources, nothing, signal[:-recorded])
        _, record = kernel.advance(state, assembly.coefficients, sources, receivers, signal[-recorded:])
        stepped(periods * len(record))
        phasors = fourier_sum(basis, record)
        return [SteadyState(each, periods, math.inf, converged=False) for each in phasors]

    return in_batches(together, count, kernel, assembly.grid.shape, len(cells))
