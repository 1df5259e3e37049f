"""The plan of a simulation: its region, method, grids and cost, before anything is allocated."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field, fields, replace
from typing import Self, cast

import numpy as np
import torch

from autdtorch.fdtd.costs import Costs
from autdtorch.fdtd.grid import require_cells
from autdtorch.fdtd.grid_errors import Law
from autdtorch.fdtd.grouping import Grouping, choose_grids
from autdtorch.fdtd.kernels import available_kernel, precision_of
from autdtorch.fdtd.placement import fitting_spacing
from autdtorch.fdtd.region import Body, Fluid, Region
from autdtorch.fdtd.shapes import Shape
from autdtorch.fdtd.short_runs import THIN_LAYER, THIN_MARGIN
from autdtorch.propagators.store import key_of
from autdtorch.propagators.tmatrix.obstacle_groups import waves_to_simulate
from autdtorch.scene.arrays import apertures_of, radii_of
from autdtorch.scene.obstacles import Mesh, Obstacle
from autdtorch.scene.scene import Scene
from autdtorch.utils.process import cached_property, require_memory
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import (
    finite_number,
    integer_at_least,
    invalid,
    positive,
    require_kind,
    require_one_of,
)

logger = logging.getLogger(__name__)

_TAKEN_AS_RIGID = 0.25
"""Share of the error asked for up to which bodies are taken as rigid, where the spacing is chosen by it."""

_RIGID_ON_CELLS, _MOST_RIGID = 0.5, 2.5
"""Difference up to which bodies are taken as rigid on given cells, as their errors are larger: relative to
the square of a cell in wavelengths, and at most to the tolerance. Cylinders of water err by 7 % at 1 mm,
rigid ones by 0.5 %."""

_SLACK = 1.05
"""Room for the change of a body's difference from a rigid one, where a scene changes a little."""

_OF_WAVES = 0.3
"""Error of the waves left out, relative to a tolerance of which grids take up to 0.7."""

# Ratio of sound speeds from which heavy bodies have no sharp resonances at the drive's frequency
_STIFF = 2.0
# Relative difference of a sphere from a rigid one, times its density ratio. Narrow resonances have up to half
# more, which is still less than the error of a grid at such a contrast.
_NEAR_RIGID = 1.4

_NO_EFFECT = ("observation_plane", "name")
"""Scene fields that do not affect the pressure; left out of keys."""


