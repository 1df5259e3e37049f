"""The plan of a simulation: its method, its grids and its cost, before anything is allocated."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import torch

from autdtorch.analytic.green import PAIR_BYTES
from autdtorch.fdtd.grid import MAX_CELLS, require_spacing
from autdtorch.fdtd.interpolation import interpolation_width
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.spacing import pilot_spacing, second_spacing
from autdtorch.fdtd.steady_state import phasors_kept
from autdtorch.propagators.backend import available_kernel, make_kernel, precision_of
from autdtorch.propagators.grids import USUAL_PERIODS, Grouping, choose_grids, one_box
from autdtorch.propagators.heterogeneity import Heterogeneity, heterogeneity
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.scene import Scene
from autdtorch.utils.memory import require_memory
from autdtorch.utils.validation import integer_at_least, invalid, positive, require_kind, require_one_of

logger = logging.getLogger(__name__)

METHODS = ("auto", "free_space", "box", "full")

MOST_JUDGED = 64
"""Receivers whose pressure decides when a run has converged."""

# Fitted to transfer matrices of boxes and domains at 0.6 to 2 mm: `scripts/check.py estimate` reports errors.

_CELL_BYTES, _FIELD_NUMBERS = 3.0, 2.5
"""Memory of a cell: of the assembly [bytes], and numbers in each run."""

_CELL_MEMORY, _ELEMENT_BYTES, _COLUMN_BYTES = 2_000.0, 20_500.0, 8_000.0
"""Memory [bytes] of a heterogeneous cell, of an element while its surface is assembled, and of an element
that a surface cuts in a boundary layer."""

_ELEMENTS, _MOST_ELEMENTS = 1.4, 4096
"""Elements that are assembled for each that a surface cuts, as some are only near it; the most at once."""

_CELL_STEPS, _COLUMN_STEPS = 35.0, 250.0
"""Time of a step of a heterogeneous cell, and of one that a surface cuts in a boundary layer. This and the
following times are in steps of a cell of air."""

_PAIR_STEPS, _ASSEMBLY_STEPS, _MESH_STEPS = 11.0, 60_000.0, 200_000.0
"""Time of one term of a sum over radiating cells, of the assembly of a heterogeneous cell, and of what a mesh
adds to that."""

_RUN_STEPS, _SCENE_STEPS = 4e7, 1e8
"""Further time of a run and of a scene."""


@dataclass(frozen=True)
class Plan:
    """A simulation of a scene and its cost.

    Attributes:
        scene: the scene.
        region: what the solver simulates of it.
        method: "free_space", "box" or "full".
        spacing: edge of a cell [m]; of no effect in free space.
        tolerance: relative distance to the steady state at which a run ends.
        kernel: "cpu", "cuda" or "reference".
        dtype: precision of the fields.
        max_periods: periods of the drive after which a run ends in any case.
        time_step: upper limit of the time step [s]; None for the largest stable one.
        grouping: the grids, and the obstacles on each; no grids in free space.
        runs: number of simulations of the control points' transfer matrix; `plan` neglects symmetries.
    """

    scene: Scene
    region: Region
    method: str
    spacing: float
    tolerance: float
    kernel: str
    dtype: torch.dtype
    max_periods: int
    time_step: float | None
    grouping: Grouping
    runs: int

    def at(self, spacing: float, tolerance: float, time_step: float | None = None) -> Self:
        """Return a plan of the same method with another spacing [m], tolerance and time step [s]."""
        _, grouping = choose_grids(self.region, self.method, spacing, tolerance, self.runs)
        return replace(self, spacing=spacing, tolerance=tolerance, time_step=time_step, grouping=grouping)

    @property
    def second(self) -> Self:
        """The plan on a second grid, for an estimate of the grid's error."""
        return self.at(second_spacing(self.region, self.spacing), self.tolerance)

    def in_one_box(self) -> Self:
        """Return a plan with all obstacles in one box."""
        return replace(self, grouping=one_box(self.region, self.spacing))

    @property
    def cells(self) -> int:
        """Cells of all grids, boundary layers included."""
        return sum(grid.cells for grid in self.grouping.grids)

    @property
    def memory(self) -> float:
        """The most memory in use at a time [bytes]."""
        if self.method == "free_space":
            return PAIR_BYTES * len(self.scene.array) * len(self.scene.control_points)
        grids, filled, kept = self.grouping.grids, self._heterogeneity, self._kept
        block = 3 * max(grid.steps_per_period for grid in grids)
        run = _FIELD_NUMBERS * self.dtype.itemsize * self.cells
        run += kept * (16 * phasors_kept(kept) + 48 * block)
        judged = 0
        if self.method == "box":
            judged = min(MOST_JUDGED, max(len(self.scene.control_points), len(self.scene.array)))
        lasting = _CELL_BYTES * self.cells + _CELL_MEMORY * filled.cells + _COLUMN_BYTES * filled.columns
        assembled = min(_ELEMENTS * filled.cut / len(grids), _MOST_ELEMENTS)
        running = 24 * judged * kept + min(self.runs, self._at_once) * run
        return lasting + max(_ELEMENT_BYTES * assembled, running)

    @property
    def work(self) -> float:
        """Expected time of all runs, in steps of a cell of air."""
        grids, passes, filled = self.grouping.grids, self.grouping.passes, self._heterogeneity
        single = _CELL_STEPS * filled.cells + _COLUMN_STEPS * filled.columns
        stepping = sum(grid.work for grid in grids) + max(grid.steps for grid in grids) * single
        # coupled boxes are stepped to looser tolerances, and empty grids have no resonances
        ringing = USUAL_PERIODS if filled.cells and passes == 1 else 1.0
        run = _RUN_STEPS + ringing * passes * stepping
        assembly = _SCENE_STEPS + _ASSEMBLY_STEPS * filled.cells + _MESH_STEPS * filled.meshed
        pairs = 0
        if self.method == "box":
            pairs = sum(grid.radiating for grid in grids) * self._receivers
        return assembly + _PAIR_STEPS * pairs + math.ceil(self.runs / self._at_once) * run

    @cached_property
    def _heterogeneity(self) -> Heterogeneity:
        return heterogeneity(self.region, self.spacing, self.method == "full")

    @property
    def _receivers(self) -> int:
        return max(len(self.scene.control_points), self.scene.array.nodes.positions[..., 0].numel())

    @property
    def _kept(self) -> int:
        """Most cells of a grid whose phasors a run keeps."""
        if self.method == "box":
            return max(grid.radiating for grid in self.grouping.grids)
        return min(self.cells, self._receivers * self._width**3)

    @property
    def _width(self) -> int:
        """Cells per axis of the interpolation kernel of a point."""
        return interpolation_width(self.region.wavenumber * self.spacing)

    @property
    def source_clearance(self) -> float:
        """Distance [m] from obstacles within which a source is less accurate."""
        return self.spacing * self._width / 2

    @property
    def _at_once(self) -> int:
        """Runs side by side; coupled boxes run one after the other."""
        grids = self.grouping.grids
        return make_kernel(self.kernel).at_once(grids[0].shape) if len(grids) == 1 else 1

    def require_feasible(self, field: str = "spacing", value: float | None = None) -> None:
        """Refuse too much memory, too many cells, or cells too large or small for the region.

        Raises:
            ValueError: names the field and the value to blame, by default the spacing.
        """
        value, unit = (self.spacing, "m") if value is None else (value, "")
        require_memory(field, value, self.memory, unit)
        for grid in self.grouping.grids:
            if grid.cells > MAX_CELLS:
                shape = " x ".join(map(str, grid.shape))
                accepted = f"gives {shape} cells, must be at most {MAX_CELLS:.0e} in all"
                raise invalid(field, value, accepted, unit)
        require_spacing(self.region, self.spacing)


