"""Random search: the baseline that any search must beat."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from autdtorch.methods.base import Method, State, Step, whole
from autdtorch.methods.problem import Problem
from autdtorch.methods.seeds import generators_of, restored, states_of, uniform

_AT_ONCE = 64  # evaluations of a trial in one step, which bounds the memory of a step


@dataclass(frozen=True)
class RandomSearch(Method):
    """Try random phases at full amplitude, and keep the best.

    Attributes:
        evaluations: number of evaluations of a trial, >= 1.
        levels: number of phases in [0, 2 pi) to draw from, >= 2; None for any phase.
    """

    name: ClassVar[str] = "random_search"
    label: ClassVar[str] = "random search"

    evaluations: int = whole(256, least=1)
    levels: int | None = whole(None, least=2)

    def most_at_once(self, problem: Problem) -> int:
        """Return the size of a step."""
        return min(self.evaluations, _AT_ONCE)

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Draw the first phases."""
        return self._drawn(generators_of(seeds), problem.transducers, 0)

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Draw more phases."""
        done = state.best.history.shape[1]
        if done == self.evaluations:
            return Step(state.drives[:, :0], {})
        return self._drawn(restored(state.search["generators"]), state.problem.transducers, done)

    def _drawn(self, generators: Sequence[torch.Generator], transducers: int, done: int) -> Step:
        size = min(_AT_ONCE, self.evaluations - done), transducers
        turns = torch.stack([uniform(draws, *size) for draws in generators])
        if self.levels is not None:
            turns = (self.levels * turns).floor() / self.levels
        drives = torch.polar(torch.ones_like(turns), -2 * math.pi * turns)
        return Step(drives, {"generators": states_of(generators)})
