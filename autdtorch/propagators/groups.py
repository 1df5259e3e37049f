"""Which obstacles share a box: as many boxes as are cheapest, their coupling included."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.grid import Extent, bodies_extent
from autdtorch.propagators.cost import GridCost, box_cost, grid_cost
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.scene import Scene

MOST_PASSES = 12
"""In which boxes are simulated until their coupling stands; more are not worth it."""

_MOST_OBSTACLES = 64
"""That are told apart; of more, one box is taken."""


@dataclass(frozen=True)
class Grouping:
    """Obstacles in boxes.

    Attributes:
        groups: indices of the obstacles in each box, ascending.
        grids: what a run in each box takes.
        passes: expected, in which each box is simulated until the coupling stands.
    """

    groups: tuple[tuple[int, ...], ...]
    grids: tuple[GridCost, ...]
    passes: int

    def cost(self, runs: int) -> float:
        """Of runs, in steps of a cell."""
        return box_cost(self.grids, self.passes, runs)


def one_box(scene: Scene, spacing: float) -> Grouping:
    """All obstacles in one box on cells of `spacing` [m]."""
    everything = tuple(range(len(scene.obstacles)))
    return Grouping((everything,), (grid_cost(scene, bodies_extent(scene.obstacles), spacing),), 1)


def cheapest_grouping(scene: Scene, spacing: float, tolerance: float, runs: int) -> Grouping:
    """The cheapest of the groupings that joining nearest groups, one pair after the other, goes through.

    Boxes keep apart: their interiors, the air around their obstacles included, do not overlap.
    """
    best = one_box(scene, spacing)
    if len(scene.obstacles) > _MOST_OBSTACLES:
        return best
    groups: list[tuple[int, ...]] = [(index,) for index in range(len(scene.obstacles))]
    while len(groups) > 1:
        extents = [bodies_extent(_members(scene, group)) for group in groups]
        gaps = _gaps(extents, spacing)
        if gaps.min() > 0:
            grids = tuple(grid_cost(scene, extent, spacing) for extent in extents)
            found = Grouping(tuple(groups), grids, _expected_passes(extents, tolerance))
            if found.passes <= MOST_PASSES and found.cost(runs) < best.cost(runs):
                best = found
        first, second = sorted(map(int, np.unravel_index(gaps.argmin(), gaps.shape)))
        joined = tuple(sorted(groups[first] + groups.pop(second)))
        groups[first] = joined
    return best


def _members(scene: Scene, group: Sequence[int]) -> list[Obstacle]:
    return [scene.obstacles[index] for index in group]


def _gaps(extents: Sequence[Extent], spacing: float) -> NDArray[np.float64]:
    """Distances (B, B) [m] of boxes' interiors, along the axis where it is largest; infinite to itself."""
    margin = np.array([(extent.margin + 1) * spacing for extent in extents])  # one: for the place of the grid
    lower = np.array([extent.lower for extent in extents]) - margin[:, None]
    upper = np.array([extent.upper for extent in extents]) + margin[:, None]
    above = lower[:, None] - upper[None]
    gaps: NDArray[np.float64] = np.maximum(above, above.transpose(1, 0, 2)).max(axis=-1)
    np.fill_diagonal(gaps, math.inf)
    return gaps


def _expected_passes(extents: Sequence[Extent], tolerance: float) -> int:
    """From what a large body of radius a scatters to a distance d: a / 2d of what it hears."""
    lower, upper = (np.array([getattr(extent, end) for extent in extents]) for end in ("lower", "upper"))
    middle, radius = (lower + upper) / 2, np.linalg.norm(upper - lower, axis=1) / 2
    apart = np.linalg.norm(middle[:, None] - middle, axis=-1)
    np.fill_diagonal(apart, math.inf)
    share = float((radius / (2 * apart)).sum(axis=1).max())
    return max(2, math.ceil(math.log(tolerance) / math.log(share))) if share < 1 else MOST_PASSES + 1
