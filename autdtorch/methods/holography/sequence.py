"""Sequences of drives for foci that move: each frame begins at the one before and stays near it.

A transducer whose phase jumps is silent for a moment, which is audible (Suzuki, Fujiwara, Makino and Shinoda
2020, doi:10.1109/TOH.2020.2965946). So phases change by limited steps from one frame to the next. The common
phase of a frame changes no pressure; it is chosen so that steps have the mean 0.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
import torch

from autdtorch.methods.holography.algorithms import DAMPING, TINY, UNREACHED
from autdtorch.methods.holography.holography import checked_targets
from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    complex_tensor,
    integer_at_least,
    invalid,
    positive,
)

_FIRST = 10  # Times as many iterations for the first frame, which has none before it


@one_library_thread()
def drive_sequence(
    G: ArrayLike,
    targets: ArrayLike | None = None,
    phase_step: float = math.pi,
    closed: bool = False,
    even: bool = True,
    iterations: int = 10,
) -> torch.Tensor:
    """Return a drive for each frame of a path of foci, by "wgs" from the frame before.

    Model-based, as `holography`. A limit below the steps that the path needs lowers the pressure: the drive
    lags behind the foci. More frames for the path need smaller steps.

    Args:
        G: transfer matrices of the frames (T, P, M), complex [Pa].
        targets: wanted pressures (T, P) or (P,), > 0 and relative to each other; None for 1 everywhere.
        phase_step: largest change of a phase from one frame to the next [rad], > 0.
        closed: whether the first frame follows the last one again, within the same limit.
        even: whether each frame is scaled down to the level of the weakest frame, which is the pressure of
            its weakest focus over the target; otherwise all amplitudes are 1.
        iterations: of each frame, >= 1.

    Returns:
        Drives (T, M), complex128, |q| <= 1.

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
    drives = _forward(rows, _first(rows[0], _FIRST * iterations), limit, iterations)
    if closed:
        drives = _closed(rows, drives, limit, iterations)
    if even:
        level = np.abs(rows @ drives[..., None]).min(axis=(1, 2))
        drives *= (level.min() / np.maximum(level, TINY))[:, None]
    return torch.from_numpy(drives)


def _first(matrix: ComplexArray, iterations: int) -> ComplexArray:
    """Return the drive (M,) that iterations come to from back-propagation."""
    drive = np.exp(1j * np.angle(matrix.conj().T @ np.ones(len(matrix))))
    near = functools.partial(_near, drive, math.pi)
    return _frame(matrix, drive, near, np.ones(len(matrix)), None, iterations)[0]


def _forward(rows: ComplexArray, first: ComplexArray, limit: float, iterations: int) -> ComplexArray:
    """Return drives (T, M) of frames (T, P, M), from the first drive on."""
    drives, weights = first[None].repeat(len(rows), axis=0), np.ones(rows.shape[1])
    for frame in range(1, len(rows)):
        before = drives[frame - 1]
        near = functools.partial(_near, before, limit)
        drives[frame], weights = _frame(rows[frame], before, near, weights, None, iterations)
    return drives


def _closed(rows: ComplexArray, drives: ComplexArray, limit: float, iterations: int) -> ComplexArray:
    """Return drives (T, M) of a path that begins again, from the drives of one lap.

    A second lap begins at the end of the first. The difference of the foci's phases after a lap is spread
    evenly over its frames. The last frames stay near the first one, by a limit for each step that is left.
    """
    ends = _forward(np.stack([rows[-1], rows[0]]), drives[-1], limit, iterations)
    lap, around = np.concatenate([drives, ends[1:]]), np.concatenate([rows, rows[:1]])
    pressure = (around @ lap[..., None])[..., 0]
    missed = np.angle(pressure[-1] * pressure[0].conj())
    left = 1 - np.arange(len(rows))[:, None] / len(rows)
    imposed = np.exp(1j * (np.angle(pressure[:-1]) + missed * left))
    second, weights = np.concatenate([lap[-1:], lap[1:-1]]), np.ones(rows.shape[1])
    for frame in range(1, len(rows)):
        reach = limit * (len(rows) - frame)
        near = functools.partial(_near_both, second[frame - 1], second[0], limit, reach)
        start = near(rows[frame].conj().T @ (weights * imposed[frame]))
        second[frame], weights = _frame(rows[frame], start, near, weights, imposed[frame], iterations)
    return second


def _frame(
    matrix: ComplexArray,
    drive: ComplexArray,
    near: Callable[[ComplexArray], ComplexArray],
    weights: Array,
    imposed: ComplexArray | None,
    iterations: int,
) -> tuple[ComplexArray, Array]:
    """Return the best drive (M,) that the iterations come to from a drive, and the last weights (P,).

    Signs of the pressures (P,) may be imposed.
    """
    back, best, highest = matrix.conj().T, drive, -1.0
    for _ in range(iterations + 1):
        pressure = matrix @ drive
        size = np.maximum(np.abs(pressure), TINY)
        if size.min() > highest:
            best, highest = drive, float(size.min())
        weights = weights * (size.mean() / np.maximum(size, UNREACHED * size.max())) ** DAMPING
        weights /= weights.max()
        drive = near(back @ (weights * (pressure / size if imposed is None else imposed)))
    return best, weights


def _near(before: ComplexArray, limit: float, drive: ComplexArray) -> ComplexArray:
    """Return the drive (M,) nearest to one of any amplitudes and common phase, within a limit of `before`."""
    common = (drive * before.conj()).sum()
    step = np.angle(drive * (common.conjugate() / max(abs(common), TINY)) * before.conj())
    nearest: ComplexArray = before * np.exp(1j * step.clip(-limit, limit))
    return nearest


def _near_both(
    before: ComplexArray, first: ComplexArray, limit: float, reach: float, drive: ComplexArray
) -> ComplexArray:
    """Return the drive (M,) nearest to one of any amplitudes, within limits of two others.

    The phases are at most `limit` from `before` and `reach` from `first`, which are at most the sum of both
    limits apart.
    """
    step = np.angle(drive * before.conj()).clip(-limit, limit)
    if reach < math.pi:
        away = np.angle(before * first.conj())
        step = (away + step).clip(-reach, reach) - away
    nearest: ComplexArray = before * np.exp(1j * step)
    return nearest
