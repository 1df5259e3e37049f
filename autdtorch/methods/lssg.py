"""LSS, the linear synthesis scheme, and LSSG, the coordinate ascent over its offsets (paper's baseline)."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch

from autdtorch.methods.base import Method, State, Step, first_of_best, setting, whole
from autdtorch.methods.gain_trend import steadied, step_doubts
from autdtorch.methods.problem import FOR_FORCE, Problem
from autdtorch.objectives.goals import scores_pressures
from autdtorch.objectives.over_scenes import OverScenes
from autdtorch.scene.arrays import phase_offsets_of
from autdtorch.scene.drive import drive_from_phases, focus_phases, normalise, phases_of
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.validation import integers, invalid

Search = Mapping[str, torch.Tensor]
"""The state of the ascent of L trials over N weights:

- ``weights`` (L, N), complex128: e^{-i phi}, or 0 for what is off; ``before``: as they were before this pass.
- ``order`` (L, K): indices of the weights to go through in a pass.
- ``trend``, ``drifting``: of the gain, as `steadied`.
"""


def order_setting(*names: str) -> Any:
    """Return the field of a setting that is one of these names, the first by default, or indices."""
    return setting(names[0], functools.partial(_checked_order, names=names))


def _checked_order(name: str, order: str | Sequence[int], names: Sequence[str]) -> str | tuple[int, ...]:
    if isinstance(order, str) and order in names:
        return order
    quoted = ", ".join(f'"{name}"' for name in names)
    accepted = f"must be {quoted} or the indices of all, each once"
    chosen = tuple(integers(name, order, 0, accepted))
    if sorted(chosen) != list(range(len(chosen))):
        raise invalid(name, order, accepted)
    return chosen


def require_all(order: str | Sequence[int], count: int) -> None:
    """Check that an order by indices has `count` of them."""
    if not isinstance(order, str) and len(order) != count:
        raise invalid("order", order, f"must be the indices 0 to {count - 1}, each once")


def indices_of(order: str | Sequence[int], count: int) -> torch.Tensor:
    """Return the indices (count,) of an order; ascending where the order is a name."""
    return torch.tensor(range(count) if isinstance(order, str) else order, dtype=torch.int64, device="cpu")


def at_levels(drive: torch.Tensor, levels: int) -> torch.Tensor:
    """Return drives (L, N) with the nearest of the phases, and amplitudes 1 where they are on."""
    nearest = (phases_of(drive) * levels / (2 * math.pi)).round().to(torch.int64) % levels
    return torch.where(drive == 0, 0, _phases(levels)[nearest])


def begin_ascent(weights: torch.Tensor, order: torch.Tensor) -> Search:
    """Return the state of an ascent from weights (L, N)."""
    return {"weights": weights, "before": weights, "order": order}


def candidates(search: Search, levels: int, step: int) -> torch.Tensor:
    """Return the weights (L, levels, N) to compare in a step: all phases of its weight.

    The present phase is among them, so that a choice is made among observations of one time: a lucky reading,
    or the drift since, does not hold a phase for ever.
    """
    weights, order = search["weights"][:, None], search["order"]
    index = order[:, step % order.shape[1], None, None].expand(-1, levels, 1)
    phases = _phases(levels)[:, None].expand(len(order), -1, 1)
    return weights.expand(-1, levels, -1).scatter(2, index, phases)


def ascend(search: Search, step: int, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
    """Take the best of the `candidates` of a step; of near ties the first.

    Args:
        search: the state of the ascent.
        step: its number.
        state: with the drives (L, levels, M) that were observed.
        pressure: magnitudes (L, levels, P) [Pa].
        score: of these (L, levels).

    Returns:
        A step without drives. A trial ends after a pass that changed none of its weights. Where the gain
        drifts, the choice takes the place of the best before, whose reading is of another gain.
    """
    search, score = steadied(state.problem, search, state.drives, pressure, score)
    order, best = search["order"], first_of_best(score)
    index = order[:, step % order.shape[1], None]
    weights = search["weights"].scatter(1, index, _phases(score.shape[1])[best][:, None])
    chosen = best.masked_fill(search["drifting"] == 0, -1)
    none = state.drives[:, :0]
    if (step + 1) % order.shape[1]:
        return Step(none, {**search, "weights": weights}, None, chosen)
    goes_on = (weights != search["before"]).any(dim=1)
    further = {name: search[name][goes_on] for name in ("trend", "drifting")}
    search = {**search, **begin_ascent(weights[goes_on], order[goes_on]), **further}
    return Step(none, search, goes_on, chosen)


def ascent_doubts(state: State, others: Sequence[Iterable[str]]) -> Sequence[Iterable[str]]:
    """Describe a drift of the gain when it is first seen, after `others` of the trials, if there are any."""
    drifts = step_doubts(state)
    return list(map(itertools.chain, others, drifts)) if others else drifts


@functools.lru_cache(maxsize=8)
def _phases(levels: int) -> torch.Tensor:
    """Return e^{-i phi} (levels,) of the phases to compare."""
    turns = torch.arange(levels, **REAL)
    return drive_from_phases(2 * math.pi * turns / levels)


@dataclass(frozen=True)
class LSS(Method):
    """Superpose the free-space drives of the single foci, all offsets 0 (Eq. 4, 5 and 6).

    One evaluation, in which nothing is searched. The amplitudes are in [0, 1], not all 1.
    """

    name: ClassVar[str] = "lss"
    label: ClassVar[str] = "LSS"
    random: ClassVar[bool] = False

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe the superposition."""
        return Step(normalise(_focus_drives(problem).sum(dim=0))[None, None], {})


