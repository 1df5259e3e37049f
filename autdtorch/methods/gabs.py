"""GABS: the greedy algorithm with brute-force search (Algorithm 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch

from autdtorch.methods import coordinates
from autdtorch.methods.base import Method, Problem, State, Step, Trials, generators_of
from autdtorch.methods.driver import run
from autdtorch.methods.ranking import best_first
from autdtorch.methods.solution import Solution
from autdtorch.objectives.objective import Objective, Score, weakest_focus
from autdtorch.utils.validation import integer_at_least, invalid


@dataclass(frozen=True)
class GABS(Method):
    """Switch on one transducer after the other, each with the best of several phases (Algorithm 2).

    Further passes go through all M transducers again in the same order, while the others keep their phases
    (coordinate ascent). A trial ends early with a pass that changes nothing. Where the last transducers only
    do harm, the best drive observed leaves them off.

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

    levels: int = 16
    order: Literal["random", "given", "strength"] | Sequence[int] = "random"
    first: int | None = None
    passes: int = 1

    def __post_init__(self) -> None:
        """Check the settings."""
        object.__setattr__(self, "levels", integer_at_least("levels", self.levels, 2))
        object.__setattr__(
            self, "order", coordinates.order_setting(self.order, ("random", "given", "strength"))
        )
        object.__setattr__(self, "passes", integer_at_least("passes", self.passes, 1))
        if self.first is not None:
            object.__setattr__(self, "first", integer_at_least("first", self.first, 0))

    def check(self, problem: Problem) -> None:
        """Check order and first transducer against the number of transducers."""
        coordinates.require_all(self.order, problem.transducers)
        if self.first is not None and self.first >= problem.transducers:
            accepted = f"must be an integer from 0 to {problem.transducers - 1}"
            raise invalid("first", self.first, accepted)

    def most_evaluations(self, problem: Problem) -> int:
        """Return the evaluations of all passes."""
        transducers = problem.transducers
        alone = transducers if self.order == "strength" else 1
        return alone + (self.passes * transducers - 1) * self.levels

    def most_at_once(self, problem: Problem) -> int:
        """Return the number of levels, or of transducers observed alone."""
        return max(self.levels, problem.transducers if self.order == "strength" else 1)

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe the first transducer alone, or each alone where their strengths decide the order."""
        alone = torch.eye(problem.transducers, dtype=torch.complex128, device="cpu")
        if self.order == "strength":
            return Step(alone.expand(len(seeds), -1, -1), {})
        orders = coordinates.indices_of(self.order, problem.transducers).expand(len(seeds), -1)
        if self.order == "random":
            count = problem.transducers
            shuffled = [torch.randperm(count, generator=own, device="cpu") for own in generators_of(seeds)]
            orders = torch.stack(shuffled)
        orders = self._first_before(orders)
        return Step(alone[orders[:, :1]], {"orders": orders})

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Compare the phases of the next transducer."""
        if "weights" in state.search:
            search, goes_on = coordinates.ascend(state.search, self.levels, score)
            return Step(coordinates.candidates(search, self.levels), search, goes_on)
        orders = state.search["orders"] if state.search else self._first_before(best_first(score))
        alone = torch.eye(state.problem.transducers, dtype=torch.complex128, device="cpu")
        search = coordinates.begin_ascent(alone[orders[:, 0]], orders, self.passes, place=1)
        if state.problem.transducers > 1:
            return Step(coordinates.candidates(search, self.levels), search)
        goes_on = torch.full((len(orders),), self.passes > 1, dtype=torch.bool, device="cpu")
        search = coordinates.begin_ascent(alone[orders[goes_on, 0]], orders[goes_on], self.passes - 1)
        return Step(coordinates.candidates(search, self.levels), search, goes_on)

    def _first_before(self, orders: torch.Tensor) -> torch.Tensor:
        """Return `orders` (T, M) with the transducer `first` moved to the front."""
        if self.first is None:
            return orders
        others = orders[orders != self.first].reshape(len(orders), -1)
        return torch.cat([orders.new_full((len(orders), 1), self.first), others], dim=1)


def gabs(
    objective: Objective,
    levels: int = 16,
    order: Literal["random", "given", "strength"] | Sequence[int] = "random",
    first: int | None = None,
    passes: int = 1,
    trials: Trials = 1,
    seed: int = 0,
    score: Score = weakest_focus,
) -> Solution:
    """Run `GABS` with these settings on an objective; see `GABS` and `run`."""
    return run(GABS(levels, order, first, passes), objective, trials, seed, score=score)
