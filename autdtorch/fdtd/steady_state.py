"""The steady state of a run: stepped block by block, its limit foretold from the phasors on the way.

A block is the fewest periods, three at least, that take a whole number of steps. Phasors of windows as long
as a block, a quarter of a block apart, follow x_(n+1) = A x_n + b, as the scheme is linear. Reduced rank
extrapolation (Eddy 1979; Sidi 2017) finds the fixed point: of all means sum g_j x_j with sum g_j = 1 it takes
the one whose differences, sum g_j (x_(j+1) - x_j), are smallest. That removes the slowest modes first, the
cavities'.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.contract import Kernel, Receivers, Sources
from autdtorch.fdtd.stepping import RAMP_PERIODS, Assembly, drive_signal, lock_in

_FEWEST_PERIODS = 3
"""Of a block. Shorter ones cost more work between the steps, and the phasors kept reach less far back."""

_PARTS = 4
"""Phasors a block."""

_FEWEST_PHASORS, _MOST_PHASORS = 12, 64
"""That are kept to extrapolate from: the more the better, as far as `_MOST_NUMBERS` reach."""

_MOST_NUMBERS = 20_000_000
"""That they hold, 320 MB."""

_MOST_FITTED = 8192
"""Cells whose phasors decide the means; of more, this many."""

_ROUNDING = 1e-13
"""Of the mean square of the differences, added to each one's so that the system can be solved."""

_CAUTION = 2.0
"""How many times the changes of the last two blocks the distance to the limit is taken to be."""


@dataclass(frozen=True)
class SteadyState:
    """Phasors of cells and how sure they are.

    Attributes:
        pressure: (k,) complex, amplitude of the pressure in each cell.
        periods: periods stepped.
        remaining: estimated relative distance to the steady state, infinite while it cannot be told.
        reached: whether that is within the tolerance.
    """

    pressure: torch.Tensor
    periods: int
    remaining: float
    reached: bool


def run_to_steady_state(
    assembly: Assembly,
    kernel: Kernel,
    sources: Sources,
    cells: NDArray[np.int64],
    tolerance: float,
    max_periods: int,
    judged: Callable[[torch.Tensor], torch.Tensor],
) -> SteadyState:
    """Step until the limit of what is wanted stands, or `max_periods` have passed.

    Args:
        assembly: the scene on its grid.
        kernel: what steps.
        sources: what is driven.
        cells: flat indices (k,) of the cells whose phasors are wanted.
        tolerance: relative distance to the steady state at which to stop.
        max_periods: after which to stop in any case.
        judged: what of the phasors (k,) must stand. A run is not judged before sound has crossed the grid
            twice.
    """
    earliest = fewest_periods(assembly.grid.diagonal / assembly.grid.wavelength)
    kept = min(max(_FEWEST_PHASORS, _MOST_NUMBERS // len(cells)), _MOST_PHASORS)
    phasors: deque[NDArray[np.complex128]] = deque(maxlen=kept)
    values: deque[torch.Tensor] = deque(maxlen=3)
    ramp = math.ceil(RAMP_PERIODS * assembly.steps_per_period)
    for count, windows in _windows(assembly, kernel, sources, cells):
        phasors.extend(phasor for start, phasor in windows if start >= ramp)
        limit = torch.from_numpy(extrapolated(np.array(phasors or [windows[-1][1]])))
        values.append(judged(limit))
        remaining = _distance(values)
        reached = count >= earliest and remaining <= tolerance
        if reached or count >= max_periods:
            break
    return SteadyState(limit, count, remaining, reached)


def fewest_periods(crossing: float) -> int:
    """Periods of the shortest run on a grid that sound crosses within `crossing` periods."""
    return RAMP_PERIODS + math.ceil(2 * crossing)


def extrapolated(phasors: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Limit (k,) of a sequence of phasors (n, k), n >= 1."""
    if len(phasors) < 3:
        return np.asarray(phasors[-1])
    step = np.diff(phasors[:, :: -(-phasors.shape[1] // _MOST_FITTED)], axis=0)
    product = step.conj() @ step.T
    size = float(np.trace(product).real) / len(step)
    if not (math.isfinite(size) and size > 0):
        return np.asarray(phasors[-1])
    mean = np.linalg.solve(product + _ROUNDING * size * np.eye(len(step)), np.ones(len(step)))
    return np.asarray((mean / mean.sum()) @ phasors[1:], np.complex128)


def _windows(
    assembly: Assembly, kernel: Kernel, sources: Sources, cells: NDArray[np.int64]
) -> Iterator[tuple[int, list[tuple[int, NDArray[np.complex128]]]]]:
    """Step from silence; after each block the periods so far, and first step and phasors of its windows."""
    steps_per_period = assembly.steps_per_period
    parts = math.ceil(_FEWEST_PERIODS / steps_per_period.denominator)
    steps, periods = parts * steps_per_period.numerator, parts * steps_per_period.denominator
    shift = max(1, steps // _PARTS)
    receivers = Receivers(torch.from_numpy(cells[:, None]), torch.ones((len(cells), 1), dtype=assembly.dtype))
    state, earlier = assembly.silence(sources), torch.zeros((steps, len(cells)), dtype=assembly.dtype)
    for block in itertools.count():
        first = block * steps
        signal = drive_signal(steps_per_period, first, steps).to(assembly.dtype)
        state, recorded = kernel.advance(state, assembly.coefficients, sources, receivers, signal)
        both = torch.cat((earlier, recorded))
        ends = range(-(-(first + 1) // shift) * shift, first + steps + 1, shift)
        windows = [(end - steps, both[end - first : end - first + steps]) for end in ends]
        yield (
            (block + 1) * periods,
            [(start, _turned(window, start, periods)) for start, window in windows],
        )
        earlier = recorded


def _turned(window: torch.Tensor, start: int, periods: int) -> NDArray[np.complex128]:
    """Phasors (k,) of a window of `periods`, recorded (steps, k) after each step that follows `start`."""
    turn = 2 * math.pi * (start * periods % len(window)) / len(window)
    return np.asarray(lock_in(window, periods).numpy() * complex(math.cos(turn), math.sin(turn)))


def _distance(values: deque[torch.Tensor]) -> float:
    """Relative distance of the last value to the limit, as its changes in the last two blocks foretell."""
    last = values[-1]
    size = float(last.norm())
    if len(values) < 3 or not size:
        return math.inf
    changes = [float((last - value).norm()) / size for value in values]
    return _CAUTION * max(changes) if all(map(math.isfinite, changes)) else math.inf
