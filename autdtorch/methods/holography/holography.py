"""Holography: drives for pressures wanted at points, by a known transfer matrix G and p = G q.

Model-based: unlike the methods that see magnitudes alone, these read the matrix. All take sets of points as a
batch. With t the wanted pressures, x / |x| entry by entry, and * for a product of entries:

- "naive": q = sgn(G^H t), back-propagation;
- "gs": p = t * sgn(G q), q = sgn(G^H p) in turns (Gerchberg and Saxton 1972), iterative back-propagation of
  Marzo and Drinkwater (2019), doi:10.1073/pnas.1813047115;
- "wgs": b is multiplied by (t / |G q|)^(1/2) and divided by its largest entry, p = b * sgn(G q),
  q = sgn(G^H p) (Di Leonardo, Ianni and Ruocco 2007), doi:10.1364/OE.15.001913, whose power is 1: close foci
  then change places for ever. The q of the highest weakest pressure over its target is kept;
- "gs_pat": p = G G^H (t * sgn(p)) in turns, and in the end q = sgn(G^H (t^2 * p / |p|^2)) (Martinez Plasencia
  et al. 2020), doi:10.1145/3386569.3392492;
- "diff_pat": Adam on the phases, from those of "wgs", for the least sum of (|p| - t)^2 (Fushimi, Yamamoto and
  Ochiai 2021), doi:10.1038/s41598-021-91880-2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias, cast, get_args

import torch

from autdtorch.methods.base import Method, Problem, Step, known_matrix
from autdtorch.objectives.goals import Goal
from autdtorch.objectives.objective import Objective, Score
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    complex_tensor,
    integer_at_least,
    invalid,
    is_dense,
    real_tensor,
    require_one_of,
)

Algorithm: TypeAlias = Literal["naive", "gs", "wgs", "gs_pat", "diff_pat"]
Project: TypeAlias = Callable[[torch.Tensor], torch.Tensor]

_RATES = 0.1, 0.001  # First and last step of Adam [rad, or amplitudes]
_MOMENTS = 0.9, 0.99  # Shares of the old means of gradients and their squares in the new ones
TINY = 1e-30
DAMPING = 0.5
"""Power of wanted over present pressure in the weights of "wgs"; 1 overshoots."""

UNREACHED = 1e-6  # Pressure, relative to the loudest point, below which a point gets no more weight


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

    algorithm: Algorithm = "wgs"
    iterations: int = 200
    free_amplitudes: bool = False
    starts: int = 1

    def __post_init__(self) -> None:
        """Check the settings."""
        require_one_of("algorithm", self.algorithm, get_args(Algorithm))
        object.__setattr__(self, "iterations", integer_at_least("iterations", self.iterations, 1))
        object.__setattr__(self, "free_amplitudes", boolean("free_amplitudes", self.free_amplitudes))
        object.__setattr__(self, "starts", integer_at_least("starts", self.starts, 1))

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Compute the drive, and observe it."""
        matrix = known_matrix(problem)
        targets, absolute = wanted_pressures(problem.goal, problem.foci)
        if self.algorithm == "diff_pat" and not absolute:
            # as loud as the weakest focus of "wgs" over its weight
            loud = targets > 0
            settings = self.iterations, self.free_amplitudes, self.starts
            start = holography(matrix, targets, "wgs", *settings)
            targets = targets * ((matrix @ start).abs()[loud] / targets[loud]).amin()
        settings = self.iterations, self.free_amplitudes, self.starts
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
            "diff_pat" and where amplitudes are free. None for 1 everywhere.
        algorithm: "naive", "gs" (iterative back-propagation), "wgs" (weighted), "gs_pat" or "diff_pat".
        iterations: >= 1; "naive" has none.
        free_amplitudes: whether amplitudes are free in [0, 1]; otherwise all are 1, and pressures at best in
            proportion to the targets, except of "diff_pat".
        starts: number of first guesses, >= 1. The drive whose weakest pressure, relative to its target, is
            the highest is returned. The first guess has equal phases, the others have random ones,
            the same in every call. Iterations end in local maxima, at half of the best for symmetric foci.

    Returns:
        Drives (..., M), complex, |q| <= 1, in the precision and on the device of G.

    Raises:
        ValueError: not finite numbers, shapes that do not fit, negative targets, or a setting out of range.
    """
    require_one_of("algorithm", algorithm, get_args(Algorithm))
    iterations = integer_at_least("iterations", iterations, 1)
    free = boolean("free_amplitudes", free_amplitudes)
    if isinstance(G, Objective):
        G = known_matrix(Problem.of(G))
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
        drive = _descent(matrix, wanted, drive, iterations, free)
    if not torch.isfinite(torch.view_as_real(drive).sum()):
        # Names what is not finite. To check all matrices before would take longer than "naive".
        complex_tensor("G", G)
        raise invalid("G", G, "must not overflow in products with its own entries")
    return drive[..., 0]


def wanted_pressures(goal: Score, points: int) -> tuple[torch.Tensor, bool]:
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
    project = _within_largest if free else torch.sgn
    return _SOLVERS[algorithm](matrix, wanted[..., None], iterations, project)[..., 0]


def _best_of(
    matrix: torch.Tensor, wanted: torch.Tensor, algorithm: str, iterations: int, free: bool, starts: int
) -> torch.Tensor:
    """Return the best drives (..., M) of several first guesses.

    Iterations that begin at the drive 1 with rows and columns of other phases begin at these phases of the
    points and transducers.
    """
    points, transducers = matrix.shape[-2:]
    generator, count = torch.Generator("cpu").manual_seed(0), points + transducers
    turns = torch.rand(starts, count, dtype=torch.float64, generator=generator, device="cpu")
    turns[0] = 0
    phases = torch.polar(torch.ones_like(turns), 2 * math.pi * turns).to(matrix)
    rows, columns = phases[:, :points, None], phases[:, None, points:]
    guesses = (*matrix.shape[:-2], starts, points)
    turned = matrix[..., None, :, :] * rows * columns
    drive = _solved(turned, wanted[..., None, :].expand(guesses), algorithm, iterations, free) * columns[:, 0]
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
    given = real_tensor("targets", targets, "Pa").detach()
    if given.shape not in (shape, shape[-1:]):
        accepted = f"must be {tuple(shape[-1:])}" + (f" or {tuple(shape)}" if len(shape) > 1 else "")
        raise ValueError(f"targets: shape {tuple(given.shape)}; {accepted}")
    if given.min() < 0 or not (given.amax(dim=-1) > 0).all():
        raise invalid("targets", targets, "must be >= 0, and one of each set > 0", "Pa")
    return given.to(matrix.device, matrix.real.dtype).expand(shape)


def _naive(matrix: torch.Tensor, wanted: torch.Tensor, iterations: int, project: Project) -> torch.Tensor:
    return project(matrix.mH @ wanted.to(matrix.dtype))


def _in_turns(matrix: torch.Tensor, wanted: torch.Tensor, iterations: int, project: Project) -> torch.Tensor:
    back, drive = matrix.mH.resolve_conj(), torch.ones_like(matrix[..., :1, :]).mT
    for _ in range(iterations):
        drive = project(back @ (wanted * (matrix @ drive).sgn()))
    return drive


def _weighted(matrix: torch.Tensor, wanted: torch.Tensor, iterations: int, project: Project) -> torch.Tensor:
    back, drive = matrix.mH.resolve_conj(), torch.ones_like(matrix[..., :1, :]).mT
    weights, best, highest = wanted, drive, torch.zeros_like(wanted[..., :1, :])
    for _ in range(iterations):
        drive = project(back @ (weights * (matrix @ drive).sgn()))
        size = (matrix @ drive).abs()
        loudest = size.amax(dim=-2, keepdim=True).clamp_min(TINY)
        # the weight of a point that no transducer reaches would outgrow all others
        share = torch.where(size > UNREACHED * loudest, size, loudest) / wanted
        level = share.amin(dim=-2, keepdim=True)
        worse = level <= highest  # not where a matrix is not finite, which is refused later
        best, highest = torch.where(worse, best, drive), torch.maximum(level, highest)
        weights = torch.where(wanted > 0, weights / share.pow(DAMPING), 0.0)
        weights = weights / weights.amax(dim=-2, keepdim=True)
    return best


def _at_points(matrix: torch.Tensor, wanted: torch.Tensor, iterations: int, project: Project) -> torch.Tensor:
    both, pressure = matrix @ matrix.mH, wanted.to(matrix.dtype)
    both = both / both.abs().amax(dim=(-2, -1), keepdim=True).clamp_min(TINY)  # against overflow
    for _ in range(iterations):
        pressure = both @ (wanted * pressure.sgn())
    return project(matrix.mH @ (wanted.square() * pressure.sgn() / pressure.abs().clamp_min(TINY)))


_SOLVERS = {"naive": _naive, "gs": _in_turns, "wgs": _weighted, "gs_pat": _at_points}


def _descent(
    matrix: torch.Tensor, wanted: torch.Tensor, drive: torch.Tensor, iterations: int, free: bool
) -> torch.Tensor:
    """Return drives (..., M, 1) with the least sum of (|p| - t)^2 that Adam finds from drives (..., M, 1)."""
    phase, size, back = drive.angle(), drive.abs(), matrix.mH.resolve_conj()
    means, squares = torch.zeros_like(drive), torch.zeros_like(drive)
    for step in range(1, iterations + 1):
        drive = torch.polar(size, phase)
        pressure = matrix @ drive
        flow = (back @ ((pressure.abs() - wanted) * pressure.sgn())).conj() * drive.sgn()
        # by the amplitude, and by the phase times the amplitude
        slope = torch.complex(flow.real, -flow.imag * size)
        means = _MOMENTS[0] * means + (1 - _MOMENTS[0]) * slope
        square = torch.complex(slope.real.square(), slope.imag.square())
        squares = _MOMENTS[1] * squares + (1 - _MOMENTS[1]) * square
        rate = _RATES[0] * (_RATES[1] / _RATES[0]) ** (step / iterations)
        mean, spread = means / (1 - _MOMENTS[0] ** step), squares / (1 - _MOMENTS[1] ** step)
        phase = phase - rate * mean.imag / (spread.imag.sqrt() + TINY)
        if free:
            size = (size - rate * mean.real / (spread.real.sqrt() + TINY)).clamp(0, 1)
    return torch.polar(size, phase)


def _within_largest(drive: torch.Tensor) -> torch.Tensor:
    return drive / drive.abs().amax(dim=-2, keepdim=True).clamp_min(TINY)


def _scaled(matrix: torch.Tensor, wanted: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    """Return drives whose pressures are as near to the wanted ones as one factor <= 1 allows."""
    pressure = (matrix @ drive).abs()
    power = pressure.square().sum(dim=-2, keepdim=True).clamp_min(TINY)
    return drive * ((pressure * wanted).sum(dim=-2, keepdim=True) / power).clamp_max(1)