@dataclass(frozen=True)
class Plan:
    """A simulation of a scene and its cost.

    Attributes:
        spacing: edge of a cell [m]; of no effect in free space.
        time_step: upper limit of the time step [s]; None for the largest stable one.
        runs: number of simulations of the control points' transfer matrix, or of the T-matrices;
            `plan` neglects symmetries.
        grids: the grids, and the obstacles on each; None for the cheapest. See `grouping`.
        is_short: whether runs are of `max_periods`, steady or not; see `short_runs`.
        ringing: expected periods of a run relative to the fewest; None for the usual ones.
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
    runs: int
    grids: Grouping | None = None
    is_short: bool = False
    ringing: float | None = None

    @cached_property
    def grouping(self) -> Grouping:
        """The grids, and the obstacles on each; no grids in free space."""
        if self.grids is not None:
            return self.grids
        _, grouping = choose_grids(self.region, self.method, self.spacing, self.tolerance, self.runs)
        return grouping.with_rim(THIN_MARGIN, THIN_LAYER) if self.is_short else grouping

    def at(self, spacing: float, tolerance: float, time_step: float | None = None) -> Self:
        """Return a plan of the same method with another spacing [m], tolerance and time step [s]."""
        return replace(self, spacing=spacing, tolerance=tolerance, time_step=time_step, grids=None)

    def fitted(self, spacing: float, coarsest: float = math.inf) -> Self:
        """Return the plan at a spacing [m] near one, not above a limit, with which flat faces fall best."""
        regions = [grid.part.unbounded.turned(grid.axes) for grid in self.grouping.grids]
        return self.at(fitting_spacing(regions, spacing, coarsest), self.tolerance, self.time_step)

    def by_waves(self, spacing: float, time_step: float | None = None) -> Self:
        """Return the plan of T-matrices on grids whose spacing [m] was chosen by this plan's tolerance."""
        return self.at(spacing, _OF_WAVES * self.tolerance, time_step)

    def of(self, scene: Scene) -> Self:
        """Return a plan of a changed scene with these settings, which takes the same bodies as rigid."""
        rigid = _SLACK * max((body.rigid_error for body in self.region.bodies), default=0.0)
        return replace(self, scene=scene, region=with_rigid(region_of(scene), rigid), grids=None)

    def around(self, scene: Scene) -> Self:
        """Return the plan of a scene with these obstacles, and another array, on the same grids.

        Reflectors, which such a scene may have at other places, need other grids.
        """
        if self.region.mirrors:
            return self.of(scene)
        region = replace(self.region, domain=scene.domain, sources=scene.array.positions.numpy())
        return replace(self, scene=scene, region=region, grids=self.grouping)

    def short(self, spacing: float, periods: int) -> Self:
        """Return the plan of short runs of so many periods at another spacing [m].

        With reflectors, which send sound back later, runs go on to the steady state.
        """
        short = self if self.region.mirrors else replace(self, max_periods=periods, is_short=True)
        return short.at(spacing, self.tolerance)

    @property
    def with_materials(self) -> Self:
        """The plan without bodies that are taken as rigid; see `with_rigid`."""
        return replace(self, region=with_rigid(region_of(self.scene), 0.0), grids=None)

    @property
    def hides_losses(self) -> bool:
        """True if bodies that absorb are taken as rigid."""
        bodies = zip(self.region.bodies, self.scene.obstacles, strict=True)
        return any(body.rigid_error and obstacle.is_lossy for body, obstacle in bodies)

    @property
    def second(self) -> Self:
        """The plan on a second grid, for an estimate of the grid's error."""
        return self.at(self.region.second_spacing(self.spacing), self.tolerance)

    @property
    def halved(self) -> Self:
        """The plan on cells half as large, which open gaps that these close."""
        return self.at(self.spacing / 2, self.tolerance)

    @cached_property
    def key(self) -> str:
        """A digest of everything that affects the pressure of transducers of unit strength."""
        scene = {entry.name: getattr(self.scene, entry.name) for entry in fields(self.scene)}
        settings = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        settings |= {"scene": None, "region": None, "runs": None, "ringing": None, "dtype": str(self.dtype)}
        settings["grids"] = self.grouping
        rigid = [body.fluid is None for body in self.region.bodies]
        affecting = {name: part for name, part in scene.items() if name not in _NO_EFFECT}
        array = self.scene.array
        affecting["array"] = array.positions, array.normals, radii_of(array)
        return key_of(settings, rigid, affecting)

    @property
    def device(self) -> str:
        """The device of the kernel, "cpu" or "cuda"."""
        return "cuda" if self.kernel == "cuda" else "cpu"

    @property
    def law(self) -> Law:
        """The growth of its errors with the spacing."""
        region, aligned = self.region, self.grouping.aligned
        rigid = any(body.fluid is None for body in region.bodies)
        around = region.wavelength, region.mean_thickness, region.kink, rigid, region.held_contrast
        law = Law(region.shortest_wavelength, aligned, *around)
        if aligned:
            law = replace(law, edges=region.edges_per_area, extent=region.largest_extent)
        return law

    @property
    def on_grids(self) -> Self:
        """The plan of what is simulated as a whole: of method "tmatrix", the box of points near bodies."""
        if self.method != "tmatrix":
            return self
        return replace(self, method="box", runs=min(len(self.scene.control_points), len(self.scene.array)))

    @property
    def cells(self) -> int:
        """Cells of all grids, absorbing layers included."""
        return self.grouping.cells

    @property
    def memory(self) -> float:
        """The most memory in use at a time by runs [bytes]."""
        return self._costs.memory

    @property
    def work(self) -> float:
        """Expected time of all runs, in steps of a cell of air."""
        return self._costs.work

    @cached_property
    def _costs(self) -> Costs:
        array, points, region = self.scene.array, len(self.scene.control_points), self.region
        if self.method == "full":
            region = region.whole
        in_boxes = self.method != "full"
        nodes = 1 if in_boxes else len(apertures_of(array, self.scene.wavenumber).weights)
        return Costs(
            region, self.grouping, self.spacing, self.kernel, self.runs, self.dtype.itemsize, in_boxes,
            receivers=max(points, nodes * len(array)),
            terms=max(points, 2 * len(array)),  # a disc takes twice the time of a point
            meshes=tuple(isinstance(shape, Mesh) for shape in region.shapes),
            ringing=self.ringing,
        )  # fmt: skip

    @property
    def refusal(self) -> str:
        """The reason why this machine cannot run it now, or why no grid can; empty if one can."""
        try:
            require_memory("spacing", self.spacing, self.memory, "m")
            for grid in self.grouping.grids:
                require_cells(grid.shape, self.spacing)
            self.region.require_spacing(self.spacing)
            if self.method == "full":
                self.region.require_domain()
            for grid in self.grouping.grids:
                self.region.require_held(grid.mirrors, self.spacing)
        except ValueError as error:
            return str(error)
        return ""


