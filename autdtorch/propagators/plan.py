"""The plan of a simulation: its method, its grids and its cost, before anything is allocated."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import numpy as np
import torch

from autdtorch.analytic.green import PAIR_BYTES
from autdtorch.fdtd.grid import (
    MAX_CELLS,
    coarsest_spacing,
    domain_extent,
    require_spacing,
    second_spacing,
)
from autdtorch.fdtd.grid_errors import Law
from autdtorch.fdtd.grids import USUAL_PERIODS, Grouping, choose_grids
from autdtorch.fdtd.interpolation import interpolation_width
from autdtorch.fdtd.kernels.choice import available_kernel, make_kernel, precision_of
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.steady_state import phasors_kept
from autdtorch.propagators.scene_region import region_of, with_rigid
from autdtorch.propagators.store import key_of
from autdtorch.propagators.tmatrix.bodies import (
    are_outside,
    bodies_of,
    fewest_waves,
    waves_of,
    waves_to_simulate,
)
from autdtorch.scene.arrays import apertures_of
from autdtorch.scene.obstacles import Mesh
from autdtorch.scene.scene import Scene
from autdtorch.utils.cached import cached_property
from autdtorch.utils.memory import require_memory
from autdtorch.utils.spatial import doubled_normals
from autdtorch.utils.threads import thread_count
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import (
    integer_at_least,
    invalid,
    positive,
    require_kind,
    require_one_of,
)

logger = logging.getLogger(__name__)

MOST_JUDGED = 64
"""Receivers of a kind whose pressure decides when a run has converged."""

# Fitted to transfer matrices of boxes and domains at 0.6 to 2 mm: `scripts/check.py estimate` reports errors.

_CELL_BYTES, _FIELD_NUMBERS = 3.0, 2.5
"""Memory of a cell: of the assembly [bytes], and numbers in each run."""

_CELL_MEMORY, _ELEMENT_BYTES, _COLUMN_BYTES = 2_000.0, 14_000.0, 18_000.0
"""Memory [bytes] of a heterogeneous cell, of an element while its surface is assembled, and of an element
that a surface cuts in a boundary layer."""

_ALIKE, _FORCES = 0.25, 3.0
"""Memory and time of assembling elements along the grid, nearly all of which are alike, and time of those
with forces, at tilted surfaces of fluids; relative to tilted surfaces of rigid bodies."""

_ELEMENTS, _MOST_ELEMENTS = 1.4, 4096
"""Elements assembled for each that a surface cuts, as some are only near it; the most at once by a thread."""

_RECORDED = 44
"""Memory [bytes] of a recorded number, and of what is made of it for the Fourier sums."""

_CELL_STEPS, _COLUMN_STEPS = 15.0, 150.0
"""Time of a step of a heterogeneous cell, and of one that a surface cuts in a boundary layer. This and the
following times are in steps of a cell of air."""

_PAIR_STEPS, _ASSEMBLY_STEPS, _MESH_STEPS = 11.0, 60_000.0, 60_000.0
"""Time of one term of a sum over radiating cells, of the assembly of a heterogeneous cell, and of what a mesh
adds to that."""

_RUN_STEPS, _SCENE_STEPS = 4e7, 1e8
"""Further time of a run and of a scene."""

_BESIDE, _SHARE_INSIDE = 2.0, 0.5
"""Heterogeneous cells for each area of a cell of a rigid or fluid surface; their share of the cuboid around
an obstacle of another sound speed."""


_HARDENED = 0.25
"""Share of the error asked for up to which bodies are taken as rigid, where the spacing is chosen by it."""

_MOST_BODIES, _MOST_WAVES = 3, 2000
"""Bodies, and waves around all, up to which "auto" takes T-matrices: more are slower than a box."""


_NO_EFFECT = ("observation_plane", "name")
"""Scene fields that do not affect the pressure; left out of keys."""


class Heterogeneity(NamedTuple):
    """Estimated numbers of cells and elements that are not uniform air, on all grids of a plan."""

    cut: float  # elements that surfaces cut
    cells: float  # heterogeneous cells: beside surfaces, and inside another medium
    columns: float  # elements that surfaces cut in the boundary layers
    meshed: float  # those at meshes
    assembled: float  # those beside surfaces, by the time of assembling them


@dataclass(frozen=True)
class Plan:
    """A simulation of a scene and its cost.

    Attributes:
        spacing: edge of a cell [m]; of no effect in free space.
        time_step: upper limit of the time step [s]; None for the largest stable one.
        grouping: the grids, and the obstacles on each; no grids in free space.
        runs: number of simulations of the control points' transfer matrix, or of the T-matrices;
            `plan` neglects symmetries.
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
    def with_materials(self) -> Self:
        """The plan without bodies that are taken as rigid; see `with_rigid`."""
        return replace(self, region=with_rigid(region_of(self.scene), 0.0)).at(self.spacing, self.tolerance)

    @property
    def second(self) -> Self:
        """The plan on a second grid, for an estimate of the grid's error."""
        return self.at(second_spacing(self.region, self.spacing), self.tolerance)

    @cached_property
    def key(self) -> str:
        """A digest of everything that affects the plan's results."""
        scene = {entry.name: getattr(self.scene, entry.name) for entry in fields(self.scene)}
        settings = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        settings |= {"scene": None, "region": None, "runs": None, "dtype": str(self.dtype)}
        rigid = [body.fluid is None for body in self.region.bodies]
        affecting = {name: part for name, part in scene.items() if name not in _NO_EFFECT}
        return key_of(settings, rigid, affecting)

    @property
    def law(self) -> Law:
        """How its errors grow with the spacing."""
        return Law(self.region.shortest_wavelength, self.grouping.aligned)

    @property
    def by_box(self) -> Self:
        """The plan of the box that serves where T-matrices do not."""
        return replace(self, method="box", runs=min(len(self.scene.control_points), len(self.scene.array)))

    @property
    def cells(self) -> int:
        """Cells of all grids, boundary layers included."""
        return sum(grid.cells for grid in self.grouping.grids)

    @property
    def memory(self) -> float:
        """The most memory in use at a time [bytes]."""
        if self.method == "free_space" or not self.runs:
            return PAIR_BYTES * len(self.scene.array) * len(self.scene.control_points)
        grids, filled, kept = self.grouping.grids, self._heterogeneity, self._kept
        block = 3 * max(grid.steps_per_period for grid in grids)
        run = _FIELD_NUMBERS * self.dtype.itemsize * self.cells
        run += kept * (16 * phasors_kept(kept) + _RECORDED * block)
        receivers = max(len(self.scene.control_points), len(self.scene.array))
        judged = 0 if self.method == "full" else min(MOST_JUDGED, receivers)
        lasting = _CELL_BYTES * self.cells + _CELL_MEMORY * filled.cells + _COLUMN_BYTES * filled.columns
        assembled = min(_ELEMENTS * filled.cut / len(grids), _MOST_ELEMENTS * thread_count())
        assembled *= _ALIKE if self.grouping.aligned else 1
        running = 24 * judged * kept + min(self.runs, self._at_once) * run
        return lasting + max(_ELEMENT_BYTES * assembled, running)

    @property
    def work(self) -> float:
        """Expected time of all runs, in steps of a cell of air."""
        grids, passes, filled = self.grouping.grids, self.grouping.passes, self._heterogeneity
        single = _CELL_STEPS * filled.cells + _COLUMN_STEPS * filled.columns
        stepping = sum(grid.work for grid in grids) + max(grid.steps for grid in grids) * single
        # coupled boxes are stepped to looser tolerances, and empty grids have no resonances
        ringing = USUAL_PERIODS if filled.cells and passes == 1 and self.method != "full" else 1.0
        run = _RUN_STEPS + ringing * passes * stepping
        assembly = _SCENE_STEPS + _ASSEMBLY_STEPS * filled.assembled + _MESH_STEPS * filled.meshed
        pairs = 0 if self.method == "full" else sum(grid.radiating for grid in grids) * self._terms
        return assembly + _PAIR_STEPS * pairs + math.ceil(self.runs / self._at_once) * run

    @cached_property
    def _heterogeneity(self) -> Heterogeneity:
        """Counts from the geometry: on boxes around all obstacles, or on the domain and its layers."""
        region, spacing = self.region, self.spacing
        inner = outer = np.array([[-np.inf] * 3, [np.inf] * 3])
        if self.method == "full":
            inner = np.array(region.domain)
            layer = domain_extent(region, spacing).layer_cells(region.wavenumber * spacing)
            outer = inner + spacing * layer * np.array([[-1.0], [1.0]])
        cut = cells = columns = meshed = assembled = 0.0
        for body in region.bodies:
            vertices, triangles = (part.numpy() for part in body.shape.surface())
            doubled = doubled_normals(np.clip(vertices, *inner)[triangles])
            continued = doubled_normals(np.clip(vertices, *outer)[triangles])
            area = float(np.linalg.norm(doubled, axis=1).sum()) / 2
            # a plane of normal n cuts |nx| + |ny| + |nz| elements for each area of a cell
            cut += float(np.abs(doubled).sum()) / 2 / spacing**2
            columns += (float(np.linalg.norm(continued, axis=1).sum()) / 2 - area) / spacing**2
            beside = _BESIDE * area / spacing**2
            cells += beside
            meshed += beside if isinstance(body.shape, Mesh) else 0.0
            assembled += beside * (_ALIKE if self.grouping.aligned else _FORCES if body.fluid else 1)
            if body.fluid and body.fluid.sound_speed != region.fluid.sound_speed:
                box = np.clip([body.shape.lower, body.shape.upper], *inner)
                cells += _SHARE_INSIDE * float(np.prod(box[1] - box[0])) / spacing**3
        return Heterogeneity(cut, cells, columns, meshed, assembled)

    @property
    def _receivers(self) -> int:
        return max(len(self.scene.control_points), self.scene.array.nodes.positions[..., 0].numel())

    @property
    def _terms(self) -> int:
        """Terms of the sums over radiating cells for each: nodes of the transducers, two for a far disc."""
        transducers = apertures_of(self.scene.array)
        around = np.array(
            [shape.lower for shape in self.region.shapes] + [s.upper for s in self.region.shapes]
        )
        far = transducers.far_from(torch.from_numpy(around), self.region.wavenumber)
        count = np.where(far, 2, len(transducers.weights)).sum()
        return max(len(self.scene.control_points), int(count))

    @property
    def _kept(self) -> int:
        """Most cells of a grid whose phasors a run keeps."""
        if self.method != "full":
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

    def is_feasible(self) -> bool:
        """Return whether the machine can hold it."""
        try:
            self.require_feasible()
        except ValueError:
            return False
        return True

    def require_feasible(self, field: str = "spacing", value: float | None = None) -> None:
        """Refuse too much memory or too many cells, and name the field and the value to blame."""
        value, unit = (self.spacing, "m") if value is None else (value, "")
        require_memory(field, value, self.memory, unit)
        for grid in self.grouping.grids:
            if grid.cells > MAX_CELLS:
                shape = " x ".join(map(str, grid.shape))
                raise invalid(
                    field, value, f"gives {shape} cells, must be at most {MAX_CELLS:.0e} in all", unit
                )
        require_spacing(self.region, self.spacing)


