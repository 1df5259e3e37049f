"""FDTD of the scattered field in boxes around the obstacles; the field elsewhere is exact."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import torch

from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.scattered_field import ScatteredField
from autdtorch.fdtd.steady_state import SteadyState, run_to_steady_state
from autdtorch.fdtd.stepping import Assembly, assemble_on
from autdtorch.propagators.coupling import Observe, coupled_runs
from autdtorch.propagators.plan import MOST_JUDGED
from autdtorch.propagators.simulation import Run, Simulation
from autdtorch.scene.arrays import Nodes
from autdtorch.utils.neighbours import nearest
from autdtorch.utils.threads import one_torch_thread, spread
from autdtorch.utils.validation import LENGTH_TOLERANCE, ArrayLike, invalid, points_tensor

logger = logging.getLogger(__name__)


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
        boxes, plan, points = self.boxes, self.plan, receivers.positions
        drives = list(zip(sources, strength, strict=True))
        weights = receivers.weights.to(torch.complex128)
        incident = torch.stack(
            [
                boxes[0].incident(points.reshape(-1, 3), *nodes, own).reshape(points.shape[:-1]) @ weights
                for nodes, own in drives
            ],
            dim=1,
        )
        transforms = [box.near_to_far(*receivers) for box in boxes]
        every = math.ceil(len(points) / MOST_JUDGED)
        matrix = torch.cat([transform.matrix(every) for transform in transforms], dim=1)

        def simulate(index: int, field: torch.Tensor, tolerance: float, observe: Observe) -> SteadyState:
            box, cells = boxes[index], transforms[index].cells
            forces = box.sources(field)
            if not forces.force.any():  # obstacles of air, or drives that cancel
                silent = torch.zeros(len(cells), dtype=torch.complex128, device="cpu")
                return SteadyState(silent, 0, 0.0, True)
            return run_to_steady_state(
                box.assembly, self._kernel, forces, cells, tolerance, plan.max_periods, observe, stepped
            )

        @torch.no_grad()  # holds in one thread only
        def alone(run: int) -> tuple[SteadyState, float]:
            begin, (nodes, own), direct = time.perf_counter(), drives[run], incident[::every, run]
            field = boxes[0].driving(*nodes, own)
            steady = simulate(0, field, plan.tolerance, lambda part: direct + matrix @ part)
            return steady, time.perf_counter() - begin

        found: list[tuple[SteadyState, float]] | None
        if len(boxes) == 1:
            found = spread(alone, range(len(drives)), self._kernel.at_once(boxes[0].assembly.grid.shape))
        else:
            driving = [
                torch.stack([box.driving(*nodes, own) for nodes, own in drives], dim=1) for box in boxes
            ]
            found = coupled_runs(
                boxes, transforms, driving, lambda part: incident[::every] + matrix @ part, simulate,
                plan.tolerance,
            )  # fmt: skip
        if found is None:
            logger.debug("the iteration between %d boxes does not converge: one box instead", len(boxes))
            return self._in_one_box._simulate(sources, strength, receivers, stepped)
        steady, seconds = zip(*found, strict=True)
        phasors = torch.stack([each.pressure for each in steady], dim=1)
        parts = torch.split(phasors, [len(transform.cells) for transform in transforms])
        scattered = [transform.field(part) for transform, part in zip(transforms, parts, strict=True)]
        silent = torch.zeros(len(points), dtype=torch.bool, device="cpu")
        for obstacle in plan.scene.obstacles:  # the later obstacle wins
            silent = torch.where(obstacle.contains(points).any(dim=1), obstacle.rigid, silent)
        total = incident + sum(scattered)
        return total.mT.masked_fill(silent, 0), list(map(Run.of, steady, seconds))
