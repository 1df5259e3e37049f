"""The steady state of a run, extrapolated from the phasors of its blocks.

A block is the fewest periods, at least three, with a whole number of steps. Phasors of windows of that
length, a quarter of a block apart, follow x_(n+1) = A x_n + b, as the scheme is linear. Reduced rank
extrapolation (Eddy 1979; Sidi 2017) estimates the fixed point: the mean sum g_j x_j, with sum g_j = 1, of
least residual sum g_j (x_(j+1) - x_j). It removes the slowest modes first, such as resonances of cavities.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from autdtorch.fdtd.kernels.contract import Kernel, Receivers, Sources
from autdtorch.fdtd.stepping import RAMP_PERIODS, Assembly, drive_basis, drive_signal, fourier_sum
from autdtorch.utils.array_types import COMPLEX, Index

Phasors = NDArray[np.complex128]
Echo = Callable[[Tensor], Sources]
"""The sources of a run whose cells have phasors (k,): a linear map, and a constant."""
MOST_JUDGED = 32
"""Receivers of a kind whose pressure decides when a run has converged."""

# Fewest periods of a block. Shorter blocks cost more overhead, and their phasors cover less time.
_FEWEST_PERIODS = 3
_PARTS = 4  # Windows per block
# Range of the number of stored phasors, limited by `_MOST_NUMBERS`; more extrapolate better
_FEWEST_PHASORS, _MOST_PHASORS = 12, 64
_MOST_NUMBERS = 20_000_000  # Most complex numbers of the stored phasors: 160 MB of single precision
_MOST_FITTED = 2048  # Most cells whose phasors decide the means
_ROUNDING = 1e-13  # Regularisation of the normal equations, relative to the mean square of the differences
# Pressure relative to that in free space, -80 dB, below which errors are relative to this floor: behind a
# wall or in an enclosure nothing arrives
SILENCE = 1e-4
_JUDGED = 4  # Blocks whose changes decide whether a run has converged
# Safety factor: the residual is estimated as this many times the changes over the last two blocks
_CAUTION = 2.0
# Ratio of the changes over successive blocks, twice, up to which the next ones are expected to fall as fast
_FALLING = 0.1


@dataclass(frozen=True)
class SteadyState:
    """Phasors of cells with their estimated residual."""

    pressure: Tensor  # phasors (k,), complex
    periods: int  # periods stepped
    residual: float  # estimated relative distance to the steady state, infinite while there is no estimate
    converged: bool  # whether the residual is within the tolerance


def run_to_steady_state(
    assembly: Assembly,
    kernel: Kernel,
    sources: Sources,
    cells: Index,
    tolerance: float,
    max_periods: int,
    observe: Callable[[Tensor], Sequence[Tensor]],
    stepped: Callable[[int], None],
    floors: Sequence[float] = (0.0,),
    echo: Echo | None = None,
) -> SteadyState:
    """Step until the relative residual is within `tolerance`, or `max_periods` have passed.

    `observe` maps the phasors of `cells` (k,) to the quantities that must all converge, once sound has
    arrived everywhere. The residual of each is relative to its norm, or to its entry of `floors` if that is
    more. `stepped` is called with the number of periods after each block. With an `echo`, the sources follow
    the phasors: see `windows_of_run`.
    """
    earliest, (steps, block) = fewest_periods(assembly.grid.arrival), block_of(assembly.steps_per_period)
    if echo:
        earliest += block  # the first answer to an echo is a block late
    kept = phasors_kept(len(cells))
    sequence = Extrapolation(kept, single=assembly.dtype == torch.float32)
    values: deque[Sequence[Tensor]] = deque(maxlen=_JUDGED)
    first_judged = min(earliest, max_periods) - (_JUDGED - 1) * block
    ramp = math.ceil(RAMP_PERIODS * assembly.steps_per_period)
    unused = (math.ceil(first_judged / block) - 1) * steps - (kept - 1) * _shift(steps)
    for count, windows in windows_of_run(assembly, kernel, sources, cells, echo, unused):
        stepped(block)
        for start, phasor in windows:
            if start >= ramp:
                sequence.append(phasor)
        if count < first_judged:
            continue
        limit = torch.from_numpy(sequence.limit() if len(sequence) else windows[-1][1])
        values.append(observe(limit))
        residual = max(map(_residual, zip(*values, strict=True), floors))
        converged = count >= earliest and residual <= tolerance
        if converged or count >= max_periods:
            break
    return SteadyState(limit, count, residual, converged)


def block_of(steps_per_period: Fraction) -> tuple[int, int]:
    """Return steps and periods of a block."""
    parts = math.ceil(_FEWEST_PERIODS / steps_per_period.denominator)
    return parts * steps_per_period.numerator, parts * steps_per_period.denominator


def fewest_periods(arrival: float) -> int:
    """Return the periods of the shortest run on a grid where sound has arrived after `arrival` periods."""
    return RAMP_PERIODS + math.ceil(arrival)


def phasors_kept(cells: int) -> int:
    """Return the number of phasors of `cells` cells that a run stores."""
    return min(max(_FEWEST_PHASORS, _MOST_NUMBERS // max(1, cells)), _MOST_PHASORS)


class Extrapolation:
    """Reduced rank extrapolation of a sequence, from its last `most` values."""

    def __init__(self, most: int, single: bool = False) -> None:
        """Start an empty sequence, whose values are stored in double or in `single` precision."""
        self._precision = np.complex64 if single else np.complex128
        self._most, self._count = most, 0
        self._values: NDArray[Any] = np.zeros((0, 0), self._precision)  # in turn (most, k)
        self._last = np.zeros(0, np.complex128)
        self._steps: deque[Phasors] = deque(maxlen=most - 1)
        self._product = np.zeros((0, 0), np.complex128)

    def __len__(self) -> int:
        """Return the number of stored values."""
        return min(self._count, self._most)

    def append(self, value: Phasors) -> None:
        """Append the next value (k,)."""
        before, self._last = self._last, value[:: -(-len(value) // _MOST_FITTED)].copy()
        if self._count:
            step = self._last - before
            self._steps.append(step)
            old = self._product[-len(self._steps) + 1 :, -len(self._steps) + 1 :]
            self._product = np.empty((len(self._steps),) * 2, np.complex128)
            self._product[:-1, :-1] = old if len(self._steps) > 1 else 0
            self._product[:, -1] = [np.vdot(other, step) for other in self._steps]
            self._product[-1] = self._product[:, -1].conj()
        else:
            self._values = np.empty((self._most, len(value)), self._precision)
        self._values[self._count % self._most] = value
        self._count += 1

    def limit(self) -> Phasors:
        """Return the estimated limit (k,), or the last value while there are too few."""
        count = len(self._steps)
        size = float(np.trace(self._product).real) / max(count, 1)
        if count < 2 or not (math.isfinite(size) and size > 0):
            return np.asarray(self._values[(self._count - 1) % self._most], np.complex128)
        mean = np.linalg.solve(self._product + _ROUNDING * size * np.eye(count), np.ones(count))
        mean /= mean.sum()
        total = np.zeros(self._values.shape[1], np.complex128)
        for place, share in enumerate(mean, self._count - count):
            total += share * self._values[place % self._most]
        return total


def windows_of_run(
    assembly: Assembly,
    kernel: Kernel,
    sources: Sources,
    cells: Index,
    echo: Echo | None = None,
    unused: int = 0,
) -> Iterator[tuple[int, list[tuple[int, Phasors]]]]:
    """Step from silence; yield after each block the periods so far, and start and phasors of its windows.

    Blocks within the first `unused` steps are not recorded, and have no windows.

    With an `echo`, `sources` fade over the next block into those that it returns for the phasors of a block:
    what the cells radiate comes back while they are stepped, and blocks still follow x_(n+1) = A x_n + b.
    """
    steps_per_period = assembly.steps_per_period
    steps, periods = block_of(steps_per_period)
    shift = steps if echo else _shift(steps)
    recorded_from = 0 if echo else max(0, unused // steps * steps)
    rising = _smooth((torch.arange(steps, device="cpu") + 0.5) / steps)[:, None].to(assembly.dtype)
    before = sources
    ones = torch.ones((len(cells), 1), dtype=assembly.dtype, device="cpu")
    receivers = Receivers(torch.from_numpy(cells[:, None]), ones)
    nothing = Receivers(receivers.index[:0], ones[:0])
    state, basis = assembly.silence(sources), drive_basis(steps, periods)
    total = silence = torch.zeros(len(cells), **COMPLEX)
    sums: dict[int, Tensor] = {}  # Fourier sums from the first recorded step to where windows begin and end
    for block in itertools.count():
        first = block * steps
        signal = drive_signal(steps_per_period, first, steps).to(assembly.dtype)
        driven = sources
        if echo:
            signal = torch.cat([(1 - rising) * signal, rising * signal], dim=1)
            driven = Sources(sources.index, torch.cat([before.force, sources.force], dim=2))
        read = receivers if first >= recorded_from else nothing
        state, recorded = kernel.advance(state, assembly.coefficients, driven, read, signal)
        if read is nothing:
            yield (block + 1) * periods, []
            continue
        sums = {time: value for time, value in sums.items() if time > first - steps}
        inside = (time for time in range(first + 1, first + steps) if _is_needed(time, steps, shift))
        for begin, end in itertools.pairwise((first, *inside, first + steps)):
            part = slice(begin - first, end - first)
            total = total + fourier_sum(basis[:, part], recorded[0, part]).cpu()
            sums[end] = total
        del recorded  # before the next one, as it may be most of a run's memory
        starts = range(-(-(first + 1) // shift) * shift - steps, first + 1, shift)
        whole = (start for start in starts if start >= recorded_from or not recorded_from)
        windows = [(start, (sums[start + steps] - sums.get(start, silence)).numpy()) for start in whole]
        yield (block + 1) * periods, windows
        if echo:
            before, sources = sources, echo(torch.from_numpy(windows[-1][1]))


def _shift(steps: int) -> int:
    """Return the steps from a window to the next, for blocks of `steps`."""
    return max(1, steps // _PARTS)


def _smooth(share: Tensor) -> Tensor:
    return share * share * (3 - 2 * share)


def _is_needed(time: int, steps: int, shift: int) -> bool:
    """Return whether a window ends or begins after `time` steps; ends are `shift` apart."""
    return time % shift == 0 or (time + steps) % shift == 0


def _residual(values: Sequence[Tensor], floor: float) -> float:
    """Return the residual of the last value, estimated from its changes over the last blocks."""
    last, size = values[-1], max(float(values[-1].norm()), floor)
    if len(values) < 3 or not size:
        return math.inf
    changes = [float((one - before).norm()) / size for before, one in itertools.pairwise(values)]
    if not all(map(math.isfinite, changes)):
        return math.inf
    falls = [one / before for before, one in itertools.pairwise(changes) if before]
    if len(falls) == 2 and max(falls) <= _FALLING:
        return _CAUTION * max(falls) * changes[-1]
    return _CAUTION * max(changes[-1], float((last - values[-3]).norm()) / size)
