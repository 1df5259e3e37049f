"""FDTD of the scattered field in boxes around the obstacles; the field elsewhere is exact."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TypeAlias

import torch

from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.scattered_field import NearToFar, ScatteredField
from autdtorch.fdtd.steady_state import SteadyState, run_to_steady_state
from autdtorch.fdtd.stepping import Assembly, assemble_on
from autdtorch.propagators.coupling import coupled_runs
from autdtorch.propagators.plan import MOST_JUDGED
from autdtorch.propagators.simulation import Run, Simulation
from autdtorch.scene.arrays import Nodes
from autdtorch.utils.neighbours import nearest
from autdtorch.utils.threads import one_torch_thread, spread
from autdtorch.utils.validation import LENGTH_TOLERANCE, ArrayLike, invalid, points_tensor

logger = logging.getLogger(__name__)

Drive: TypeAlias = tuple[Nodes, torch.Tensor]
"""N sources and their strengths (N,) [Pa m]."""

Judged: TypeAlias = Callable[[torch.Tensor], torch.Tensor]


class BoxSimulation(Simulation):
    """FDTD of the scattered field in one box or in several that are coupled.

    Green's function gives the incident field, and carries the field from a box to receivers outside it, so
    that their distance costs no grid.
    """

    @cached_property
    @one_torch_thread()
    def boxes(self) -> list[ScatteredField]:
        """The assembled boxes."""
        plan = self.plan
        plan.require_feasible()
        bodies = plan.region.bodies
        parts = [
            replace(plan.region, bodies=tuple(bodies[one] for one in group)) for group in plan.grouping.groups
        ]
        grids = [make_box(part, plan.spacing) for part in parts]
        return [
            ScatteredField(assemble_on(grid, part, plan.dtype, plan.time_step), plan.scene.complex_wavenumber)
            for grid, part in zip(grids, parts, strict=True)
        ]

    @property
    def assemblies(self) -> Sequence[Assembly]:
        """The assembled grids of the boxes."""
        return [box.assembly for box in self.boxes]

    @cached_property
    def _in_one_box(self) -> BoxSimulation:
        return BoxSimulation(self.plan.in_one_box())

    def checked(self, points: ArrayLike) -> torch.Tensor:
        """Return points (P, 3) after checking that none is on a transducer."""
        points = points_tensor("points", points).cpu()
        gap, _ = nearest(points, self.plan.scene.array.nodes.positions.reshape(-1, 3))
        if gap.min() < LENGTH_TOLERANCE:
            index = int(gap.argmin())
            accepted = f"lies on a transducer, must be at least {LENGTH_TOLERANCE:g} m away"
            raise invalid(f"points[{index}]", points[index], accepted, "m")
        return points

    def near_obstacle(self, points: torch.Tensor) -> bool:
        """Return whether the interpolation kernel of any point (N, 3) has heterogeneous cells."""
        return any(box.assembly.touches_heterogeneous(points[box.inside(points)]) for box in self.boxes)

    @torch.no_grad()
    def _simulate(
        self,
        sources: Sequence[Nodes],
        strength: torch.Tensor,
        receivers: Nodes,
        stepped: Callable[[int], None],
    ) -> tuple[torch.Tensor, list[Run]]:
        boxes, points = self.boxes, receivers.positions
        weights = receivers.weights.to(torch.complex128)
        drives = list(zip(sources, strength, strict=True))
        incident = torch.stack(
            [
                boxes[0].incident(points.reshape(-1, 3), *nodes, own).reshape(points.shape[:-1]) @ weights
                for nodes, own in drives
            ],
            dim=1,
        )
        transforms = [box.near_to_far(*receivers) for box in boxes]
        simulate = self._alone if len(boxes) == 1 else self._coupled
        found = simulate(drives, incident, transforms, stepped)
        if found is None:
            logger.debug("the iteration between %d boxes does not converge: one box instead", len(boxes))
            return self._in_one_box._simulate(sources, strength, receivers, stepped)
        steady, seconds = zip(*found, strict=True)
        phasors = torch.stack([each.pressure for each in steady], dim=1)
        parts = torch.split(phasors, [len(transform.cells) for transform in transforms])
        total = incident + sum(
            transform.field(part) for transform, part in zip(transforms, parts, strict=True)
        )
        silent = torch.zeros(len(points), dtype=torch.bool, device="cpu")
        for obstacle in self.plan.scene.obstacles:  # the later obstacle wins
            silent = torch.where(obstacle.contains(points).any(dim=1), obstacle.rigid, silent)
        return total.mT.masked_fill(silent, 0), list(map(Run.of, steady, seconds))

    def _alone(
        self,
        drives: Sequence[Drive],
        incident: torch.Tensor,
        transforms: Sequence[NearToFar],
        stepped: Callable[[int], None],
    ) -> list[tuple[SteadyState, float]]:
        """Simulate R runs in one box; `incident` (P, R) is the field at the receivers."""
        (box,), (transform,) = self.boxes, transforms
        every = math.ceil(len(incident) / MOST_JUDGED)
        matrix = transform.matrix(every)

        @torch.no_grad()  # holds in one thread only
        def run(given: tuple[Drive, torch.Tensor]) -> tuple[SteadyState, float]:
            begin, ((nodes, own), direct) = time.perf_counter(), given
            judged = _pressure(matrix, direct)
            steady = self._run(box, box.driving(*nodes, own), transform, self.plan.tolerance, judged, stepped)
            return steady, time.perf_counter() - begin

        given = zip(drives, incident[::every].mT, strict=True)
        return spread(run, given, self._kernel.at_once(box.assembly.grid.shape))

    def _coupled(
        self,
        drives: Sequence[Drive],
        incident: torch.Tensor,
        transforms: Sequence[NearToFar],
        stepped: Callable[[int], None],
    ) -> list[tuple[SteadyState, float]] | None:
        """Simulate R runs in several boxes, their phasors in the order of boxes; None without convergence."""
        every = math.ceil(len(incident) / MOST_JUDGED)
        matrix = torch.cat([transform.matrix(every) for transform in transforms], dim=1)

        def simulate(index: int, field: torch.Tensor, tolerance: float) -> SteadyState:
            transform = transforms[index]  # judged by the radiated amplitudes
            return self._run(self.boxes[index], field, transform, tolerance, transform.amplitudes, stepped)

        driving = [
            torch.stack([box.driving(*nodes, own) for nodes, own in drives], dim=1) for box in self.boxes
        ]
        pressure = _pressure(matrix, incident[::every])
        return coupled_runs(self.boxes, transforms, driving, pressure, simulate, self.plan.tolerance)

    def _run(
        self,
        box: ScatteredField,
        field: torch.Tensor,
        transform: NearToFar,
        tolerance: float,
        judged: Judged,
        stepped: Callable[[int], None],
    ) -> SteadyState:
        sources = box.sources(field)
        if not sources.force.any():  # obstacles of air, or drives that cancel
            return SteadyState(
                torch.zeros(len(transform.cells), dtype=torch.complex128, device="cpu"), 0, 0.0, True
            )
        return run_to_steady_state(
            box.assembly,
            self._kernel,
            sources,
            transform.cells,
            tolerance,
            self.plan.max_periods,
            judged,
            stepped,
        )


def _pressure(matrix: torch.Tensor, incident: torch.Tensor) -> Judged:
    return lambda phasors: incident + matrix @ phasors
