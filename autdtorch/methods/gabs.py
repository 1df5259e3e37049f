"""GABS: the greedy algorithm with brute-force search (Algorithm 2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch

from autdtorch.methods.base import NEAR_TIE, Method, State, Step, whole
from autdtorch.methods.lssg import (
    Search,
    ascend,
    ascent_doubts,
    at_levels,
    begin_ascent,
    candidates,
    indices_of,
    order_setting,
    require_all,
)
from autdtorch.methods.problem import Problem, starts_of
from autdtorch.methods.seeds import generators_of
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.validation import invalid


@dataclass(frozen=True)
class GABS(Method):
    """Switch on one transducer after the other, each with the best of several phases (Algorithm 2).

    Further passes go through all M transducers again in the same order, while the others keep their phases
    (coordinate ascent). A trial ends early with a pass that changes nothing. Where the last transducers only
    do harm, the best drive observed leaves them off.

    Where the problem has a drive to start from, all its transducers are on from the beginning, with the
    nearest of the phases, and every pass goes through all M of them: 1 + M * levels evaluations.

    Where the gain drifts, as on a bench that warms up, the readings of a step are compared without its trend,
    and the last choice is the solution.

    A trial takes 1 + (M - 1) * levels evaluations: the first transducer alone, whose phase changes no
    magnitude, then `levels` for each of the others. That is 241 for the paper's M = levels = 16; the paper
    counts M * levels = 256. The order "strength" takes M - 1 more, each further pass at most M * levels.

    Attributes:
        levels: number of phases in [0, 2 pi), >= 2.
        order: of the transducers. "random": another one in each trial; "given": the order of the array, as
            in Algorithm 2; "strength": by falling score of each transducer alone; or all their indices.
        first: index of the transducer to begin with, before the others in their order; None for the first of
            the order.
        passes: >= 1.
    """

    name: ClassVar[str] = "gabs"
    label: ClassVar[str] = "GABS"

    levels: int = whole(16, least=2)
    order: Literal["random", "given", "strength"] | Sequence[int] = order_setting(
        "random", "given", "strength"
    )
    first: int | None = whole(None, least=0)
    passes: int = whole(1, least=1)

    def check(self, problem: Problem) -> None:
        """Check order and first transducer against the number of transducers."""
        require_all(self.order, problem.transducers)
        if self.first is not None and self.first >= problem.transducers:
            raise invalid("first", self.first, f"must be an integer from 0 to {problem.transducers - 1}")

    def most_evaluations(self, problem: Problem) -> int:
        """Return the evaluations of all passes."""
        steps = self.passes * problem.transducers - self._skipped(problem)
        return self._alone(problem) + steps * self.levels

    def most_at_once(self, problem: Problem) -> int:
        """Return the number of levels, or of transducers observed alone."""
        return max(self.levels, self._alone(problem))

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe the first transducer alone, or each alone where their strengths decide the order."""
        count = problem.transducers
        if self.order == "strength":
            alone = torch.eye(count, **COMPLEX)
            return Step(alone.expand(len(seeds), -1, -1), {})
        orders = indices_of(self.order, count).expand(len(seeds), -1)
        if self.order == "random":
            shuffled = [
                torch.randperm(count, generator=draws, device="cpu") for draws in generators_of(seeds)
            ]
            orders = torch.stack(shuffled)
        search = self._begun(problem, orders)
        return Step(search["weights"][:, None], search)

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Compare the phases of the next transducer."""
        problem = state.problem
        search = state.search or self._begun(problem, _best_first(score))
        count = (state.best.history.shape[1] - self._alone(problem)) // self.levels
        step = count + self._skipped(problem)
        done = Step(state.drives[:, :0], search)
        if count > 0:
            done = ascend(search, step - 1, state, pressure, score)
        if step == self.passes * problem.transducers:
            return done
        return done._replace(drives=candidates(done.search, self.levels, step))

    def _doubts(self, state: State) -> Sequence[Iterable[str]]:
        """Describe a lone highest score at the end, and a drift of the gain when it is first seen."""
        return ascent_doubts(state, super()._doubts(state))

    def _skipped(self, problem: Problem) -> int:
        """Return 1 where the first transducer is on alone, whose phase changes nothing."""
        return 1 if problem.start is None else 0

    def _alone(self, problem: Problem) -> int:
        return problem.transducers if self.order == "strength" else 1

    def _begun(self, problem: Problem, orders: torch.Tensor) -> Search:
        """Return the state of an ascent in `orders` (T, M), after `first`.

        One transducer is on, or all that are on in the drives to start from.
        """
        if self.first is not None:
            others = orders[orders != self.first].reshape(len(orders), -1)
            orders = torch.cat([orders.new_full((len(orders), 1), self.first), others], dim=1)
        if (starts := starts_of(problem, len(orders))) is not None:
            return begin_ascent(at_levels(starts, self.levels), orders)
        alone = torch.eye(orders.shape[1], **COMPLEX)
        return begin_ascent(alone[orders[:, 0]], orders)


def _best_first(score: torch.Tensor) -> torch.Tensor:
    """Return the indices (T, B) of scores (T, B) in descending order, near ties in ascending order."""
    order = score.argsort(dim=1, descending=True, stable=True)
    ranked = score.gather(1, order)
    apart = ranked[:, :-1] - ranked[:, 1:] > NEAR_TIE * ranked[:, :-1].abs()
    group = torch.nn.functional.pad(apart.cumsum(dim=1), (1, 0))
    return order.gather(1, (group * score.shape[1] + order).argsort(dim=1))
