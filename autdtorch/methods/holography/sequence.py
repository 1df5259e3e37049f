"""Drives for foci that move: all frames of the path are one problem, with a limit on steps of phases.

A transducer whose phase jumps is silent for a moment, which is audible (Suzuki, Fujiwara, Makino and Shinoda
2020, doi:10.1109/TOH.2020.2965946). So phases change by limited steps from one frame to the next.

With the pressures p_t = G_t q_t and weights w of the foci, the sum of w |p| over all frames rises in turns:

- c_t = G_t^H (w * sgn(p_t)), as in "wgs"; the sum of Re(c_t^H q_t) is a lower bound of the sum of w |p|;
- each phase moves as near to the phase of c_t as the limits to the frame before *and* the frame after allow:
  the even frames first, then the odd ones. No step lowers the bound.

Weights grow where a focus is weak. The phases of the foci decide how smooth the drives are. Each focus begins
with phases that keep its back-propagated drive most alike from frame to frame; the difference after a closed
lap is spread over the lap. Constant phases between the foci remain, of which several are tried. The first
drives differ least from those wanted, within the limit, so that a jump spreads over both its sides.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from autdtorch.methods.holography.algorithms import GOLDEN, TINY, UNREACHED
from autdtorch.methods.holography.holography import checked_targets
from autdtorch.scene.geometry import path_foci
from autdtorch.scene.sequence import Sequence
from autdtorch.utils.array_types import Array, ComplexArray, device_of
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    complex_tensor,
    integer_at_least,
    invalid,
    positive,
    require_kind,
    within,
)

if TYPE_CHECKING:
    from autdtorch.propagators import Propagator

_STARTS = 8  # Phases between the foci that are tried
_SETTLED = 1e-9  # Change of all drives at which iterations end
_TRIAL = 10  # Iterations of each, after which the best goes on
_DAMPING = 0.5  # Power of wanted over present pressure in the weights; 1 overshoots


@one_library_thread()
def drive_sequence(
    G: ArrayLike,
    targets: ArrayLike | None = None,
    phase_step: float = math.pi,
    closed: bool = False,
    even: bool = True,
    iterations: int = 50,
) -> torch.Tensor:
    """Return a drive for each frame of a path of foci, phases of which change by limited steps.

    Model-based, as `holography`. The path is solved as a whole: a phase begins to turn before the foci need
    it. A limit below the steps that the path needs lowers the pressure; more frames need smaller steps.

    Args:
        G: transfer matrices of the frames (T, P, M), complex [Pa].
        targets: wanted pressures (T, P) or (P,), > 0 and relative to each other; None for 1 everywhere.
        phase_step: largest change of a phase from one frame to the next [rad], > 0.
        closed: whether the first frame follows the last one again, within the same limit.
        even: whether the weakest focus of all frames is raised, relative to its target, and each frame is
            scaled down to its level; otherwise the mean over frames of the weakest focus is raised, and all
            amplitudes are 1.
        iterations: most iterations of the path, >= 1.

    Returns:
        Drives (T, M), complex128, |q| <= 1, on the device of G.

    Raises:
        ValueError: not finite numbers, shapes that do not fit, targets <= 0, a focus that no transducer
            reaches, or a setting out of range.
    """
    matrix = complex_tensor("G", G).detach().cpu()
    if matrix.ndim != 3 or matrix.numel() == 0:
        raise ValueError(f"G: shape {tuple(matrix.shape)}; must be (T, P, M) with T, P, M >= 1")
    wanted = checked_targets(targets, matrix)
    if not (wanted > 0).all():
        raise invalid("targets", targets, "must be pressures, all > 0 Pa")
    limit = min(positive("phase_step", phase_step, "rad"), math.pi)
    closed, even = boolean("closed", closed), boolean("even", even)
    iterations = integer_at_least("iterations", iterations, 1)
    reached = matrix.abs().amax(dim=-1)
    if (reached == 0).any():
        frame, point = torch.nonzero(reached == 0)[0].tolist()
        raise ValueError(f"G[{frame}, {point}]: 0 Pa of all transducers; every focus must be reached")
    rows = (matrix.to(torch.complex128) / (reached.max() * wanted[..., None])).numpy()
    steps = _Steps(limit if len(rows) > 1 else math.pi, closed)  # a single frame has no neighbours
    starts = _best(rows, steps.nearest(_starts(rows, closed)), steps, even, min(_TRIAL, iterations))
    drives = _best(rows, starts, steps, even, iterations)[:, 0]
    if even:
        level = np.abs(drives[:, None] @ rows.swapaxes(1, 2)).min(axis=(1, 2))
        drives = drives * (level.min() / np.maximum(level, TINY))[:, None]
    return torch.from_numpy(drives).to(device_of(G))


def sequence_along(
    propagator: Propagator,
    path: ArrayLike,
    frequency: float,
    targets: ArrayLike | None = None,
    phase_step: float = math.pi,
    loop: bool = True,
    even: bool = True,
) -> Sequence:
    """Return a sequence that moves foci along a path, one frame for each of its points.

    The rate is the number of points times `frequency`.

    Args:
        propagator: of the scene, with its obstacles.
        path: (T, 3) for one focus, or (T, P, 3) for P foci [m], as of `circle_points` or `polyline_points`.
        frequency: laps per second [Hz], > 0.
        targets: wanted pressures (T, P) or (P,), relative to each other; None for 1 everywhere.
        phase_step: largest change of a phase from one frame to the next [rad], > 0.
        loop: whether the path begins again after its last point.
        even: whether all frames have one level; see `drive_sequence`.

    Raises:
        ValueError: an argument out of range, or as for `drive_sequence`.
    """
    from autdtorch.propagators import Propagator  # takes a second

    require_kind("propagator", propagator, Propagator)
    frequency, loop = positive("frequency", frequency, "Hz"), boolean("loop", loop)
    foci = path_foci(path)
    with within("path"):
        rows = propagator.transfer_matrix(foci.reshape(-1, 3))
    matrix = rows.reshape(*foci.shape[:2], -1)
    return Sequence(drive_sequence(matrix, targets, phase_step, loop, even), len(foci) * frequency, loop)


def _starts(rows: ComplexArray, closed: bool) -> ComplexArray:
    """Return drives (T, S, M) of any amplitude that send steady phases of the foci back, S between the foci.

    With steady phases the rows (T, P, M) of a focus differ least from frame to frame.
    """
    turns = np.angle((rows.conj() * np.roll(rows, -1, axis=0)).sum(axis=-1))
    phases = np.concatenate([np.zeros_like(turns[:1]), turns.cumsum(axis=0)])
    if closed:
        missing = np.remainder(phases[-1] + math.pi, 2 * math.pi) - math.pi
        phases -= missing * np.linspace(0, 1, len(phases))[:, None]
    foci = np.arange(rows.shape[1])
    between = 2 * math.pi * GOLDEN * foci * np.arange(_STARTS if len(foci) > 1 else 1)[:, None]
    back: ComplexArray = (_first_weights(rows) * np.exp(1j * (phases[:-1, None] + between))) @ rows.conj()
    return back


def _first_weights(rows: ComplexArray) -> Array:
    """Return weights (T, 1, P): back-propagation of the foci reaches each alone, over its target."""
    weights: Array = 1 / (np.abs(rows) ** 2).sum(axis=2)[:, None]
    weights /= weights.max(axis=2, keepdims=True)
    return weights


def _best(
    rows: ComplexArray, drives: ComplexArray, steps: _Steps, even: bool, iterations: int
) -> ComplexArray:
    """Return the best drives (T, 1, M) that iterations come to from drives (T, S, M)."""
    best, highest = drives[:, :1], -1.0
    weights = _first_weights(rows).repeat(drives.shape[1], axis=1)
    for _ in range(iterations + 1):
        pressure = drives @ rows.swapaxes(1, 2)
        size = np.maximum(np.abs(pressure), TINY)
        weakest = size.min(axis=2)
        scores = weakest.min(axis=0) if even else weakest.mean(axis=0)
        if scores.max() > highest:
            best, highest = drives[:, [scores.argmax()]], scores.max()
        weights /= np.maximum(size, UNREACHED * size.max(axis=2, keepdims=True)) ** _DAMPING
        weights /= weights.max(axis=2, keepdims=True)
        before, drives = drives, steps.nearer(drives, (weights * (pressure / size)) @ rows.conj())
        if np.abs(drives - before).max() < _SETTLED:
            break
    return best


class _Steps(NamedTuple):
    """Limits to the steps of phases [rad] from frame to frame, also from the last to the first if closed."""

    limit: float
    closed: bool

    def nearest(self, wanted: ComplexArray) -> ComplexArray:
        """Return the drives (T, S, M) whose largest phase difference from wanted ones is the least.

        Phases are half-way between the highest that stay below those wanted and the lowest that stay above,
        within the limit. On a closed path they turn around the circle as often as the limit allows.
        """
        # [-1] is from the last frame to the first
        turns = np.angle(np.roll(wanted, -1, axis=0) * wanted.conj())
        phases = np.angle(wanted[:1]) + np.concatenate([0 * turns[:1], turns[:-1].cumsum(axis=0)])
        frames = len(wanted)
        if self.closed:
            lap = turns.sum(axis=0)
            most = 2 * math.pi * (frames * self.limit // (2 * math.pi))
            excess = lap - lap.clip(-most, most)
            phases -= excess * (np.arange(frames) / frames)[:, None, None]
            lap -= excess
            phases = np.concatenate([phases - lap, phases, phases + lap])
        ramp = self.limit * np.arange(len(phases))[:, None, None]
        below = np.minimum.accumulate(phases - ramp) + ramp
        below = np.minimum.accumulate((below + ramp)[::-1])[::-1] - ramp
        above = np.maximum.accumulate(phases + ramp) - ramp
        above = np.maximum.accumulate((above - ramp)[::-1])[::-1] + ramp
        middle = (below + above) / 2
        drives: ComplexArray = np.exp(1j * (middle[frames : 2 * frames] if self.closed else middle))
        return drives

    def nearer(self, drives: ComplexArray, wanted: ComplexArray) -> ComplexArray:
        """Return drives (T, S, M), moved as near to wanted ones as the limits to both neighbours allow."""
        drives, frames = drives.copy(), np.arange(len(drives))
        # frames that are no neighbours, also where the first follows the last
        for apart in (frames[:-1:2], frames[1:-1:2], frames[-1:]):
            before, after = drives[apart - 1], drives[(apart + 1) % len(drives)]
            if not self.closed:
                first, last = apart == 0, apart == frames[-1]
                before[first], after[last] = after[first], before[last]
            gap = np.angle(after * before.conj())
            middle = before * np.exp(0.5j * gap)
            room = self.limit - 0.5 * np.abs(gap) if self.limit < math.pi else math.pi
            step = np.angle(wanted[apart] * middle.conj())
            drives[apart] = middle * np.exp(1j * step.clip(-room, room))
        return drives