def plan(
    scene: Scene,
    method: str = "auto",
    spacing: float | None = 1e-3,
    tolerance: float = 2e-3,
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
    max_periods: int = 600,
    time_step: float | None = None,
    device: torch.device | str | None = None,
) -> Plan:
    """Plan a simulation, with the arguments of `make_propagator`; no spacing gives the coarsest."""
    require_kind("scene", scene, Scene)
    region, kernel, precision = region_of(scene), available_kernel(kernel, device), precision_of(dtype)
    tolerance = positive("tolerance", tolerance)
    if tolerance >= 1:
        raise invalid("tolerance", tolerance, "must be in (0, 1)")
    most = _HARDENED * tolerance if spacing is None else tolerance
    spacing = coarsest_spacing(region) if spacing is None else positive("spacing", spacing, "m")
    region = with_rigid(region, most)
    max_periods = integer_at_least("max_periods", max_periods, 1)
    time_step = None if time_step is None else positive("time_step", time_step, "s")
    if method == "operator":
        warn_user('method "operator" is now "tmatrix"', DeprecationWarning)
        method = "tmatrix"
    require_one_of("method", method, ("auto", "free_space", "box", "full", "tmatrix"))
    if method in ("box", "tmatrix") and not scene.obstacles:
        raise invalid("method", method, "needs a scene with obstacles; take free_space")
    runs, grouping = min(len(scene.control_points), len(scene.array)), Grouping((), (), (), 0, aligned=False)
    if method == "auto" and not scene.obstacles:
        logger.debug("method auto: free_space (no obstacles)")
        method = "free_space"
    if method != "free_space":
        require_spacing(region, spacing)
        chosen, grouping = choose_grids(region, method, spacing, tolerance, runs)
        method, runs = _by_tmatrix(scene, region, method, chosen, tolerance, runs)
    return Plan(
        scene, region, method, spacing, tolerance, kernel, precision, max_periods, time_step, grouping, runs
    )


def _by_tmatrix(
    scene: Scene, region: Region, method: str, chosen: str, tolerance: float, runs: int
) -> tuple[str, int]:
    """Return "tmatrix" and its runs where it is asked for, or has fewer runs; otherwise what was chosen."""
    if method not in ("auto", "tmatrix"):
        return chosen, runs
    if method == "auto" and fewest_waves(scene, tolerance) > runs:
        return chosen, runs
    bodies = bodies_of(scene.obstacles)
    waves = waves_to_simulate(scene, bodies, tolerance)
    if method == "auto":
        places = torch.cat([scene.control_points, scene.array.nodes.positions.reshape(-1, 3)])
        walls = any(body.continued for body in region.bodies)
        many = len(bodies) > _MOST_BODIES or waves_of(scene, bodies, tolerance) > _MOST_WAVES
        if walls or many or waves > runs or not are_outside(places, bodies).all():
            return chosen, runs
        logger.debug("method auto: tmatrix; %d waves, where %s takes %d runs", waves, chosen, runs)
    return "tmatrix", waves
