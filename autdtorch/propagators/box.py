"""FDTD of the scattered field in a box around the obstacles, exact everywhere else."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import TypeAlias

import torch

from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.scattered_field import NearToFar, ScatteredField
from autdtorch.fdtd.steady_state import SteadyState, run_to_steady_state
from autdtorch.fdtd.stepping import Assembly, assemble_on
from autdtorch.propagators.base import SimulatedPropagator
from autdtorch.propagators.cost import most_runs
from autdtorch.propagators.coupling import coupled_runs
from autdtorch.propagators.groups import MOST_PASSES, cheapest_grouping, one_box
from autdtorch.propagators.scene_region import region_of
from autdtorch.propagators.workload import MOST_JUDGED
from autdtorch.scene.arrays import Nodes
from autdtorch.scene.scene import with_obstacles
from autdtorch.utils.neighbours import nearest
from autdtorch.utils.threads import spread
from autdtorch.utils.validation import LENGTH_TOLERANCE, ArrayLike, invalid, points_tensor

logger = logging.getLogger(__name__)

Drive: TypeAlias = tuple[Nodes, torch.Tensor]
"""N origins and their strengths (N,)."""

Judged: TypeAlias = Callable[[torch.Tensor], torch.Tensor]


class BoxPropagator(SimulatedPropagator):
    """FDTD in a box around the obstacles, or in several; see `SimulatedPropagator`.

    The incident field and the way from the box to the points are exact (Green's function): array and points
    cost no grid, wherever they are.
    """

    method = "box"

    def _assembled(self, dtype: torch.dtype, time_step: float | None) -> Sequence[Assembly]:
        self._wanted = dtype, time_step
        runs = most_runs(self.scene)
        grouping = cheapest_grouping(self.scene, self.spacing, self.tolerance, runs)
        if len(grouping.groups) > 1:
            alone = one_box(self.scene, self.spacing)
            logger.info(
                "%d boxes in about %d passes: %.2g times cheaper than one box of %d cells",
                len(grouping.groups), grouping.passes, alone.cost(runs) / grouping.cost(runs),
                alone.grids[0].cells,
            )  # fmt: skip
        return self._boxed(grouping.groups)

    def _boxed(self, groups: Sequence[Sequence[int]]) -> Sequence[Assembly]:
        """The obstacles of each group in a box."""
        scenes = [self.scene]
        if len(groups) > 1:
            obstacles = self.scene.obstacles
            scenes = [with_obstacles(self.scene, [obstacles[one] for one in group]) for group in groups]
        regions = [region_of(scene) for scene in scenes]
        assemblies = [
            assemble_on(make_box(region, self.spacing), region, *self._wanted) for region in regions
        ]
        self._boxes = [ScatteredField(assembly, self.scene.complex_wavenumber) for assembly in assemblies]
        return assemblies

    def _checked(self, points: ArrayLike) -> torch.Tensor:
        points = points_tensor("points", points).cpu()
        gap, _ = nearest(points, self.scene.array.nodes.positions.reshape(-1, 3))
        if gap.min() < LENGTH_TOLERANCE:
            index = int(gap.argmin())
            accepted = f"lies on a transducer, must be at least {LENGTH_TOLERANCE:g} m away"
            raise invalid(f"points[{index}]", points[index], accepted, "m")
        return points

    def _near_obstacle(self, points: torch.Tensor) -> bool:
        return any(box.assembly.touches_heterogeneous(points[box.inside(points)]) for box in self._boxes)

    @torch.no_grad()
    def _simulate(
        self,
        origins: Sequence[Nodes],
        strength: torch.Tensor,
        targets: Nodes,
        stepped: Callable[[int], None],
    ) -> torch.Tensor:
        points, weights = targets.positions, targets.weights.to(torch.complex128)
        drives = list(zip(origins, strength, strict=True))
        incident = torch.stack(
            [
                self._boxes[0].incident(points.reshape(-1, 3), *nodes, own).reshape(points.shape[:-1])
                @ weights
                for nodes, own in drives
            ],
            dim=1,
        )
        reaches = [box.near_to_far(*targets) for box in self._boxes]
        if len(self._boxes) == 1:
            phasors = self._in_one_box(drives, incident, reaches[0], stepped)
        else:
            coupled = self._in_several_boxes(drives, incident, reaches, stepped)
            if coupled is None:
                logger.info(
                    "%d boxes hear too much of each other: not settled after %d passes; one box instead",
                    len(self._boxes), MOST_PASSES,
                )  # fmt: skip
                self._assemblies = self._boxed([range(len(self.scene.obstacles))])
                return self._simulate(origins, strength, targets, stepped)
            phasors = coupled
        parts = torch.split(phasors, [len(reach.cells) for reach in reaches])
        total = incident + sum(reach.field(part) for reach, part in zip(reaches, parts, strict=True))
        silent = torch.zeros(len(points), dtype=torch.bool, device="cpu")
        for obstacle in self.scene.obstacles:  # the later counts
            silent = torch.where(obstacle.contains(points).any(dim=1), obstacle.rigid, silent)
        return total.mT.masked_fill(silent, 0)

    def _in_one_box(
        self,
        drives: Sequence[Drive],
        incident: torch.Tensor,
        reach: NearToFar,
        stepped: Callable[[int], None],
    ) -> torch.Tensor:
        """Phasors (k, R) of the cells that `reach` reads, incident (P, R) being the field at its targets."""
        (box,) = self._boxes
        every = math.ceil(len(incident) / MOST_JUDGED)
        matrix = reach.matrix(every)

        @torch.no_grad()  # which is each thread's own
        def run(given: tuple[Drive, torch.Tensor]) -> tuple[SteadyState, float]:
            begin, (drive, direct) = time.perf_counter(), given
            judged = _heard(matrix, direct)
            steady = self._run(box, box.driving(*drive[0], drive[1]), reach, self.tolerance, judged, stepped)
            return steady, time.perf_counter() - begin

        given = zip(drives, incident[::every].mT, strict=True)
        runs = spread(run, given, self._kernel.at_once(box.assembly.grid.shape))
        for steady, seconds in runs:
            self._note(steady, seconds)
        return torch.stack([steady.pressure for steady, _ in runs], dim=1)

    def _in_several_boxes(
        self,
        drives: Sequence[Drive],
        incident: torch.Tensor,
        reaches: Sequence[NearToFar],
        stepped: Callable[[int], None],
    ) -> torch.Tensor | None:
        """The same for the cells of all boxes, one after the other; None if they do not settle."""
        every = math.ceil(len(incident) / MOST_JUDGED)
        matrix = torch.cat([reach.matrix(every) for reach in reaches], dim=1)

        def simulate(index: int, field: torch.Tensor, tolerance: float) -> SteadyState:
            reach = reaches[index]  # judged by all that leaves the box
            return self._run(self._boxes[index], field, reach, tolerance, reach.amplitudes, stepped)

        driving = [
            torch.stack([box.driving(*drive[0], drive[1]) for drive in drives], dim=1) for box in self._boxes
        ]
        heard = _heard(matrix, incident[::every])
        coupled = coupled_runs(self._boxes, reaches, driving, heard, simulate, self.tolerance)
        if coupled is None:
            return None
        for run in coupled:
            self._note(run.steady, run.seconds)
        return torch.stack([run.steady.pressure for run in coupled], dim=1)

    def _run(
        self,
        box: ScatteredField,
        field: torch.Tensor,
        reach: NearToFar,
        tolerance: float,
        judged: Judged,
        stepped: Callable[[int], None],
    ) -> SteadyState:
        sources = box.sources(field)
        if not sources.force.any():  # obstacles like air, or drives that cancel
            return SteadyState(
                torch.zeros(len(reach.cells), dtype=torch.complex128, device="cpu"), 0, 0.0, True
            )
        return run_to_steady_state(
            box.assembly, self._kernel, sources, reach.cells, tolerance, self.max_periods, judged, stepped
        )


def _heard(matrix: torch.Tensor, incident: torch.Tensor) -> Judged:
    return lambda phasors: incident + matrix @ phasors
