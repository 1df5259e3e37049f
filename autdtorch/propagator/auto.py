"""What a simulation will take, told from the geometry alone, and the cheapest that is right for a scene."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

from autdtorch.fdtd.grid import MIN_CELLS_PER_WAVELENGTH, Extent, domain_extent, layer_cells, obstacles_extent
from autdtorch.fdtd.medium import is_wall
from autdtorch.fdtd.stability import fewest_steps
from autdtorch.fdtd.steady_state import fewest_periods
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.scene import Scene

logger = logging.getLogger(__name__)

_BESIDE = 2_000_000
"""What a run in a box costs beside its steps, in steps of a cell: the sums over Green's function."""


@dataclass(frozen=True)
class Plan:
    """What the transfer matrix of the control points takes, at least.

    Cavities that ring take more steps, in a box as on the domain.

    Attributes:
        method: by which `make_propagator` calls it.
        cells: of the grid, boundary layers included.
        steps: of a run.
        runs: simulations.
    """

    method: str
    cells: int
    steps: int
    runs: int

    @property
    def cost(self) -> int:
        """Steps of cells, and what is worth as much."""
        return self.runs * (self.cells * self.steps + (_BESIDE if self.method == "box" else 0))

    def __str__(self) -> str:
        """As the log shows it."""
        return f"{self.cells:,} cells x {self.steps:,} steps x {self.runs:,} runs"


def chosen_method(scene: Scene, spacing: float) -> str:
    """The cheapest method that is right for a scene on cells of `spacing` [m]; the reason is logged."""
    if not scene.obstacles:
        logger.info("method auto: free_space (no obstacles: nothing to simulate)")
        return "free_space"
    spacing = min(spacing, scene.wavelength / MIN_CELLS_PER_WAVELENGTH)  # coarser grids are refused later
    runs = min(len(scene.control_points), len(scene.array))
    full = _plan("full", scene, domain_extent(scene, spacing), spacing, runs)
    box = _plan("box", scene, obstacles_extent(scene.obstacles), spacing, runs)
    if any(is_wall(scene, obstacle) for obstacle in scene.obstacles):
        best, reason = full, "a wall goes on without end"
    elif any(_reaches_out(scene, extent) for extent in map(obstacles_extent, zip(scene.obstacles))):
        best, reason = box, "obstacles reach out of the domain, where full would cut them off"
    else:
        best = min(box, full, key=lambda plan: plan.cost)
        other = full if best is box else box
        reason = f"{other.cost / best.cost:.2g} times cheaper than {other.method}"
    naive = _plan("full", scene, domain_extent(scene, spacing), spacing, len(scene.array))
    logger.info("method auto: %s (%s), at least %s", best.method, reason, best)
    skipped = [
        f"{100 - 100 * own / most:.0f} % of {what}"
        for own, most, what in (
            (best.cells, naive.cells, "the cells"), (best.steps, naive.steps, "the steps"),
            (best.runs, naive.runs, "the runs"),
        )
    ]  # fmt: skip
    logger.info(
        "skipped of the naive plan, the domain and a run a transducer (%s): %s", naive, ", ".join(skipped)
    )
    return best.method


def _reaches_out(scene: Scene, extent: Extent) -> bool:
    lower, upper = scene.domain
    pairs = zip(lower, extent.lower, strict=True), zip(extent.upper, upper, strict=True)
    return any(inner > outer for pair in pairs for inner, outer in pair)


def _plan(method: str, scene: Scene, extent: Extent, spacing: float, runs: int) -> Plan:
    kappa = scene.wavenumber * spacing
    interior = extent.interior(spacing)
    rim = layer_cells(kappa) + 1
    stencil = tuned_stencil(kappa, scene.attenuation * spacing)
    periods = fewest_periods(spacing * math.hypot(*interior) / scene.wavelength)
    steps = math.ceil(periods * fewest_steps(stencil, stencil.largest_symbol))
    return Plan(method, math.prod(cells + 2 * rim for cells in interior), steps, runs)
