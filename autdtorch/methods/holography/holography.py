"""Holography: drives for pressures wanted at points, by a known transfer matrix.

Model-based: it reads the matrix, unlike the methods that see magnitudes alone. Sets of points are a batch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, cast, get_args

import torch

from autdtorch.methods.base import Method, Step, choice, setting, whole
from autdtorch.methods.holography.algorithms import SOLVERS, TINY, Algorithm, descent, within_largest
from autdtorch.methods.problem import Problem, known_matrix, require_pressures
from autdtorch.objectives.goals import Goal
from autdtorch.objectives.objective import GoalFunction, Objective
from autdtorch.objectives.perturbations import innermost
from autdtorch.objectives.scenarios import Scenarios
from autdtorch.utils.array_types import REAL, is_dense
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    complex_tensor,
    integer_at_least,
    invalid,
    real_tensor,
    require_one_of,
)


@dataclass(frozen=True)
class Holography(Method):
    """Compute one drive from the transfer matrix of the problem, by an algorithm of holography.

    The goal tells the wanted pressures: targets [Pa], weights of the weakest focus, 0 for quiet points.
    The matrix is the simulated one, as for `GradientAscent`.

    Attributes:
        algorithm: "naive", "gs", "wgs", "gs_pat" or "diff_pat"; see `holography`.
        iterations: of the algorithm, >= 1; "naive" has none.
        free_amplitudes: whether amplitudes are free in [0, 1]; otherwise all are 1.
        starts: number of first guesses, >= 1, of which the best drive is taken.
    """

    name: ClassVar[str] = "holography"
    label: ClassVar[str] = "holography (model-based)"
    random: ClassVar[bool] = False

    algorithm: Algorithm = choice("wgs", *get_args(Algorithm))
    iterations: int = whole(200, least=1)
    free_amplitudes: bool = setting(False, boolean)
    starts: int = whole(1, least=1)

    def check(self, problem: Problem) -> None:
        """Check that the problem has a transfer matrix, and a goal of pressures."""
        require_pressures(problem, self.name)
        known_matrix(problem)

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Compute the drive, and observe it."""
        matrix = known_matrix(problem)
        targets, absolute = wanted_pressures(problem.goal, problem.foci)
        settings = self.iterations, self.free_amplitudes, self.starts
        if self.algorithm == "diff_pat" and not absolute:
            # as loud as the weakest focus of "wgs" over its weight
            loud = targets > 0
            start = holography(matrix, targets, "wgs", *settings)
            targets = targets * ((matrix @ start).abs()[loud] / targets[loud]).amin()
        drive = holography(matrix, targets, self.algorithm, *settings)
        return Step(drive[None, None], {})


def holography(
    G: ArrayLike | Objective,
    targets: ArrayLike | None = None,
    algorithm: Algorithm = "wgs",
    iterations: int = 200,
    free_amplitudes: bool = False,
    starts: int = 1,
) -> torch.Tensor:
    """Return drives for wanted pressures, for one transfer matrix or a batch of them.

    Args:
        G: transfer matrices (..., P, M), complex [Pa], on the CPU or a GPU; or an objective that has one.
        targets: wanted pressures (..., P) or (P,), >= 0 and not all 0: relative to each other, and [Pa] for
            "diff_pat" and where amplitudes are free. None for 1 everywhere. For `Scenarios` of S scenes
            those of all (S P,), or of one (P,) for each.
        algorithm: "naive", "gs" (iterative back-propagation), "wgs" (weighted), "gs_pat" or "diff_pat".
        iterations: >= 1; "naive" has none.
        free_amplitudes: whether amplitudes are free in [0, 1]; otherwise all are 1, and pressures at best in
            proportion to the targets, except of "diff_pat".
        starts: number of first guesses, >= 1. The drive whose weakest pressure, relative to its target, is
            the highest is returned. The others have random phases, the same in every call. Iterations end in
            local maxima; those of "gs" from equal phases at half of the best for symmetric foci.

    Returns:
        Drives (..., M), complex, |q| <= 1, in the precision and on the device of G.

    Raises:
        ValueError: not finite numbers, shapes that do not fit, negative targets, or a setting out of range.
    """
    require_one_of("algorithm", algorithm, get_args(Algorithm))
    iterations = integer_at_least("iterations", iterations, 1)
    free = boolean("free_amplitudes", free_amplitudes)
    if isinstance(G, Objective):
        objective, problem = G, Problem.of(G)
        require_pressures(problem, algorithm)
        G = known_matrix(problem)
        targets = _of_all_scenes(targets, objective, len(G))
    matrix = _checked_matrix(G)
    wanted = checked_targets(targets, matrix)
    solver = "wgs" if algorithm == "diff_pat" else algorithm
    if (starts := integer_at_least("starts", starts, 1)) == 1:
        drive = _solved(matrix, wanted, solver, iterations, free)
    else:
        drive = _best_of(matrix, wanted, solver, iterations, free, starts)
    wanted, drive = wanted[..., None], drive[..., None]
    if free:
        drive = _scaled(matrix, wanted, drive)
    if algorithm == "diff_pat":
        drive = descent(matrix, wanted, drive, iterations, free)
    if not torch.isfinite(torch.view_as_real(drive).sum()):
        # Names the entry that is not finite. To check all matrices before would take longer than "naive".
        complex_tensor("G", G)
        raise invalid("G", G, "must not overflow in products of its entries")
    return drive[..., 0]


