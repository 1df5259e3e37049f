"""The memory and the time of runs on grids, from the geometry, before anything is allocated."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from autdtorch.fdtd.grid import domain_extent
from autdtorch.fdtd.grouping import USUAL_PERIODS, Grouping
from autdtorch.fdtd.interpolation import interpolation_width
from autdtorch.fdtd.kernels import make_kernel
from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.steady_state import MOST_JUDGED, stored_bytes
from autdtorch.utils.process import cached_property, thread_count
from autdtorch.utils.spatial import doubled_normals

# Fitted to transfer matrices of boxes and domains at 0.6 to 2 mm: `scripts/check.py estimate` reports errors.

_CELL_BYTES, _FIELD_NUMBERS = 3.0, 2.5
"""Memory of a cell: of the assembly [bytes], and numbers in each run."""

_CELL_MEMORY, _ELEMENT_BYTES = 2_000.0, 14_000.0
"""Memory [bytes] of a heterogeneous cell, and of an element while its surface is assembled."""

_ALIKE, _FORCES = 0.25, 3.0
"""Memory and time of assembling elements along the grid, nearly all of which are alike, and time of those
with forces, at tilted surfaces of fluids; relative to tilted surfaces of rigid bodies."""

_ELEMENTS, _MOST_ELEMENTS = 1.4, 4096
"""Elements assembled for each that a surface cuts, as some are only near it; the most at once by a thread."""

_CELL_STEPS, _UNLIKE_STEPS, _COLUMN_STEPS, _LOSSY = 3.0, 9.0, 150.0, 2.0
"""Times of a step, in steps of a cell of air, as in the following: of a heterogeneous cell, the additional
time if its stencil row is unlike those of others, and of a cell that a surface cuts in an absorbing layer.
The last is the factor on the first two for bodies that absorb, whose cells have two rows."""

_PAIR_STEPS, _ASSEMBLY_STEPS, _MESH_STEPS = 11.0, 60_000.0, 60_000.0
"""Time of one term of a sum over radiating cells, of the assembly of a heterogeneous cell, and of what a mesh
adds to that."""

_RUN_STEPS, _SCENE_STEPS = 4e7, 1.4e8
"""Further time of a run and of a scene."""

_BESIDE, _SHARE_INSIDE = 2.0, 0.5
"""Heterogeneous cells for each area of a cell of a rigid or fluid surface; their share of the cuboid around
an obstacle of another sound speed."""


class Heterogeneity(NamedTuple):
    """Estimated numbers of cells and elements that are not uniform air, on all grids of a plan."""

    cut: float  # elements that surfaces cut
    cells: float  # heterogeneous cells: beside surfaces, and inside another medium
    unlike: float  # those beside surfaces oblique to the grid
    columns: float  # elements that surfaces cut in the absorbing layers
    meshed: float  # those at meshes
    assembled: float  # those beside surfaces, by the time of assembling them


@dataclass(frozen=True)
class Costs:
    """The costs of runs on the grids of a region.

    Attributes:
        region: the region.
        grouping: its grids.
        spacing: edge of a cell [m].
        kernel: name of the kernel.
        runs: number of runs.
        itemsize: memory of a number of the fields [bytes].
        in_boxes: whether grids are boxes around bodies, not the whole domain.
        receivers: of a run, at the most.
        terms: of the sum over radiating cells for each of them.
        meshes: whether each body is a mesh, whose distances are slow.
        ringing: periods of a run relative to the fewest; None for the usual ones.
    """

    region: Region
    grouping: Grouping
    spacing: float
    kernel: str
    runs: int
    itemsize: int
    in_boxes: bool
    receivers: int
    terms: int
    meshes: tuple[bool, ...]
    ringing: float | None = None

    @property
    def memory(self) -> float:
        """The most memory in use at a time [bytes]."""
        grouping, filled, cells = self.grouping, self._heterogeneity, self._cells_read
        block = 3 * max(grid.steps_per_period for grid in grouping.grids)
        run = _FIELD_NUMBERS * self.itemsize * grouping.cells
        run += stored_bytes(cells, self.itemsize) + self.itemsize * block * cells  # which are recorded
        judged = min(MOST_JUDGED, self.receivers) if self.in_boxes else 0
        lasting = _CELL_BYTES * grouping.cells + _CELL_MEMORY * filled.cells
        assembled = min(_ELEMENTS * filled.cut / len(grouping.grids), _MOST_ELEMENTS * thread_count())
        assembled *= _ALIKE if grouping.aligned else 1
        running = 12 * judged * cells + min(self.runs, self._at_once * self._together) * run
        lasting += 2 * self.itemsize * sum(grid.echo_numbers for grid in grouping.grids)
        return lasting + max(_ELEMENT_BYTES * assembled, running)

    @property
    def work(self) -> float:
        """Expected time of all runs, in steps of a cell of air."""
        grids, passes, filled = self.grouping.grids, self.grouping.passes, self._heterogeneity
        single = _CELL_STEPS * filled.cells + _UNLIKE_STEPS * filled.unlike + _COLUMN_STEPS * filled.columns
        stepping = sum(grid.work for grid in grids) + max(grid.steps for grid in grids) * single
        # coupled boxes are stepped to looser tolerances, and empty grids have no resonances
        usual = USUAL_PERIODS if filled.cells and passes == 1 and self.in_boxes else 1.0
        run = _RUN_STEPS + (self.ringing or usual) * passes * stepping
        assembly = _SCENE_STEPS + _ASSEMBLY_STEPS * filled.assembled + _MESH_STEPS * filled.meshed
        echoes = sum(grid.echo_work(self.runs) for grid in grids)
        pairs = sum(grid.radiating for grid in grids) * self.terms if self.in_boxes else 0
        at_a_time = max(1, self._at_once // self._kernel.threads(grids[0].shape))  # each as fast as alone
        return assembly + echoes + _PAIR_STEPS * pairs + math.ceil(self.runs / at_a_time) * run

    @cached_property
    def _heterogeneity(self) -> Heterogeneity:
        """Counts from the geometry: on boxes around all bodies, or on the domain and its layers."""
        region, spacing = self.region, self.spacing
        inner = outer = np.array([[-np.inf] * 3, [np.inf] * 3])
        if not self.in_boxes:
            inner = np.array(region.domain)
            layer = domain_extent(region, spacing).layer.cells(region.wavenumber * spacing)
            outer = inner + spacing * layer * np.array([[-1.0], [1.0]])
        cut = cells = unlike = columns = meshed = assembled = 0.0
        for body, is_mesh in zip(region.bodies, self.meshes, strict=True):
            vertices, triangles = (part.numpy() for part in body.shape.surface())
            doubled = doubled_normals(np.clip(vertices, *inner)[triangles])
            area = float(np.linalg.norm(doubled, axis=1).sum()) / 2
            # a plane of normal n cuts |nx| + |ny| + |nz| elements for each area of a cell
            cut += float(np.abs(doubled).sum()) / 2 / spacing**2
            if not self.in_boxes:
                continued = doubled_normals(np.clip(vertices, *outer)[triangles])
                columns += (float(np.linalg.norm(continued, axis=1).sum()) / 2 - area) / spacing**2
            beside = _BESIDE * area / spacing**2
            absorbs = body.impedance is not None or (body.fluid is not None and body.fluid.is_lossy)
            rows = _LOSSY if absorbs else 1.0
            cells += rows * beside
            unlike += 0.0 if self.grouping.aligned else rows * beside
            meshed += beside if is_mesh else 0.0
            assembled += beside * (_ALIKE if self.grouping.aligned else _FORCES if body.fluid else 1)
            if body.fluid and (absorbs or body.fluid.sound_speed != region.fluid.sound_speed):
                box = np.clip([body.shape.lower, body.shape.upper], *inner)
                cells += rows * _SHARE_INSIDE * float(np.prod(box[1] - box[0])) / spacing**3
        return Heterogeneity(cut, cells, unlike, columns, meshed, assembled)

    @property
    def _cells_read(self) -> int:
        """Most cells of a grid whose phasors a run keeps."""
        if self.in_boxes:
            return max(grid.radiating for grid in self.grouping.grids)
        width = interpolation_width(self.region.wavenumber * self.spacing)
        return min(self.grouping.cells, self.receivers * width**3)

    @property
    def _at_once(self) -> int:
        """Threads that step runs; coupled boxes run one after the other."""
        grids = self.grouping.grids
        return self._kernel.at_once(grids[0].shape) if len(grids) == 1 else 1

    @property
    def _together(self) -> int:
        """Runs that a thread steps together; those on a GPU are in a memory of its own."""
        if self.kernel == "cuda":
            return 1
        return self._kernel.together(self.grouping.grids[0].shape, self._cells_read)

    @cached_property
    def _kernel(self) -> Kernel:
        return make_kernel(self.kernel)
