"""FDTD of the scattered field in boxes around the obstacles; the field elsewhere is exact.

Several boxes are coupled by a multiple-scattering iteration. In each pass every box is simulated, driven by
the field that the others radiated in the pass before. A pass adds one scattering order. The sums follow
x_(n+1) = T x_n + b like the phasors of a run, and are extrapolated in the same way; weakly coupled boxes need
three or four passes. Later passes contribute little, and are simulated to looser tolerances.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from autdtorch.fdtd.grids import MOST_PASSES, one_box
from autdtorch.fdtd.scattered_field import NearToFar, ScatteredField
from autdtorch.fdtd.steady_state import Extrapolation, SteadyState, run_to_steady_state
from autdtorch.fdtd.stepping import Assembly
from autdtorch.fdtd.turning import is_turned
from autdtorch.propagators.moved_boxes import assembled_box
from autdtorch.propagators.plan import MOST_JUDGED
from autdtorch.propagators.simulation import Run, Simulation, Stepped
from autdtorch.scene.scene import require_clear
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.cached import cached_property
from autdtorch.utils.threads import one_library_thread, spread

logger = logging.getLogger(__name__)

_LOOSEST = 0.1
"""Largest tolerance of a run, relative to its pass."""

_CAUTION = 2.0
"""Safety factor: neglected scattering orders are estimated as this many times the next one."""

Observe = Callable[[torch.Tensor], torch.Tensor]
"""Computes the quantity that must converge from phasors of cells."""

Simulate = Callable[[int, torch.Tensor, float, Observe], SteadyState]
"""Simulates a box, given its index, the incident field (n,), the tolerance and the observed quantity."""


class Solved(NamedTuple):
    """The steady states of R runs in boxes.

    With the transform of each box to P receivers, the incident field (P, R) there, which receivers (P,) are
    silent, and the phasors (k, R) of the cells of each box.
    """

    boxes: Sequence[ScatteredField]
    transforms: Sequence[NearToFar]
    incident: torch.Tensor
    silent: torch.Tensor
    phasors: Sequence[torch.Tensor]
    runs: list[Run]

    @property
    def amplitudes(self) -> list[torch.Tensor]:
        """Amplitudes (n, R) [Pa m] of the Huygens surface of each box."""
        pairs = zip(self.transforms, self.phasors, strict=True)
        return [transform.amplitudes(part) for transform, part in pairs]


class BoxSimulation(Simulation):
    """FDTD of the scattered field in one box or in several that are coupled.

    Green's function gives the incident field, and carries the field from a box to receivers outside it, so
    that their distance costs no grid.
    """

    @cached_property
    @one_library_thread()
    def boxes(self) -> list[ScatteredField]:
        """The assembled boxes."""
        plan = self.plan
        plan.require_feasible()
        boxes = []
        for group, axes in zip(plan.grouping.groups, plan.grouping.axes, strict=True):
            part = replace(plan.region, bodies=tuple(plan.region.bodies[one] for one in group))
            if is_turned(axes):
                logger.debug("the grid around obstacles %s is turned along their faces", list(group))
            assembly = assembled_box(part, axes, plan.spacing, plan.dtype, plan.time_step)
            boxes.append(ScatteredField(assembly, plan.scene.complex_wavenumber, axes))
        return boxes

    @property
    def assemblies(self) -> Sequence[Assembly]:
        """The assembled grids of the boxes."""
        return [box.assembly for box in self.boxes]

    @cached_property
    def _in_one_box(self) -> BoxSimulation:
        plan = self.plan
        return BoxSimulation(replace(plan, grouping=one_box(plan.region, plan.spacing)))

    def near_obstacle(self, points: torch.Tensor) -> bool:
        """Return whether the interpolation kernel of any point (N, 3) has heterogeneous cells."""
        return any(box.near_obstacle(points) for box in self.boxes)

    def _check(self, points: torch.Tensor) -> None:
        require_clear(self.plan.scene.array, "points", points)

    def _simulate(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures, stepped: Stepped
    ) -> tuple[torch.Tensor, list[Run]]:
        solved = self.solved(sources, strength, receivers, stepped)
        return self.total(solved), solved.runs

    def total(self, solved: Solved) -> torch.Tensor:
        """Return the pressure (R, P) [Pa] at the receivers of runs."""
        parts = zip(solved.transforms, solved.phasors, strict=True)
        total = solved.incident + sum(transform.field(part) for transform, part in parts)
        return total.mT.masked_fill(solved.silent, 0)  # kept fields have them too

    def incident(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures
    ) -> torch.Tensor:
        """Return the incident field (P, R) [Pa] at P receivers in R runs; see `run`."""
        points, weights = receivers.positions, receivers.weights.to(torch.complex128)
        drives = zip(sources, strength, strict=True)
        fields = [self.boxes[0].incident(points.reshape(-1, 3), nodes, own) for nodes, own in drives]
        return torch.stack([field.reshape(points.shape[:-1]) @ weights for field in fields], dim=1)

    @torch.no_grad()
    def solved(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures, stepped: Stepped
    ) -> Solved:
        """Simulate R runs, until the pressure at the receivers has converged; see `run`."""
        boxes, plan = self.boxes, self.plan
        drives = list(zip(sources, strength, strict=True))
        incident = self.incident(sources, strength, receivers)
        transforms = [box.near_to_far(receivers) for box in boxes]
        every = math.ceil(len(receivers.positions) / MOST_JUDGED)
        readings = [transform.matrices(every) for transform in transforms]
        sizes = [len(transform.cells) for transform in transforms]
        silent = self.silent(receivers.positions)
        heard = (~silent[::every]).to(incident.dtype)[:, None]
        judged = receivers.positions[::every]
        floors = [self.silence(judged, *drive) for drive in drives]

        def pressure(phasors: torch.Tensor) -> torch.Tensor:
            parts = zip(readings, torch.split(phasors, sizes), strict=True)
            return heard * (incident[::every] + sum(reading.field(part) for reading, part in parts))

        def simulate(
            index: int, field: torch.Tensor, tolerance: float, observe: Observe, floor: float = 0.0
        ) -> SteadyState:
            box, cells = boxes[index], transforms[index].cells
            forces = box.sources(field)
            if not forces.force.any():  # obstacles of air, or drives that cancel
                nothing = torch.zeros(len(cells), **COMPLEX)
                return SteadyState(nothing, 0, 0.0, True)
            settings = tolerance, plan.max_periods, observe, stepped, floor
            return run_to_steady_state(box.assembly, self._kernel, forces, cells, *settings)

        @torch.no_grad()  # holds in one thread only
        def alone(run: int) -> tuple[SteadyState, float]:
            begin, (nodes, own), direct = time.perf_counter(), drives[run], incident[::every, run]
            field = boxes[0].driving(nodes, own)

            def total(phasors: torch.Tensor) -> torch.Tensor:
                return heard[:, 0] * (direct + readings[0].field(phasors[:, None])[:, 0])

            steady = simulate(0, field, plan.tolerance, total, floors[run])
            return steady, time.perf_counter() - begin

        if len(boxes) == 1:
            found = spread(alone, range(len(drives)), self._kernel.at_once(boxes[0].assembly.grid.shape))
        else:
            pairs = [[box.driving(nodes, own) for nodes, own in drives] for box in boxes]
            driving = [torch.stack(fields, dim=1) for fields in pairs]
            found = _coupled(boxes, transforms, driving, pressure, floors, simulate, plan.tolerance)
            if not found:
                logger.debug("the iteration between %d boxes does not converge: one box instead", len(boxes))
                return self._in_one_box.solved(sources, strength, receivers, stepped)
        steady, seconds = zip(*found, strict=True)
        phasors = torch.stack([each.pressure for each in steady], dim=1)
        runs = list(map(Run.of, steady, seconds))
        return Solved(boxes, transforms, incident, silent, torch.split(phasors, sizes), runs)

    def _in_enclosed_cells(self, points: torch.Tensor) -> torch.Tensor:
        found = torch.zeros(points.shape[:-1], dtype=torch.bool, device="cpu")
        for box in self.boxes:
            found |= box.enclosed(points, self.plan.region.walls)
        return found


def _coupled(
    boxes: Sequence[ScatteredField],
    transforms: Sequence[NearToFar],
    driving: Sequence[torch.Tensor],
    pressure: Observe,
    floors: Sequence[float],
    simulate: Simulate,
    tolerance: float,
) -> list[tuple[SteadyState, float]]:
    """Iterate until the pressure (P, R) of R runs has converged; return nothing without convergence.

    The incident field `driving` is (n, R) on each box. Half of the relative tolerance is for the runs, half
    for the iteration. `pressure` maps the phasors (k, R) of all boxes' cells to the receivers; changes are
    relative to its norms, or to `floors` (R,) if those are more. The result is the phasors of these cells and
    the seconds of each run.
    """
    begin = time.perf_counter()
    runs = driving[0].shape[1]
    largest = torch.stack([field.norm(dim=0) for field in driving]).amax(dim=0)
    sums = torch.zeros((), **COMPLEX)
    sequences = [Extrapolation(MOST_PASSES) for _ in range(runs)]
    periods, reached = np.zeros(runs, np.int64), np.ones(runs, bool)
    cells = sum(len(transform.cells) for transform in transforms)
    value, size = pressure(driving[0].new_zeros((cells, runs))), None
    left = torch.zeros(runs, **REAL)
    least = torch.tensor(floors, **REAL).clamp(min=torch.finfo(torch.float64).tiny)
    for number in range(1, MOST_PASSES + 1):
        parts = []
        own = tolerance / 2 ** (number + 1)  # half the tolerance in all passes
        unsettled = torch.zeros((len(boxes), runs), **REAL)
        for index, field in enumerate(driving):
            share = field.norm(dim=0) / largest
            loose = (own / share).clamp(max=_LOOSEST).tolist()
            observe = transforms[index].amplitudes
            steady = [simulate(index, *each, observe) for each in zip(field.mT, loose, strict=True)]
            parts.append(torch.stack([each.pressure for each in steady], dim=1))
            periods += [each.periods for each in steady]
            reached &= [each.converged for each in steady]
            residuals = torch.tensor([each.residual for each in steady], **REAL)
            unsettled[index] = share * residuals
        left += unsettled.amax(dim=0)
        sums = sums + torch.cat(parts)
        for sequence, column in zip(sequences, sums.mT.numpy(), strict=True):
            sequence.append(column)
        phasors = torch.from_numpy(np.stack([sequence.limit() for sequence in sequences], axis=1))
        amplitudes = [transform.amplitudes(part) for transform, part in zip(transforms, parts, strict=True)]
        before, value = value, pressure(phasors)
        smaller, size = size, torch.cat(amplitudes).norm(dim=0)
        change = (value - before).norm(dim=0) / torch.maximum(value.norm(dim=0), least)
        if smaller is not None:
            remaining = _CAUTION * change * (size / smaller).clamp(max=1)
            if (remaining <= tolerance / 2).all():
                seconds = (time.perf_counter() - begin) / runs
                logger.debug("%d boxes, %d passes of multiple scattering", len(boxes), number)
                found = zip(phasors.mT, periods.tolist(), (left + remaining).tolist(), reached, strict=True)
                return [(SteadyState(*each[:3], bool(each[3])), seconds) for each in found]
        radiating = list(zip(boxes, amplitudes, strict=True))
        driving = [
            torch.stack([box.radiated(part, own.driven) for box, part in radiating if box is not own]).sum(
                dim=0
            )
            for own in boxes
        ]
    return []