def _of_all_scenes(targets: ArrayLike | None, objective: Objective, points: int) -> ArrayLike | None:
    """Return the targets of the points of all scenes that an objective has; those of one are repeated."""
    scenarios = innermost(objective)
    if targets is None or not isinstance(scenarios, Scenarios):
        return targets
    wanted = real_tensor("targets", targets, "Pa")
    return wanted.repeat(len(scenarios)) if wanted.shape == (points // len(scenarios),) else wanted


def wanted_pressures(goal: GoalFunction, points: int) -> tuple[torch.Tensor, bool]:
    """Return the pressures (P,) that a goal wants, and whether they are absolute [Pa], not relative."""
    if not isinstance(goal, Goal):
        return torch.ones(points, **REAL), False
    return torch.from_numpy(goal.wanted(points)), goal.absolute


def _solved(
    matrix: torch.Tensor, wanted: torch.Tensor, algorithm: str, iterations: int, free: bool
) -> torch.Tensor:
    """Return drives (..., M) for matrices (..., P, M) and wanted pressures (..., P)."""
    if matrix.device.type == "cpu":
        from autdtorch.methods.holography.kernel import solved  # loads numba

        sets = matrix.flatten(0, -3) if matrix.ndim > 2 else matrix[None]
        drive = solved(sets, wanted.reshape(sets.shape[:-1]), algorithm, iterations, free)
        return drive.reshape(*matrix.shape[:-2], matrix.shape[-1])
    project = within_largest if free else torch.sgn
    return SOLVERS[algorithm](matrix, wanted[..., None], iterations, project)[..., 0]


def _best_of(
    matrix: torch.Tensor, wanted: torch.Tensor, algorithm: str, iterations: int, free: bool, starts: int
) -> torch.Tensor:
    """Return the best drives (..., M) of several first guesses.

    Iterations that begin at the drive 1 with rows and columns of other phases begin at these phases of the
    points and transducers.
    """
    points, transducers = matrix.shape[-2:]
    generator, count = torch.Generator("cpu").manual_seed(0), points + transducers
    turns = torch.rand(starts - 1, count, dtype=torch.float64, generator=generator, device="cpu")
    phases = torch.polar(torch.ones_like(turns), 2 * math.pi * turns).to(matrix)
    rows, columns = phases[:, :points, None], phases[:, None, points:]
    guesses = (*matrix.shape[:-2], starts - 1, points)
    turned = matrix[..., None, :, :] * rows * columns
    # iterations at points alone would bring most guesses to the phases of the first
    other = "wgs_drives" if algorithm == "wgs" else algorithm
    others = _solved(turned, wanted[..., None, :].expand(guesses), other, iterations, free) * columns[:, 0]
    first = _solved(matrix, wanted, algorithm, iterations, free)
    drive = torch.cat([first[..., None, :], others], dim=-2)
    pressure = (matrix[..., None, :, :] @ drive[..., None])[..., 0].abs()
    best = (pressure / wanted[..., None, :]).nan_to_num(math.inf).amin(dim=-1).argmax(dim=-1)
    return drive.take_along_dim(best[..., None, None], dim=-2)[..., 0, :]


def _checked_matrix(G: ArrayLike) -> torch.Tensor:
    """Return matrices (..., P, M) in their precision, not yet known to be finite."""
    ready = isinstance(G, torch.Tensor) and G.is_complex() and is_dense(G)
    matrix = cast(torch.Tensor, G).detach() if ready else complex_tensor("G", G).detach()
    if matrix.ndim < 2 or 0 in matrix.shape:
        raise ValueError(f"G: shape {tuple(matrix.shape)}; must be (..., P, M), not empty")
    return matrix.resolve_conj().to(torch.complex64 if matrix.dtype == torch.complex64 else torch.complex128)


def checked_targets(targets: ArrayLike | None, matrix: torch.Tensor) -> torch.Tensor:
    """Return targets (..., P) for matrices (..., P, M), in their precision."""
    shape = matrix.shape[:-1]
    if targets is None:
        return torch.ones(shape, dtype=matrix.real.dtype, device=matrix.device)
    wanted = real_tensor("targets", targets, "Pa").detach()
    if wanted.shape not in (shape, shape[-1:]):
        accepted = f"must be {tuple(shape[-1:])}" + (f" or {tuple(shape)}" if len(shape) > 1 else "")
        raise ValueError(f"targets: shape {tuple(wanted.shape)}; {accepted}")
    if wanted.min() < 0 or not (wanted.amax(dim=-1) > 0).all():
        raise invalid("targets", targets, "must be >= 0, and one of each set > 0", "Pa")
    return wanted.to(matrix.device, matrix.real.dtype).expand(shape)


def _scaled(matrix: torch.Tensor, wanted: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    """Return drives whose pressures are as near to the wanted ones as one factor <= 1 allows."""
    pressure = (matrix @ drive).abs()
    power = pressure.square().sum(dim=-2, keepdim=True).clamp_min(TINY)
    return drive * ((pressure * wanted).sum(dim=-2, keepdim=True) / power).clamp_max(1)