@dataclass(frozen=True)
class LSSG(Method):
    """Superpose the free-space drives of the single foci, with the best offset for each (Eq. 4, 5 and 6).

    The search starts from `LSS`, all offsets 0, and goes through the foci in order: each tries `levels`
    offsets while the others stay, and keeps the best. Since 0 is among them, LSSG is never worse than LSS. A
    pass takes P * levels evaluations, as many as the paper's: 64 with 4 foci. The search ends early with a
    pass that changes nothing. Obstacles enter through the observed scores, not through the phases. The
    amplitudes are in [0, 1], not all 1. For a force, the foci are the scene's control points, two or more.
    Where the gain drifts, the last choice is the solution, as of `GABS`.

    Attributes:
        levels: number of offsets in [0, 2 pi), >= 2.
        order: of the foci: "given" as the control points are, or all their indices.
        passes: >= 1.
    """

    name: ClassVar[str] = "lssg"
    label: ClassVar[str] = "LSSG"
    random: ClassVar[bool] = False

    levels: int = whole(16, least=2)
    order: Literal["given"] | Sequence[int] = order_setting("given")
    passes: int = whole(1, least=1)

    def check(self, problem: Problem) -> None:
        """Check the order against the number of foci, and that offsets of these change a force."""
        if _foci(problem) == 1 and not scores_pressures(problem.goal):
            accepted = f"must be 2 or more, whose foci lssg superposes; else {FOR_FORCE}"
            raise invalid("number of control points", 1, accepted)
        require_all(self.order, _foci(problem))

    def most_evaluations(self, problem: Problem) -> int:
        """Return the evaluations of all passes."""
        return self.passes * _foci(problem) * self.levels

    def most_at_once(self, problem: Problem) -> int:
        """Return the number of levels."""
        return self.levels

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Compare the offsets of the first focus."""
        foci = _focus_drives(problem)
        start = torch.ones(1, len(foci), **COMPLEX)
        order = indices_of(self.order, len(foci))[None]
        search = {**begin_ascent(start, order), "foci": foci}
        return Step(normalise(candidates(search, self.levels, 0) @ foci), search)

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Compare the offsets of the next focus."""
        step = state.best.history.shape[1] // self.levels
        done = ascend(state.search, step - 1, state, pressure, score)
        if step == self.passes * _foci(state.problem):
            return done
        weights = candidates(done.search, self.levels, step)
        return done._replace(drives=normalise(weights @ done.search["foci"]))

    def _doubts(self, state: State) -> Sequence[Iterable[str]]:
        """Describe a lone highest score at the end, and a drift of the gain when it is first seen."""
        return ascent_doubts(state, super()._doubts(state))


def _foci(problem: Problem) -> int:
    """Return the number of foci, in one scene if there are several: for a force, the control points."""
    goal = problem.goal
    if problem.scene is not None and not scores_pressures(problem.goal):
        return len(problem.scene.control_points)
    return problem.foci // goal.scenes if isinstance(goal, OverScenes) else problem.foci


def _focus_drives(problem: Problem) -> torch.Tensor:
    """Return the drives that aim at each focus in free space (P, M)."""
    scene = problem.scene
    if scene is None:
        raise invalid("problem.scene", None, "must be a scene: the phases of the foci need its geometry")
    if len(scene.control_points) != _foci(problem):
        accepted = f"must be the readings of the {len(scene.control_points)} control points"
        raise invalid("problem.foci", problem.foci, accepted)
    phases = focus_phases(scene.array.positions, scene.control_points, scene.wavenumber)
    return drive_from_phases(phases + phase_offsets_of(scene.array))
