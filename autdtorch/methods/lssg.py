"""LSS, the linear synthesis scheme, and LSSG, which searches its offsets: the paper's baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch

from autdtorch.methods import coordinates
from autdtorch.methods.base import Method, Problem, State, Step, whole
from autdtorch.scene.drive import drive_from_phases, focus_phases, normalise
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.validation import invalid


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
    amplitudes are in [0, 1], not all 1.

    Attributes:
        levels: number of offsets in [0, 2 pi), >= 2.
        order: of the foci: "given" as the control points are, or all their indices.
        passes: >= 1.
    """

    name: ClassVar[str] = "lssg"
    label: ClassVar[str] = "LSSG"
    random: ClassVar[bool] = False

    levels: int = whole(16, least=2)
    order: Literal["given"] | Sequence[int] = coordinates.order("given")
    passes: int = whole(1, least=1)

    def check(self, problem: Problem) -> None:
        """Check the order against the number of foci."""
        coordinates.require_all(self.order, problem.foci)

    def most_evaluations(self, problem: Problem) -> int:
        """Return the evaluations of all passes."""
        return self.passes * problem.foci * self.levels

    def most_at_once(self, problem: Problem) -> int:
        """Return the number of levels."""
        return self.levels

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Compare the offsets of the first focus."""
        foci = _focus_drives(problem)
        start = torch.ones(1, problem.foci, **COMPLEX)
        order = coordinates.indices_of(self.order, problem.foci)[None]
        search = {**coordinates.begin_ascent(start, order), "foci": foci}
        return Step(normalise(coordinates.candidates(search, self.levels, 0) @ foci), search)

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Compare the offsets of the next focus."""
        step = state.best.history.shape[1] // self.levels
        search, goes_on = coordinates.ascend(state.search, step - 1, score)
        if step == self.passes * state.problem.foci:
            return Step(state.drives[:, :0], search)
        weights = coordinates.candidates(search, self.levels, step)
        return Step(normalise(weights @ search["foci"]), search, goes_on)


def _focus_drives(problem: Problem) -> torch.Tensor:
    """Return the drives that aim at each focus in free space (P, M)."""
    scene = problem.scene
    if scene is None:
        raise invalid("problem.scene", None, "must be a scene: the phases of the foci need its geometry")
    return drive_from_phases(focus_phases(scene.array.positions, scene.control_points, scene.wavenumber))