def plan(
    scene: Scene,
    method: str = "auto",
    spacing: float | None = 1e-3,
    tolerance: float = 2e-3,
    *,
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
    max_periods: int = 600,
    time_step: float | None = None,
) -> Plan:
    """Plan the simulation of a scene; the arguments are those of `make_propagator`.

    Without a `spacing`, plan the coarse grid from which a spacing is chosen.

    Raises:
        ValueError: an argument is out of range, or the kernel needs a package that is not installed.
    """
    require_kind("scene", scene, Scene)
    region, kernel, precision = region_of(scene), available_kernel(kernel), precision_of(dtype)
    spacing = pilot_spacing(region) if spacing is None else positive("spacing", spacing, "m")
    tolerance = positive("tolerance", tolerance)
    if tolerance >= 1:
        raise invalid("tolerance", tolerance, "must be in (0, 1)")
    max_periods = integer_at_least("max_periods", max_periods, 1)
    if time_step is not None:
        time_step = positive("time_step", time_step, "s")
    require_one_of("method", method, METHODS)
    if method == "box" and not scene.obstacles:
        raise invalid("method", method, "needs a scene with obstacles; take free_space")
    runs, grouping = min(len(scene.control_points), len(scene.array)), Grouping((), (), 0)
    if method == "auto" and not scene.obstacles:
        logger.debug("method auto: free_space (no obstacles)")
        method = "free_space"
    if method != "free_space":
        require_spacing(region, spacing)
        method, grouping = choose_grids(region, method, spacing, tolerance, runs)
    return Plan(
        scene, region, method, spacing, tolerance, kernel, precision, max_periods, time_step, grouping, runs
    )
