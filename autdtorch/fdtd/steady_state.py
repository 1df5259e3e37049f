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
from fractions import Fraction

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.contract import Kernel, Receivers, Sources
from autdtorch.fdtd.stepping import RAMP_PERIODS, Assembly, drive_dft, drive_signal

Phasors = NDArray[np.complex128]

_FEWEST_PERIODS = 3
"""Of a block. Shorter ones cost more work between the steps, and the phasors kept reach less far back."""

_PARTS = 4
"""Phasors a block."""

_FEWEST_PHASORS, _MOST_PHASORS = 12, 64
"""That are kept to extrapolate from: the more the better, as far as `_MOST_NUMBERS` reach."""

_MOST_NUMBERS = 20_000_000
"""That they hold, 320 MB."""

_MOST_FITTED = 2048
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
        residual: estimated relative distance to the steady state, infinite while it cannot be told.
        converged: whether that is within the tolerance.
    """

    pressure: torch.Tensor
    periods: int
    residual: float
    converged: bool


def run_to_steady_state(
    assembly: Assembly,
    kernel: Kernel,
    sources: Sources,
    cells: NDArray[np.int64],
    tolerance: float,
    max_periods: int,
    observe: Callable[[torch.Tensor], torch.Tensor],
    stepped: Callable[[int], None],
) -> SteadyState:
    """Step until the limit of what is wanted stands, or `max_periods` have passed.

    Args:
        assembly: the scene on its grid.
        kernel: what steps.
        sources: what is driven.
        cells: flat indices (k,) of the cells whose phasors are wanted.
        tolerance: relative distance to the steady state at which to stop.
        max_periods: after which to stop in any case.
        observe: what of the phasors (k,) must stand. A run is not observe before sound has crossed the grid
            twice.
        stepped: is called with the number of periods after each block.
    """
    earliest = fewest_periods(assembly.grid.diagonal / assembly.grid.wavelength)
    sequence = Extrapolation(phasors_kept(len(cells)))
    values: deque[torch.Tensor] = deque(maxlen=3)
    ramp = math.ceil(RAMP_PERIODS * assembly.steps_per_period)
    for count, windows in windows_of_run(assembly, kernel, sources, cells):
        stepped(block_of(assembly.steps_per_period)[1])
        for start, phasor in windows:
            if start >= ramp:
                sequence.append(phasor)
        limit = torch.from_numpy(sequence.limit() if len(sequence) else windows[-1][1])
        values.append(observe(limit))
        residual = _distance(values)
        converged = count >= earliest and residual <= tolerance
        if converged or count >= max_periods:
            break
    return SteadyState(limit, count, residual, converged)


def block_of(steps_per_period: Fraction) -> tuple[int, int]:
    """Steps and periods of a block."""
    parts = math.ceil(_FEWEST_PERIODS / steps_per_period.denominator)
    return parts * steps_per_period.numerator, parts * steps_per_period.denominator


def fewest_periods(crossing: float) -> int:
    """Periods of the shortest run on a grid that sound crosses within `crossing` periods."""
    return RAMP_PERIODS + math.ceil(2 * crossing)


def phasors_kept(cells: int) -> int:
    """Return the number of phasors of so many cells that a run keeps."""
    return min(max(_FEWEST_PHASORS, _MOST_NUMBERS // max(1, cells)), _MOST_PHASORS)


class Extrapolation:
    """The limit of a sequence of which the last numbers are kept, `most` of them."""

    def __init__(self, most: int) -> None:
        """An empty sequence."""
        self._values: deque[Phasors] = deque(maxlen=most)
        self._steps: deque[Phasors] = deque(maxlen=most - 1)
        self._product = np.zeros((0, 0), np.complex128)

    def __len__(self) -> int:
        """How many are kept."""
        return len(self._values)

    def append(self, value: Phasors) -> None:
        """Go on with the next (k,)."""
        if self._values:
            every = -(-len(value) // _MOST_FITTED)
            step = value[::every] - self._values[-1][::every]
            self._steps.append(step)
            old = self._product[-len(self._steps) + 1 :, -len(self._steps) + 1 :]
            self._product = np.empty((len(self._steps),) * 2, np.complex128)
            self._product[:-1, :-1] = old if len(self._steps) > 1 else 0
            self._product[:, -1] = [np.vdot(other, step) for other in self._steps]
            self._product[-1] = self._product[:, -1].conj()
        self._values.append(value)

    def limit(self) -> Phasors:
        """Where it goes (k,), the last number while there are too few; one at least must have been given."""
        count = len(self._steps)
        size = float(np.trace(self._product).real) / max(count, 1)
        if count < 2 or not (math.isfinite(size) and size > 0):
            return self._values[-1]
        mean = np.linalg.solve(self._product + _ROUNDING * size * np.eye(count), np.ones(count))
        mean /= mean.sum()
        total = np.zeros_like(self._values[-1])
        for share, value in zip(mean, itertools.islice(self._values, 1, None), strict=True):
            total += share * value
        return total


def windows_of_run(
    assembly: Assembly, kernel: Kernel, sources: Sources, cells: NDArray[np.int64]
) -> Iterator[tuple[int, list[tuple[int, Phasors]]]]:
    """Step from silence; after each block the periods so far, and first step and phasors of its windows."""
    steps_per_period = assembly.steps_per_period
    steps, periods = block_of(steps_per_period)
    shift = max(1, steps // _PARTS)
    receivers = Receivers(
        torch.from_numpy(cells[:, None]), torch.ones((len(cells), 1), dtype=assembly.dtype, device="cpu")
    )
    state = assembly.silence(sources)
    both = None  # what was recorded in the last two blocks (2 * steps, k)
    for block in itertools.count():
        first = block * steps
        signal = drive_signal(steps_per_period, first, steps).to(assembly.dtype)
        state, recorded = kernel.advance(state, assembly.coefficients, sources, receivers, signal)
        if both is None:
            both = recorded.new_zeros((2 * steps, len(cells)), dtype=torch.float64)
        both[:steps] = both[steps:]
        both[steps:] = recorded
        starts = range(-(-(first + 1) // shift) * shift - steps, first + 1, shift)
        windows = ((start, both[start - first + steps :][:steps]) for start in starts)
        yield (block + 1) * periods, [(start, _turned(window, start, periods)) for start, window in windows]


def _turned(window: torch.Tensor, start: int, periods: int) -> Phasors:
    """Phasors (k,) of a window of `periods`, recorded (steps, k) after each step that follows `start`."""
    turn = 2 * math.pi * (start * periods % len(window)) / len(window)
    return np.asarray(drive_dft(window, periods).cpu().numpy() * complex(math.cos(turn), math.sin(turn)))


def _distance(values: deque[torch.Tensor]) -> float:
    """Relative distance of the last value to the limit, as its changes in the last two blocks foretell."""
    last = values[-1]
    size = float(last.norm())
    if len(values) < 3 or not size:
        return math.inf
    changes = [float((last - value).norm()) / size for value in values]
    return _CAUTION * max(changes) if all(map(math.isfinite, changes)) else math.inf
