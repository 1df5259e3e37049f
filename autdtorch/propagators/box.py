"""FDTD of the scattered field in boxes around the obstacles; the field elsewhere is exact.

Outside the boxes, the amplitudes of their Huygens surfaces radiate the whole scattered field: a linear map
from drives. Those of all transducers, or of some drives, are simulated once for any points. A few points take
fewer runs, which begin at them (reciprocity).
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from scipy.spatial import KDTree

from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.grid_axes import is_tilted
from autdtorch.fdtd.grouping import PlannedGrid, one_box
from autdtorch.fdtd.scattered_field import NearToFar, ScatteredField
from autdtorch.fdtd.steady_state import MOST_JUDGED, Observe
from autdtorch.fdtd.stepping import Assembly, assemble_on
from autdtorch.fdtd.symmetry import Orbits, Symmetry, orbits_of_array, orbits_of_transducers
from autdtorch.propagators.absorbed_power import Absorption, Radiators, absorption
from autdtorch.propagators.box_results import Judged, Radiation, Solved, spread_runs
from autdtorch.propagators.box_scatterer import BoxScatterer, Couplings
from autdtorch.propagators.multiple_scattering import iterated
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.simulation import PressureMap, Run, Simulation, Stepped, mean_of_images
from autdtorch.propagators.store import BODIES, MOST_BYTES, Store, key_of
from autdtorch.scene.checks import require_clear
from autdtorch.scene.geometry import sphere_points
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.obstacles.moving import circumscribed, is_movable, shifted
from autdtorch.scene.reflectors import require_in_front
from autdtorch.scene.scene import Scene
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX, REAL, Index
from autdtorch.utils.digest import digest_of
from autdtorch.utils.mirror_images import Mirror
from autdtorch.utils.process import cached_property, one_library_thread

logger = logging.getLogger(__name__)

_ENTRY_BYTES = torch.complex128.itemsize

Drive = tuple[Apertures, torch.Tensor]
"""Drive: the sources of a run and their strengths (N,) [Pa m], with all images."""


class BoxSimulation(Simulation):
    """FDTD of the scattered field in one box or in several that are coupled.

    Green's function gives the incident field, and carries the field from a box to receivers outside it, so
    that their distance costs no grid.
    """

    def __init__(self, plan: Plan, store: Store, boxes: Sequence[ScatteredField] = ()) -> None:
        """Make the simulation of a plan; see `Simulation`. `boxes` are those of its grids, if known."""
        super().__init__(plan, store)
        self._boxes = boxes

    def around(self, scene: Scene) -> BoxSimulation:
        """Return the simulation of a scene with these obstacles on the same grids; see `Plan.around`."""
        plan = self.plan.around(scene)
        return BoxSimulation(plan, self._store, self.boxes if plan.grouping is self.plan.grouping else ())

    def short(self, spacing: float, periods: int) -> BoxSimulation:
        """Return the simulation by short runs of so many periods at another spacing [m]."""
        return BoxSimulation(self.plan.short(spacing, periods), self._store)

    @cached_property
    @one_library_thread()
    def boxes(self) -> Sequence[ScatteredField]:
        """The assembled boxes."""
        if self._boxes:
            return self._boxes
        plan = self.plan
        boxes, wavenumber = [], plan.scene.complex_wavenumber
        for grid in plan.grouping.grids:
            if is_tilted(grid.axes):
                logger.debug("the grid around obstacles %s is turned along their faces", list(grid.group))
            with self._kernels_compiled(plan.dtype):
                assembly = assembled_box(grid, plan.dtype, plan.time_step)
            images = plan.region.other_images(grid.mirrors, plan.scene.images)
            settings = grid.axes, images, grid.mirrors, plan.device
            boxes.append(ScatteredField(assembly, wavenumber, *settings))
        return boxes

    @property
    def assemblies(self) -> Sequence[Assembly]:
        """The assembled grids of the boxes."""
        return [box.assembly for box in self.boxes]

    @property
    def held_mirrors(self) -> Sequence[Mirror]:
        """The mirrors next to bodies."""
        held = sorted({number for grid in self.plan.grouping.grids for number in grid.mirrors})
        return [self.plan.region.mirrors[number] for number in held]

    @cached_property
    def _couplings(self) -> Couplings:
        return Couplings(self.plan.region.mirrors)

    @cached_property
    def absorptions(self) -> Sequence[Absorption]:
        """The absorption of the obstacles in each box where some absorb."""
        pairs = zip(self.boxes, self.plan.grouping.grids, strict=True)
        parts = (absorption(box.assembly, grid.part, box.mirrors, box.axes) for box, grid in pairs)
        return [part for part in parts if part]

    def radiators(self, drive: torch.Tensor) -> list[Radiators]:
        """Return the Huygens surfaces as monopoles, in runs of drives (R, M)."""
        radiation = self._radiation_of(drive)
        parts = zip(radiation.boxes, radiation.amplitudes, strict=True)
        return [Radiators(box.radiating, amplitude, box.mirrors) for box, amplitude in parts]

    def _check(self, points: torch.Tensor) -> None:
        require_clear(self.plan.scene.array, "points", points)
        require_in_front(self.plan.scene.reflectors, "points", points)

    def _in_enclosed_cells(self, points: torch.Tensor) -> torch.Tensor:
        enclosed = torch.zeros(points.shape[:-1], dtype=torch.bool, device="cpu")
        for box in self.boxes:
            enclosed |= box.enclosed(points)
        return enclosed

    def _read_at(self, points: torch.Tensor) -> torch.Tensor:
        for box in self.boxes:
            points = box.read_at(points)
        return points

    def _orbits_of_transducers(self, points: torch.Tensor) -> Orbits:
        if not self._radiates(points):
            return super()._orbits_of_transducers(points)
        return Orbits(False, *orbits_of_array(self.symmetries), np.zeros((0, 0), np.int64))

    def _matrix(self, points: torch.Tensor) -> PressureMap:
        orbits = self.orbits(points)
        if orbits.from_points or not self._radiates(points):
            return self._matrix_of_orbits(points, orbits)
        key = digest_of(self.plan.key, "transducers")
        radiation = self._store.get(key, self._radiation_of_transducers)
        if not radiation.reaches(self._everywhere(points)):  # the boxes were simulated as one
            return self._matrix_of_orbits(points, orbits_of_transducers(points, self.symmetries))
        alone = self.transducers.singly(range(len(self.plan.scene.array)))
        return self._total(radiation, alone, torch.ones((len(alone), 1), **COMPLEX), points)

    def _fields(self, drive: torch.Tensor, points: torch.Tensor) -> PressureMap:
        if self._radiates(points):
            radiation = self._radiation_of(drive)
            if radiation.reaches(self._everywhere(points)):
                return self._total(radiation, *self.sources_of(drive), points)
        return super()._fields(drive, points)

    def _radiates(self, points: torch.Tensor) -> bool:
        """Return whether the Huygens surfaces radiate the field at points (P, 3), and fit into the store."""
        places = self._everywhere(points)
        return self._keeps_surfaces and not any(box.inside(places).any() for box in self.boxes)

    def _everywhere(self, points: torch.Tensor) -> torch.Tensor:
        """Return points (P, 3) and their images on grids."""
        return self.seen_twice(Apertures(points))[0].centers

    @cached_property
    def _keeps_surfaces(self) -> bool:
        array = self.plan.scene.array
        size = _ENTRY_BYTES * len(array) * sum(len(box.surface.cells) for box in self.boxes)
        return size <= MOST_BYTES

    def _radiation_of_transducers(self) -> Radiation:
        """Simulate the radiation of all transducers, each of unit strength.

        Under a symmetry that maps a transducer to its representative, cells of the surface map to cells.
        """
        representative, symmetry = orbits_of_array(self.symmetries)
        first, place = np.unique(representative, return_inverse=True)
        alone = self.transducers.singly(first)
        radiation = self._radiation(alone, torch.ones((len(alone), 1), **COMPLEX))
        amplitudes = []
        for box, part in zip(radiation.boxes, radiation.amplitudes, strict=True):
            images = np.stack([_images(box, each) for each in self.symmetries])
            amplitudes.append(part[torch.from_numpy(images[symmetry].T), torch.from_numpy(place)])
        return replace(radiation, amplitudes=tuple(amplitudes))

    def _radiation_of(self, drive: torch.Tensor) -> Radiation:
        """Return the radiation of drives (R, M), from the store or simulated."""
        sources, strength = self.sources_of(drive)
        key = digest_of(self.plan.key, "drives", strength)
        return self._store.get(key, lambda: self._radiation(sources, strength))

    def _radiation(self, sources: Sequence[Apertures], strength: torch.Tensor) -> Radiation:
        solved, runs = self._recorded(
            len(sources), lambda stepped: self._solved(sources, strength, self._judged, stepped)
        )
        boxes = [transform.box for transform in solved.transforms]
        return Radiation(boxes, tuple(solved.amplitudes), tuple(runs))

    @cached_property
    def _judged(self) -> Judged:
        """Receivers that judge a radiation: control points, and a sphere a wavelength around the obstacles.

        The former may be in a shadow, the latter receive all that is scattered. At the obstacles' surface,
        pressure converges later.
        """
        scene = self.plan.scene
        places = scene.control_points
        places = places[:: math.ceil(len(places) / MOST_JUDGED)]
        center, radius = circumscribed(scene.obstacles)
        around = sphere_points(center, radius + scene.wavelength, MOST_JUDGED)
        apart = torch.cdist(around, scene.array.nodes.positions.reshape(-1, 3)).amin(dim=1)
        around = around[apart > self.plan.spacing]  # their own 1/r would hide the rest
        for mirror in self.plan.region.mirrors:
            around = around[mirror.height(around) >= 0]
        groups = [part[~self.silent(part[:, None])] for part in (places, around)]
        ends = np.cumsum([0, *map(len, groups)])
        slices = tuple(slice(*pair) for pair in itertools.pairwise(ends) if pair[0] < pair[1])
        return Judged(Apertures(torch.cat(groups)), 1, slices)

    def _total(
        self, radiation: Radiation, sources: Sequence[Apertures], strength: torch.Tensor, points: torch.Tensor
    ) -> PressureMap:
        """Return the pressure of K drives at points (P, 3) that their radiation reaches."""
        receivers, weights = self.seen_twice(Apertures(points))
        drives = self._with_images(sources, strength)
        pressure = self._incident(drives, receivers) + radiation.pressure(receivers)
        pressure = mean_of_images(pressure, weights)
        return PressureMap.of_runs(pressure, radiation.runs, from_points=False)

    def _with_images(self, sources: Sequence[Apertures], strength: torch.Tensor) -> list[Drive]:
        """Return the sources of runs, and their strengths, with those of all images."""
        return [self.imaged(*drive) for drive in zip(sources, strength, strict=True)]

    def _incident(self, drives: Sequence[Drive], receivers: Apertures) -> torch.Tensor:
        """Return the incident field (P, R) [Pa] at P receivers in R runs."""
        return torch.stack([self.boxes[0].incident(receivers.places, *drive) for drive in drives], dim=1)

    def _simulate(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures, stepped: Stepped
    ) -> tuple[torch.Tensor, list[Run]]:
        solved, runs = self._solved(sources, strength, Judged.of(receivers), stepped)
        incident = self._incident(self._with_images(sources, strength), receivers)
        return (incident + solved.pressure).mT, runs

    def _solved(
        self, sources: Sequence[Apertures], strength: torch.Tensor, judged: Judged, stepped: Stepped
    ) -> tuple[Solved, list[Run]]:
        """Simulate R runs until the pressure at the judged receivers has converged; see `_run`."""
        drives = self._with_images(sources, strength)
        transforms = [box.near_to_far(judged.receivers) for box in self.boxes]
        settings = self.plan, self._kernel, self._couplings, stepped
        bodies = [BoxScatterer(*settings, transform) for transform in transforms]
        single = len(bodies) == 1 and not bodies[0].comes_back_later
        observed = None  # of a short run, nothing
        if not (single and self.plan.is_short):
            observed = self._observed(drives, judged, transforms)
        begin, count, tolerance = time.perf_counter(), len(drives), self.plan.tolerance
        driving = [box.driving(drives) for box in self.boxes]
        if single:
            states = bodies[0].answers(driving[0], [tolerance] * count, *(observed or ()))
        else:
            assert observed
            states, settled = iterated(bodies, driving, *observed, tolerance)
            if not settled and len(bodies) > 1:
                logger.debug("the iteration between %d boxes does not converge: one box instead", len(bodies))
                return self._in_one_box._solved(sources, strength, judged, stepped)
        seconds = (time.perf_counter() - begin) / count
        phasors = torch.stack([state.pressure for state in states]).mT
        runs = [Run.of(state, seconds) for state in states]
        sizes = [len(transform.cells) for transform in transforms]
        return Solved(transforms, torch.split(phasors, sizes)), runs

    def _observed(
        self, drives: Sequence[Drive], judged: Judged, transforms: Sequence[NearToFar]
    ) -> tuple[Observe, torch.Tensor]:
        """Return what is observed of R runs, and the norms (Q, R) below which it counts as silence."""
        receivers, every, groups = judged
        some = receivers.chosen(slice(None, None, every))
        sizes = [len(transform.cells) for transform in transforms]
        with self._kernels_compiled(self.assemblies[0].dtype):
            readings = [transform.matrices(every) for transform in transforms]
            incident = self._incident(drives, some)
        audible = (~self.silent(some.positions)).to(incident.dtype)[:, None]
        floors = [[self._silence(some.positions[group], *drive) for group in groups] for drive in drives]
        least = torch.tensor(floors, **REAL).mT.clamp(min=torch.finfo(torch.float64).tiny)

        def observed(phasors: torch.Tensor, runs: Index) -> list[torch.Tensor]:
            parts = zip(readings, torch.split(phasors, sizes), strict=True)
            scattered = [spread_runs(reading.field, part) for reading, part in parts]
            pressure = audible * (incident[:, runs] + torch.stack(scattered).sum(dim=0))
            return [pressure[group] for group in groups]

        return observed, least

    def _kernels_compiled(self, dtype: torch.dtype) -> AbstractContextManager[None]:
        """Compile all kernels of a simulation as soon as one is missing."""
        if self.plan.kernel != "cpu":
            return contextlib.nullcontext()
        from autdtorch.fdtd.kernels.cpu import CpuKernel  # loads numba

        return CpuKernel().compiled_ahead(dtype)

    @cached_property
    def _in_one_box(self) -> BoxSimulation:
        grouping = one_box(self.plan.region, self.plan.spacing)
        return BoxSimulation(replace(self.plan, grids=grouping), self._store)


def _images(box: ScatteredField, symmetry: Symmetry) -> Index:
    """Return for each cell of the Huygens surface the place of its image among them."""
    places = box.radiating.numpy() - symmetry.center
    if (symmetry.matrix == np.eye(3)).all():
        return np.arange(len(places))
    return np.asarray(KDTree(places).query(places @ symmetry.matrix.T)[1], np.int64)


def assembled_box(planned: PlannedGrid, dtype: torch.dtype, time_step: float | None) -> Assembly:
    """Assemble the box of a planned grid; see `stepping.assemble_on`.

    It is assembled with its first cell at the origin: for a body that moves it is the same, to the last bit.
    """
    axes, part = planned.axes, planned.part.turned(planned.axes)
    grid = make_box(part, planned.spacing, planned.extent)
    if not all(isinstance(shape, Obstacle) and is_movable(shape) for shape in planned.part.shapes):
        return assemble_on(grid, part, dtype, time_step)
    offset = torch.from_numpy(-np.array(grid.origin) @ axes)
    bodies = tuple(
        replace(body, shape=shifted(cast(Obstacle, body.shape), offset)) for body in planned.part.bodies
    )
    here = replace(grid, origin=(0.0, 0.0, 0.0))
    still = replace(planned.part.unbounded, bodies=bodies, sources=np.zeros((0, 3)), mirrors=())
    medium = still.fluid, still.attenuation, still.frequency
    key = key_of("box", bodies, axes, here, *medium, str(dtype), time_step)
    assembly = BODIES.get(key, lambda: assemble_on(here, still.turned(axes), dtype, time_step))
    return replace(assembly, grid=grid, region=part)
