"""The question whether any drive attains a score: a drive that does, or a certificate that none does.

The semidefinite relaxation (`hermitian`) can be positive where no drive is: a mixture of drives may make all
of J Hermitian forms A_j positive. With few transducers, cells of drives decide. Drives with the largest
amplitude at transducer r have ratios u_i = q_i / q_r with |u_i| <= 1. A cell has each ratio in a square. With
its circumscribed disc of centre c and radius d,

    q^H B_i q = d^2 |q_r|^2 - |q_i - c q_r|^2 >= 0

is one more Hermitian form. Where weights w >= 0 make sum w_j A_j + sum w_i B_i negative definite, no drive of
the cell makes all forms A_j >= 0. Other cells have a mixture of drives that makes all these forms positive:
an ascent starts from its main drive, and the cell is divided where the mixture is widest.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.optimize
import torch

from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.problem import Problem, known_matrix
from autdtorch.methods.run import run
from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.forces import LeastForm
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.hermitian import ascended
from autdtorch.objectives.objective import GoalFunction, Objective
from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import finite_number, require_kind

_STARTS = 4, 28  # of ascents; the second where the first decide nothing, nor cells
_FEW = 4  # transducers, whose drives can be divided into cells

_MARGIN = 1e-9  # of eigenvalues; rounding of forms of size 1 is below 1e-12
_CUTS = 40  # eigenvectors for a cell
_CELLS = 300  # at most half a minute
_NARROW = 2e-3  # forms of discs are below 1.3e5 then, and their rounding below the margin
_REACH = math.sqrt(2) * (1 + 1e-9)  # of a disc around a square of half width 1
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Attainable:
    """The highest score known, and a bound on all.

    Attributes:
        least: the score asked for.
        score: the highest score that gradient ascent reaches.
        drive: with this score (M,).
        bound: no drive of amplitudes <= 1 scores above it.
    """

    least: float
    score: float
    drive: torch.Tensor
    bound: float

    @property
    def answer(self) -> bool | None:
        """True: `drive` scores above `least`. False: by `bound`, none does. None: neither is known."""
        if self.score > self.least:
            return True
        return False if self.bound <= self.least else None


def attainable(
    objective: Objective, least: float = 0.0, goal: GoalFunction = WEAKEST_FOCUS, seed: int = 0
) -> Attainable:
    """Return whether a drive scores above `least`, by gradient ascent and the bound of the goal.

    For forces with up to four transducers, ascents from cells of drives, and bounds on each, decide what
    these leave open.

    Args:
        objective: with a transfer matrix, such as a `ForceObjective` of a trap. Perturbations around it
            change the scores of drives, not the bound.
        least: the score.
        goal: with a bound; the default gives way to a goal of the objective.
        seed: of the drives that ascents start from, >= 0.

    Raises:
        ValueError: an objective without transfer matrix, or a function that is no `Goal`.
    """
    least = finite_number("least", least)
    problem = Problem.of(objective, goal)
    require_kind("goal", problem.goal, Goal)
    assert isinstance(problem.goal, Goal)
    matrix = known_matrix(problem)
    best = Attainable(least, -math.inf, torch.zeros_like(matrix[0]), problem.goal.bound(matrix))
    for trial, starts in enumerate(_STARTS):
        solution = run(GradientAscent(starts=starts), objective, [trial], seed, goal=problem.goal)
        if (score := float(solution.score[0])) > best.score:
            best = replace(best, score=score, drive=solution.drive[0])
        if best.answer is not None:
            break
        if isinstance(problem.goal, LeastForm) and problem.transducers <= _FEW and least >= 0:
            return _by_cells(best, objective, problem, problem.goal)
    return best


def _by_cells(best: Attainable, objective: Objective, problem: Problem, goal: LeastForm) -> Attainable:
    """Return what cells of drives decide of a force.

    They know the simulation alone, so that the score is as observed: transducers may have failed.
    """
    drive, excluded = search_above(checked_matrix(known_matrix(problem)), goal.weights, best.least)
    if drive is None:
        return replace(best, bound=best.least) if excluded else best
    played = problem.quantise(torch.from_numpy(drive)[None])
    score = float(goal(objective(played))[0])
    return replace(best, score=score, drive=played[0]) if score > best.score else best


class _Cell(NamedTuple):
    """Drives with the largest amplitude at one transducer, and each ratio to it in a square.

    `vectors` (V, M): of the cell that it is a part of, whose forms decide here too.
    """

    largest: int
    centres: ComplexArray
    widths: Array
    vectors: ComplexArray


@one_library_thread()
def search_above(rows: ComplexArray, weights: Array, least: float) -> tuple[ComplexArray | None, bool]:
    """Search a drive of amplitudes <= 1 that makes all forms larger than `least`.

    Args:
        rows: R (N, M); the effort grows fast with M.
        weights: W (J, N); see `hermitian`.
        least: >= 0.

    Returns:
        Such a drive (M,), or None, and whether it is proved that there is none.
    """
    forms = np.stack([(rows.conj().T * row) @ rows for row in weights])
    sizes = np.abs(weights) @ (np.abs(rows) ** 2).sum(axis=1)
    unit = np.eye(rows.shape[1])
    whole = np.zeros(len(unit) - 1, complex), np.ones(len(unit) - 1), np.zeros((0, len(unit)), complex)
    cells = deque(_Cell(largest, *whole) for largest in range(len(unit)))
    for _ in range(_CELLS):
        if not cells:
            return None, True
        cell = cells.popleft()
        full = np.diag(unit[cell.largest])
        # of a drive with amplitude 1 at the largest; a lower one has lower forms
        above = (forms - least * full) / (sizes + least)[:, None, None]
        mixture, vectors = _mixture(np.concatenate([above, _limits(cell, unit)]), cell.vectors)
        if mixture is None:
            continue
        main = np.linalg.eigh(mixture)[1][:, -1]
        drive = ascended(rows, weights, main[None] / np.abs(main).max())[0]
        if (weights @ np.abs(rows @ drive) ** 2).min() > least:
            return drive, False
        if not cell.widths.size or cell.widths.min() < _NARROW:
            break
        cells += _divided(cell._replace(vectors=vectors), mixture)
    return None, False


def _limits(cell: _Cell, unit: Array) -> ComplexArray:
    """Return forms (2 M - 2, M, M) that are positive in a cell: of amplitudes, and of discs."""
    others, full = np.delete(unit, cell.largest, axis=0), np.diag(unit[cell.largest])
    away = others - cell.centres.conj()[:, None] * unit[cell.largest]
    radii = _REACH * cell.widths[:, None, None]
    amplitudes = full - others[:, :, None] * others[:, None]
    return np.concatenate([amplitudes, full - away[:, :, None] * away[:, None].conj() / radii**2])


def _divided(cell: _Cell, mixture: ComplexArray) -> list[_Cell]:
    """Return the four parts of a cell, by the ratio that differs most among the drives of a mixture (M, M).

    Parts with ratios above 1 are left out.
    """
    largest = mixture[:, cell.largest]
    spread = mixture.diagonal().real - np.abs(largest) ** 2 / max(largest[cell.largest].real, _TINY)
    widest = int(np.delete(spread, cell.largest).argmax())
    widths = cell.widths.copy()
    widths[widest] /= 2
    parts = []
    for corner in (1 + 1j, 1 - 1j, -1 + 1j, -1 - 1j):
        centres = cell.centres.copy()
        centres[widest] += corner * widths[widest]
        nearest = (max(abs(at) - widths[widest], 0.0) for at in (centres[widest].real, centres[widest].imag))
        if math.hypot(*nearest) <= 1:
            parts.append(cell._replace(centres=centres, widths=widths))
    return parts


def _mixture(forms: ComplexArray, vectors: ComplexArray) -> tuple[ComplexArray | None, ComplexArray]:
    """Return a mixture of drives that makes all forms positive, as far as is known.

    Weights >= 0 that make the sum of the forms negative definite rule it out. The search takes cutting
    planes: linear programs over the weights, with the forms at the eigenvectors so far.

    Args:
        forms: (C, M, M).
        vectors: (V, M) to begin with.

    Returns:
        The mixture (M, M), a sum of x x^H, or None if it is ruled out; and the vectors (V', M) of the search.
    """
    count = len(forms)
    weights, shares = np.full(count, 1 / count), np.zeros(0)
    for _ in range(_CUTS):
        if len(vectors):
            cuts = np.einsum("vi,cij,vj->vc", vectors.conj(), forms, vectors, optimize=True).real
            program = scipy.optimize.linprog(
                np.append(np.zeros(count), 1.0),
                A_ub=np.hstack([cuts, -np.ones((len(cuts), 1))]),
                b_ub=np.zeros(len(cuts)),
                A_eq=np.append(np.ones(count), 0.0)[None],
                b_eq=[1.0],
                bounds=[(0, None)] * count + [(None, None)],
            )
            if program.x is None:
                break
            shares, weights = -program.ineqlin.marginals, np.maximum(program.x[:-1], 0)
            if program.fun >= -_MARGIN:
                break
        values, at = np.linalg.eigh(np.tensordot(weights, forms, 1))
        if values[-1] < -_MARGIN:
            return None, vectors
        vectors = np.vstack([vectors, at[:, -1]])
    vectors, shares = vectors[: len(shares)][shares > 0], shares[shares > 0]
    return (vectors.T * shares) @ vectors.conj(), vectors
