"""The steady states of runs, extrapolated from the phasors of their blocks.

A block is the fewest periods, at least three, with a whole number of steps. Phasors of windows of that
length, a quarter of a block apart, follow x_(n+1) = A x_n + b, as the scheme is linear.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from autdtorch.fdtd.extrapolation import MOST_FITTED, Extrapolation
from autdtorch.fdtd.kernels.contract import Kernel, Receivers, Sources
from autdtorch.fdtd.resonances import Resonance
from autdtorch.fdtd.stepping import RAMP_PERIODS, Assembly, drive_basis, drive_signal, fourier_sum
from autdtorch.utils.array_types import REAL, Array, Index
from autdtorch.utils.process import even_parts, spread

Observe = Callable[[Tensor, Index], Sequence[Tensor]]
"""Observe: maps phasors (k, r) of r runs, and the numbers (r,) of these, to quantities (n, r)."""
Echo = Callable[[Tensor, Index], Sources]
"""The sources of r runs, by their numbers (r,), whose cells have phasors (k, r): linear, and a constant."""
MOST_JUDGED = 32
"""Receivers of a kind whose pressure decides when a run has converged."""

# Fewest periods of a block. Shorter blocks cost more overhead, and their phasors cover less time.
_FEWEST_PERIODS = 3
_PARTS = 4  # Windows per block
# Range of the number of stored phasors, limited by `_MOST_NUMBERS`; more extrapolate better
_FEWEST_PHASORS, _MOST_PHASORS = 12, 64
_MOST_NUMBERS = 20_000_000  # Most complex numbers of the stored phasors: 160 MB of single precision
_SUMS = 18  # Complex numbers of a cell in Fourier sums of a block, its windows and limits
# Pressure relative to that in free space, -80 dB, below which errors are relative to this floor: behind a
# wall or in an enclosure nothing arrives
SILENCE = 1e-4
_JUDGED = 4  # Blocks whose changes decide whether a run has converged
# Safety factor: the residual is bounded by this many times the changes over the last two blocks
_CAUTION = 2.0
# Ratio of the changes over successive blocks, twice, up to which the next ones are expected to fall as fast
_FALLING = 0.1
_FAINT = 1e-5  # Least part of a steady state that counts as a resonance
_TINY = torch.finfo(torch.float64).tiny


@dataclass(frozen=True)
class SteadyState:
    """Phasors of cells in a run, with their estimated residual."""

    pressure: Tensor  # phasors (k,), complex, on the kernel's device
    periods: int  # periods stepped
    residual: float  # estimated relative distance to the steady state; a bound of it if not converged
    converged: bool  # whether the residual is within the tolerance
    resonances: tuple[Resonance, ...] = ()  # those that rang


def run_to_steady_state(
    assembly: Assembly,
    kernel: Kernel,
    drive: Callable[[Index], Sources],
    cells: Index,
    tolerances: Sequence[float],
    max_periods: int,
    observe: Observe,
    stepped: Callable[[int], None],
    floors: Tensor,
    echo: Echo | None = None,
) -> list[SteadyState]:
    """Step R runs until the relative residual of each is within its tolerance, or `max_periods` have passed.

    `drive` returns the sources of runs by their numbers; the kernel decides how many it steps together.
    `observe` maps the phasors of `cells` to Q quantities that must all converge, once sound has arrived
    everywhere. The residual of each is relative to its norm, or to its entry of `floors` (Q, R) if that is
    more. `stepped` is called with the periods of all runs after each block. With an `echo`, the sources
    follow the phasors: see `WindowedRuns`. Derivatives are not recorded.
    """
    earliest, (steps, block) = fewest_periods(assembly.grid.arrival), block_of(assembly.steps_per_period)
    if echo:
        earliest += block  # the first answer to an echo is a block late
    length = phasors_kept(len(cells))
    first_judged = min(earliest, max_periods) - (_JUDGED - 1) * block
    ramp = math.ceil(RAMP_PERIODS * assembly.steps_per_period)
    unused = (math.ceil(first_judged / block) - 1) * steps - (length - 1) * _shift(steps)
    before = (RAMP_PERIODS + assembly.grid.arrival + block) / 2  # until sound has come, about
    limit = np.array(tolerances)

    @torch.no_grad()  # holds in one thread only
    def together(bounds: tuple[int, int]) -> list[SteadyState]:
        runs = np.arange(*bounds)
        stepping = WindowedRuns(assembly, kernel, drive(runs), cells, runs, echo, unused)
        sequences = Extrapolation(length, single=assembly.dtype == torch.float32)
        judging = _Judging(observe, floors[:, runs])
        places = torch.arange(len(runs), device="cpu")  # among the runs that are stepped
        states: dict[int, SteadyState] = {}
        for count in itertools.count(block, block):
            windows = stepping.advance()
            stepped(block * len(runs))
            for start, phasors in windows:
                if start >= ramp:
                    sequences.append(phasors)
            if count < first_judged:
                continue
            limits = sequences.limits(places) if len(sequences) else windows[-1][1].mT[:, places]
            residual, bound = judging.residuals(limits, runs)
            converged = (bound <= limit[runs]) & (count >= earliest)
            residual = np.where(converged, residual, bound)
            done = converged | (count >= max_periods)
            if done.any():
                first = count - before - (len(sequences) - 1) * stepping.interval
                parts = sequences.ringing(places[done], stepping.interval)
                rung = judging.resonances(parts, runs, done, first)
                for place, each in zip(np.flatnonzero(done), rung, strict=True):
                    state = count, float(residual[place]), bool(converged[place]), tuple(each)
                    states[runs[place]] = SteadyState(limits[:, place].contiguous(), *state)
            if done.all():
                break
            judging.choose(~done)
            runs, places = runs[~done], places[~done]
            if 2 * len(places) < len(stepping.runs):
                stepping.choose(places)
                sequences.choose(places)
                places = torch.arange(len(runs), device="cpu")
        return [states[run] for run in range(*bounds)]

    return in_batches(together, len(limit), kernel, assembly.grid.shape, len(cells))


def in_batches(
    together: Callable[[tuple[int, int]], list[SteadyState]],
    count: int,
    kernel: Kernel,
    shape: tuple[int, int, int],
    cells: int,
) -> list[SteadyState]:
    """Return the states of runs, so many as a kernel steps at once on grids of a shape, by their bounds."""
    threads, most = kernel.at_once(shape), kernel.together(shape, cells)
    batches = even_parts(count, max(math.ceil(count / most), min(threads, count))) if count else []
    return [state for states in spread(together, batches, threads) for state in states]


def block_of(steps_per_period: Fraction) -> tuple[int, int]:
    """Return steps and periods of a block."""
    parts = math.ceil(_FEWEST_PERIODS / steps_per_period.denominator)
    return parts * steps_per_period.numerator, parts * steps_per_period.denominator


def fewest_periods(arrival: float) -> int:
    """Return the periods of the shortest run on a grid where sound has arrived after `arrival` periods."""
    return RAMP_PERIODS + math.ceil(arrival)


def blocks_needed(phasors: Tensor, floor: float, tolerance: float) -> tuple[float, int]:
    """Return the estimated residual of a run's last block, and the number of blocks that would do.

    `phasors` (n, P) are those of all blocks of a run from silence, not extrapolated. The residual is relative
    to the norm of the last ones, or to `floor` if that is more. The blocks follow from how fast changes fell
    in the last quarter of the run, and are at most 4 n.
    """
    count = len(phasors)
    whole = torch.cat([phasors.new_zeros((_JUDGED - 1, phasors.shape[1])), phasors])
    least = torch.tensor([max(floor, torch.finfo(torch.float64).tiny)], **REAL)
    residual = float(_residuals([value[:, None] for value in whole[-_JUDGED:]], least)[0])
    if residual <= tolerance:
        return residual, count
    changes, part = whole.diff(dim=0).norm(dim=1), math.ceil(count / 4)
    fallen = float(changes[-2 - part : -part].max() / changes[-2:].max())
    more = part * math.log(residual / tolerance) / math.log(fallen) if fallen > 1 else math.inf
    return residual, count + math.ceil(min(more, 3 * count))


def phasors_kept(cells: int) -> int:
    """Return the number of phasors of `cells` cells that a run stores."""
    return min(max(_FEWEST_PHASORS, _MOST_NUMBERS // max(1, cells)), _MOST_PHASORS)


def stored_bytes(cells: int, itemsize: int) -> int:
    """Return the memory [bytes] of the phasors and sums of `cells` cells that a run on some fields stores."""
    phasors, steps = 2 * itemsize * cells, 16 * min(cells, MOST_FITTED)
    return phasors_kept(cells) * (phasors + steps) + 16 * _SUMS * cells


class WindowedRuns:
    """R runs from silence, and the phasors of their windows, block by block.

    With an `echo`, the sources fade over the next block into those that it returns for the phasors of a
    block: what the cells radiate comes back while they are stepped, and blocks still follow
    x_(n+1) = A x_n + b.

    Attributes:
        runs: their numbers (R,).
        interval: time between two windows [periods].
    """

    def __init__(
        self,
        assembly: Assembly,
        kernel: Kernel,
        sources: Sources,
        cells: Index,
        runs: Index,
        echo: Echo | None = None,
        unused: int = 0,
    ) -> None:
        """Begin runs with their sources; blocks within the first `unused` steps are not recorded."""
        self.runs = runs
        self._assembly, self._kernel, self._echo = assembly, kernel, echo
        self._sources = self._before = sources
        self._steps, periods = block_of(assembly.steps_per_period)
        self._shift = self._steps if echo else _shift(self._steps)
        self.interval = float(self._shift / assembly.steps_per_period)
        self._recorded_from = 0 if echo else max(0, unused // self._steps * self._steps)
        self._receivers = Receivers.at(torch.from_numpy(cells), assembly.dtype)
        self._nothing = Receivers.at(torch.from_numpy(cells[:0]), assembly.dtype)
        self._state, self._basis = assembly.silence(sources, kernel.device), drive_basis(self._steps, periods)
        self._time = 0
        # Fourier sums (R, k) from the first recorded step, until now and to where windows begin and end
        self._total: Any = 0.0
        self._sums: dict[int, Tensor] = {}

    def advance(self) -> list[tuple[int, Tensor]]:
        """Step a block; return start and phasors (R, k) of the windows that end in it, if it is recorded."""
        first, steps, shift = self._time, self._steps, self._shift
        self._time += steps
        sources, signal = self._drive(first)
        recording = first >= self._recorded_from
        receivers = self._receivers if recording else self._nothing
        self._state, recorded = self._kernel.advance(
            self._state, self._assembly.coefficients, sources, receivers, signal
        )
        if not recording:
            return []
        self._sums = {time: value for time, value in self._sums.items() if time > first - steps}
        times = range(first + 1, first + steps)
        inside = (time for time in times if time % shift == 0 or (time + steps) % shift == 0)
        for begin, end in itertools.pairwise((first, *inside, first + steps)):
            part = slice(begin - first, end - first)
            self._total = self._total + fourier_sum(self._basis[:, part], recorded[:, part])
            self._sums[end] = self._total
        starts = range(-(-(first + 1) // shift) * shift - steps, first + 1, shift)
        whole = (start for start in starts if start >= self._recorded_from or not self._recorded_from)
        windows = [(start, self._sums[start + steps] - self._sums.get(start, 0.0)) for start in whole]
        if self._echo:
            phasors = windows[-1][1].mT.contiguous().cpu()
            self._before, self._sources = self._sources, self._echo(phasors, self.runs)
        return windows

    def choose(self, places: Tensor) -> None:
        """Go on with some of the runs."""
        self.runs, self._state = self.runs[places.numpy()], self._state.chosen(places)
        self._before, self._sources = self._before.chosen(places), self._sources.chosen(places)
        self._total = self._total[places]
        self._sums = {time: value[places] for time, value in self._sums.items()}

    def _drive(self, first: int) -> tuple[Sources, Tensor]:
        assembly, steps = self._assembly, self._steps
        signal = drive_signal(assembly.steps_per_period, first, steps).to(assembly.dtype)
        if not self._echo:
            return self._sources, signal
        share = ((torch.arange(steps, device="cpu") + 0.5) / steps)[:, None]
        rising = (share * share * (3 - 2 * share)).to(assembly.dtype)
        force = torch.cat([self._before.force, self._sources.force], dim=2)
        both = torch.cat([(1 - rising) * signal, rising * signal], dim=1)
        return Sources(self._sources.index, force), both


def _shift(steps: int) -> int:
    """Return the steps from a window to the next, for blocks of `steps`."""
    return max(1, steps // _PARTS)


class _Judging:
    """The last values of what is observed of R runs."""

    def __init__(self, observe: Observe, floors: Tensor) -> None:
        """Observe nothing yet; residuals are relative to norms of values, or to `floors` (Q, R) if more."""
        self._observe, self._floors = observe, floors
        self._values: deque[list[Tensor]] = deque(maxlen=_JUDGED)

    def residuals(self, limits: Tensor, runs: Index) -> tuple[Array, Array]:
        """Observe phasors (k, R) of runs, by their numbers (R,); return residuals and their bounds (R,)."""
        self._values.append([value.cpu() for value in self._observe(limits, runs)])
        each = map(_residuals, zip(*self._values, strict=True), self._floors)
        residual, bound = (torch.stack(part).amax(dim=0).numpy() for part in zip(*each, strict=True))
        return residual, bound

    def resonances(
        self, parts: Iterable[tuple[complex, Tensor]], runs: Index, mask: NDArray[np.bool_], time: float
    ) -> list[list[Resonance]]:
        """Return the resonances of some of the runs (R,), by a `mask`; strengths are in the first quantity.

        They have rung for a `time` [periods] until their parts (k, r); see `Extrapolation.ringing`.
        """
        last = self._values[-1][0][:, mask]
        whole = torch.maximum(last.norm(dim=0), self._floors[0, mask]).clamp(min=_TINY)
        resonances: list[list[Resonance]] = [[] for _ in runs[mask]]
        for offset, part in parts:
            loud, still = (self._observe(each, runs[mask])[0].cpu() for each in (part, 0 * part))
            rung = (loud - still).norm(dim=0) / whole * math.exp(-2 * math.pi * offset.imag * time)
            for each, strength in zip(resonances, rung.tolist(), strict=True):
                if _FAINT < strength < 1:  # more has decayed to rounding
                    each.append(Resonance(offset, strength))
        return resonances

    def choose(self, mask: NDArray[np.bool_]) -> None:
        self._floors = self._floors[:, mask]
        for values in self._values:
            values[:] = [value[:, mask] for value in values]


def _residuals(values: Sequence[Tensor], floors: Tensor) -> tuple[Tensor, Tensor]:
    """Return the estimated residuals (r,) of the last value (n, r), and bounds by which runs end.

    Both come from the changes over the last blocks. What is left of changes that fall by a ratio s each is
    s / (1 - s) of the last one. As chance decides single ratios, runs end later: then the estimates of 70
    runs were 0.5 to 10 times the distance to the limit, twice in the median, and the bounds 40 times.
    """
    last, size = values[-1], torch.maximum(values[-1].norm(dim=0), floors)
    if len(values) < 3:
        return torch.full_like(size, math.inf), torch.full_like(size, math.inf)
    changes = torch.stack([(later - value).norm(dim=0) for value, later in itertools.pairwise(values)]) / size
    bounds = _CAUTION * torch.maximum(changes[-1], (last - values[-3]).norm(dim=0) / size)
    residuals = bounds
    if len(values) == _JUDGED:
        slowest = (changes[1:] / changes[:-1]).amax(dim=0)
        left = _CAUTION * slowest * changes[-1]
        bounds = torch.where(slowest <= _FALLING, left, bounds)
        residuals = torch.where(slowest < 1, torch.minimum(left / (1 - slowest), bounds), bounds)
    known = changes.isfinite().all(dim=0)
    return torch.where(known, residuals, math.inf), torch.where(known, bounds, math.inf)