@dataclass(frozen=True)
class Budget:
    """The time [s] and the memory [bytes] that a choice may take; None is no limit."""

    seconds: float | None = None
    memory: float | None = None
    begin: float = field(default_factory=time.perf_counter)

    @property
    def is_unlimited(self) -> bool:
        """True if neither time nor memory is limited."""
        return self.seconds is None and self.memory is None

    def fits(self, plan: Plan, last: Plan, taken: float) -> bool:
        """Return whether a plan is expected to fit, also this machine, after the `last` took `taken` [s]."""
        spent = time.perf_counter() - self.begin
        in_time = self.seconds is None or spent + taken * plan.work / last.work <= self.seconds
        return in_time and (self.memory is None or plan.memory <= self.memory) and not plan.refusal


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
    kernel, precision = available_kernel(kernel, device), precision_of(dtype)
    tolerance = finite_number("tolerance", tolerance)
    if not 0 < tolerance < 1:
        raise invalid("tolerance", tolerance, "must be in (0, 1), such as 0.01 for 1 %")
    max_periods = integer_at_least("max_periods", max_periods, 1)
    time_step = None if time_step is None else positive("time_step", time_step, "s")
    if isinstance(method, str) and method == "operator":
        warn_user('method "operator" is now "tmatrix"', DeprecationWarning)
        method = "tmatrix"
    require_one_of("method", method, ("auto", "free_space", "box", "full", "tmatrix"))
    if method in ("box", "tmatrix") and not scene.obstacles:
        raise invalid("method", method, "needs a scene with obstacles; take free_space")
    region = region_of(scene)
    cell = region.coarsest_spacing if spacing is None else positive("spacing", spacing, "m")
    region = with_rigid(region, _largest_rigid_error(region.wavelength, spacing, tolerance))
    method, runs, grids = _chosen(scene, region, method, cell, tolerance)
    settings = cell, tolerance, kernel, precision, max_periods, time_step
    return Plan(scene, region, method, *settings, runs, grids)


def _largest_rigid_error(wavelength: float, spacing: float | None, tolerance: float) -> float:
    """Return the difference up to which bodies are taken as rigid."""
    if spacing is None:
        return _TAKEN_AS_RIGID * tolerance
    on_cells = _RIGID_ON_CELLS * (spacing / wavelength) ** 2
    return tolerance * min(max(on_cells / tolerance, 1.0), _MOST_RIGID)


def _chosen(
    scene: Scene, region: Region, method: str, spacing: float, tolerance: float
) -> tuple[str, int, Grouping | None]:
    """Return the method, its number of runs, and its grids where it was chosen by their costs."""
    is_open, runs = method == "auto", min(len(scene.control_points), len(scene.array))
    if is_open and not scene.obstacles:
        logger.debug("method auto: free_space (no obstacles)")
        method = "free_space"
    if method == "free_space":
        return method, runs, Grouping()
    region.require_spacing(spacing)
    if method == "tmatrix" or (is_open and not any(body.continued for body in region.bodies)):
        waves = waves_to_simulate(scene, tolerance, runs if is_open else None)
        if waves is not None:
            logger.debug("method %s: tmatrix; %d waves, where grids take %d runs", method, waves, runs)
            return "tmatrix", waves, None
    if not is_open:
        return method, runs, None
    method, grids = choose_grids(region, method, spacing, tolerance, runs)
    return method, runs, grids


