"""The cost of a transfer matrix, counted from the geometry before anything is allocated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.grid import domain_extent, layer_cells
from autdtorch.fdtd.interpolation import interpolation_width
from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.fdtd.steady_state import phasors_kept
from autdtorch.propagators.cost import USUAL_PERIODS, GridCost, grid_cost, most_runs
from autdtorch.propagators.groups import cheapest_grouping
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.obstacles import Mesh
from autdtorch.scene.scene import Scene

MOST_JUDGED = 64
"""Targets whose pressure decides when a run has settled."""

# Fitted to transfer matrices of boxes and domains at 0.6 to 2 mm; `scripts/check.py estimate` reports errors.

_CELL_BYTES, _FIELD_NUMBERS = 3.0, 2.5
"""Memory of a cell: of the assembly [bytes], and numbers of each run."""

_VARYING_BYTES, _ELEMENT_BYTES, _MOST_ELEMENTS = 2_000.0, 20_500.0, 4096
"""Memory [bytes] of a cell that is not of uniform air, and of an element of the grid while its surface is
measured; so many are at a time."""

_COLUMN_BYTES = 8_000.0
"""Memory [bytes] of an element that a surface goes through in a boundary layer."""

_ELEMENTS = 1.4
"""Elements that are measured for each that a surface goes through: some are only near it."""

_BESIDE_RIGID, _BESIDE_FLUID, _SHARE_INSIDE = 1.5, 2.0, 0.5
"""Cells that are not of uniform air for each area of a cell of a surface, and share of such cells in the
cuboid around an obstacle of another sound speed."""

_VARYING_STEPS, _COLUMN_STEPS = 35.0, 250.0
"""Time of a step of a varying cell, and of one where a surface goes through a boundary layer, in steps of a
cell."""

_PAIR_STEPS, _ASSEMBLY_STEPS = 11.0, 60_000.0
"""Time of one term of a sum over radiating cells, and of the assembly of one varying cell, in steps of a
cell."""

_MESH_STEPS = 200_000.0
"""Time that the assembly of a cell at a mesh takes more, in steps of a cell."""

_RUN_STEPS, _SCENE_STEPS = 4e7, 1e8
"""Time of what a run and a scene take beside all that, in steps of a cell."""


@dataclass(frozen=True)
class Matter:
    """The parts of a grid that are not of uniform air.

    Attributes:
        cut: elements of the grid that surfaces go through.
        varying: cells whose weights are not those of air: beside surfaces, and inside another medium.
        columns: elements that surfaces go through in the boundary layers.
        meshed: those of `varying` that are at meshes.
    """

    cut: float
    varying: float
    columns: float
    meshed: float

    @classmethod
    def in_boxes(cls, scene: Scene, spacing: float) -> Matter:
        """Count it on cells of `spacing` [m] in boxes that hold all obstacles whole."""
        everywhere = np.array([[-np.inf] * 3, [np.inf] * 3])
        return cls._within(scene, spacing, everywhere, everywhere)

    @classmethod
    def in_domain(cls, scene: Scene, spacing: float) -> Matter:
        """Count it on cells of `spacing` [m] in the domain, whose boundary layers continue the obstacles."""
        rim = spacing * layer_cells(scene.wavenumber * spacing)
        domain = np.array(scene.domain)
        return cls._within(scene, spacing, domain, domain + rim * np.array([[-1.0], [1.0]]))

    @classmethod
    def _within(
        cls, scene: Scene, spacing: float, inner: NDArray[np.float64], outer: NDArray[np.float64]
    ) -> Matter:
        cut = varying = columns = meshed = 0.0
        for obstacle in scene.obstacles:
            vertices, triangles = (part.numpy() for part in obstacle.surface())
            doubled = _doubled_areas(np.clip(vertices, *inner)[triangles])
            continued = _doubled_areas(np.clip(vertices, *outer)[triangles])
            area = float(np.linalg.norm(doubled, axis=1).sum()) / 2
            # a plane of normal n goes through |nx| + |ny| + |nz| elements for each area of a cell
            cut += float(np.abs(doubled).sum()) / 2 / spacing**2
            columns += (float(np.linalg.norm(continued, axis=1).sum()) / 2 - area) / spacing**2
            beside = (_BESIDE_RIGID if obstacle.rigid else _BESIDE_FLUID) * area / spacing**2
            varying += beside
            meshed += beside if isinstance(obstacle, Mesh) else 0.0
            if obstacle.sound_speed not in (None, scene.medium.sound_speed):
                box = np.clip([obstacle.lower, obstacle.upper], *inner)
                varying += _SHARE_INSIDE * float(np.prod(box[1] - box[0])) / spacing**3
        return cls(cut, varying, columns, meshed)


@dataclass(frozen=True)
class Workload:
    """The work of a transfer matrix, on grids that are not there yet.

    Attributes:
        grids: all that are assembled.
        passes: of each run through all grids.
        matter: on all of them.
        kept: cells whose phasors a run keeps, at most.
        judged: places by which a run tells whether it is steady.
        pairs: terms of the sums over radiating cells, at all places where they are heard.
    """

    grids: tuple[GridCost, ...]
    passes: int
    matter: Matter
    kept: int
    judged: int
    pairs: int

    @classmethod
    def of(cls, scene: Scene, method: str, spacing: float, tolerance: float) -> Workload:
        """Count it for "box" or "full" on cells of `spacing` [m], boxes being coupled to a `tolerance`."""
        heard = max(len(scene.control_points), scene.array.nodes.positions[..., 0].numel())
        if method == "full":
            grid = grid_cost(scene, domain_extent(region_of(scene), spacing), spacing)
            kept = min(grid.cells, heard * interpolation_width(scene.wavenumber * spacing) ** 3)
            return cls((grid,), 1, Matter.in_domain(scene, spacing), kept, 0, 0)
        grouping = cheapest_grouping(scene, spacing, tolerance, most_runs(scene))
        radiating = [grid.radiating for grid in grouping.grids]
        matter = Matter.in_boxes(scene, spacing)
        judged = min(MOST_JUDGED, max(len(scene.control_points), len(scene.array)))
        return cls(grouping.grids, grouping.passes, matter, max(radiating), judged, sum(radiating) * heard)

    @property
    def cells(self) -> int:
        """Cells of all grids, boundary layers included."""
        return sum(grid.cells for grid in self.grids)

    def memory(self, number_bytes: int, kernel: Kernel, runs: int) -> float:
        """Return the memory [bytes] in use at a time, for runs whose fields take so many bytes a number."""
        block = 3 * max(grid.steps_per_period for grid in self.grids)
        run = _FIELD_NUMBERS * number_bytes * self.cells
        run += self.kept * (16 * phasors_kept(self.kept) + 48 * block)
        judged = 24 * self.judged * self.kept
        lasting = _CELL_BYTES * self.cells + _VARYING_BYTES * self.matter.varying
        lasting += _COLUMN_BYTES * self.matter.columns
        measured = min(_ELEMENTS * self.matter.cut / len(self.grids), _MOST_ELEMENTS)
        return lasting + max(_ELEMENT_BYTES * measured, judged + min(runs, self._at_once(kernel)) * run)

    def steps(self, runs: int, kernel: Kernel) -> float:
        """Return the time of so many runs, in steps of a cell."""
        single = _VARYING_STEPS * self.matter.varying + _COLUMN_STEPS * self.matter.columns
        stepping = sum(grid.work for grid in self.grids) + max(grid.steps for grid in self.grids) * single
        # boxes that hear each other are stepped to looser tolerances, and empty ones do not ring
        ringing = USUAL_PERIODS if self.matter.varying and self.passes == 1 else 1.0
        run = _RUN_STEPS + ringing * self.passes * stepping
        assembly = _SCENE_STEPS + _ASSEMBLY_STEPS * self.matter.varying + _MESH_STEPS * self.matter.meshed
        return assembly + _PAIR_STEPS * self.pairs + math.ceil(runs / self._at_once(kernel)) * run

    def _at_once(self, kernel: Kernel) -> int:
        """Runs side by side; boxes that hear each other take turns."""
        return kernel.at_once(self.grids[0].shape) if len(self.grids) == 1 else 1


def memory_for(
    scene: Scene, method: str, spacing: float, tolerance: float, dtype: torch.dtype, kernel: Kernel
) -> float:
    """Return the memory [bytes] that "box" or "full" takes at most, whatever is symmetric."""
    workload = Workload.of(scene, method, spacing, tolerance)
    return workload.memory(dtype.itemsize, kernel, most_runs(scene))


def _doubled_areas(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normals (T, 3) of triangles (T, 3, 3), twice as long as their areas."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.asarray(np.cross(b - a, c - a))