def region_of(scene: Scene) -> Region:
    """Return the region of a scene; parallel walls across it continue through the absorbing layers."""
    bodies = []
    for number, (obstacle, (_, continued)) in enumerate(zip(scene.obstacles, walls_of(scene), strict=True)):
        material = obstacle.fluid_at(scene.frequency)
        fluid = None if material is None else Fluid(*material)
        bodies.append(Body(obstacle, fluid, continued, obstacle.uncertainty, 0.0, obstacle.impedance, number))
    medium, positions = scene.medium, np.asarray(scene.array.positions.numpy())
    air = Fluid(medium.density, medium.sound_speed)
    return Region(
        air, scene.attenuation, scene.frequency, tuple(bodies), scene.domain, positions,
        tuple(reflector.mirror for reflector in scene.reflectors),
    )  # fmt: skip


def with_rigid(region: Region, tolerance: float) -> Region:
    """Return the region with its hard bodies rigid, where that changes the field by less than a tolerance.

    That is relative to the field in free space: errors count it (`rigid_errors`). A body that a later one
    may cut into keeps its material: what is left of it may be thin. No sound enters the cavities of rigid
    bodies, so they are filled.
    """
    bodies = []
    for index, body in enumerate(region.bodies):
        whole = not any(_overlap(body.shape, later.shape) for later in region.bodies[index + 1 :])
        if body.fluid is not None and whole:
            difference = difference_from_rigid(body, region)
            if difference <= tolerance:
                body = replace(body, fluid=None, rigid_error=difference)
        if body.fluid is None and whole:
            body = replace(body, shape=cast(Obstacle, body.shape).filled())
        bodies.append(body)
    return replace(region, bodies=tuple(bodies))


def _overlap(one: Shape, other: Shape) -> bool:
    """Return whether the bounding boxes of two shapes overlap."""
    apart = np.maximum(one.lower, other.lower) >= np.minimum(one.upper, other.upper)
    return not apart.any()


def difference_from_rigid(body: Body, region: Region) -> float:
    """Return the approximate relative difference between the fields of a fluid body and of a rigid one.

    For a density ratio m and an impedance ratio z, complex where the body absorbs, it moves in proportion to
    1 / |m| and yields in proportion to 1 / |z|. Through a wall of thickness d, 1 / (|m| k d) passes (mass
    law); here d is the mean thickness.
    """
    assert body.fluid is not None
    heavier = abs(body.fluid.density) / abs(region.fluid.density)
    stiffer = abs(body.fluid.sound_speed) / abs(region.fluid.sound_speed)
    if heavier <= 1 or stiffer < _STIFF:
        return math.inf
    moved = 1 + 1 / (region.wavenumber * body.mean_thickness)
    return float(_NEAR_RIGID * (moved + 1 / stiffer) / heavier)


def walls_of(scene: Scene) -> list[tuple[bool, bool]]:
    """Return whether each obstacle is a wall, and whether it continues through the absorbing layers.

    A wall or slab is aligned with the axes, and crosses the domain on two axes at least. Those parallel to
    the first one continue. Other shapes were measured to be unstable in the layers, and so were edges where
    walls of two directions meet.
    """
    walls, normal = [], None
    for obstacle in scene.obstacles:
        corners = zip(obstacle.lower, obstacle.upper, *scene.domain, strict=True)
        ends = [axis for axis, (low, high, first, last) in enumerate(corners) if low > first or high < last]
        wall = obstacle.fills_bounds and len(ends) <= 1
        continued = wall and (not ends or normal in (None, ends[0]))
        walls.append((wall, continued))
        if continued and ends:
            normal = ends[0]
    return walls
