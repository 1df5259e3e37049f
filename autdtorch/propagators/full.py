"""FDTD on the whole domain."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import torch

from autdtorch.fdtd.kernels.contract import Sources
from autdtorch.fdtd.steady_state import MOST_JUDGED, run_to_steady_state
from autdtorch.fdtd.stepping import Assembly, assemble
from autdtorch.propagators.absorbed_power import Absorption, Radiators, absorption
from autdtorch.propagators.simulation import Run, Simulation, Stepped
from autdtorch.scene.checks import require_inside
from autdtorch.scene.reflectors import require_in_front
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import REAL, Index
from autdtorch.utils.mirror_images import Mirror
from autdtorch.utils.process import cached_property, one_library_thread
from autdtorch.utils.spatial import distinct_cells


class DomainSimulation(Simulation):
    """FDTD of the total field on a grid of the whole domain."""

    @cached_property
    @one_library_thread()
    def assemblies(self) -> Sequence[Assembly]:
        """The assembled grid of the domain."""
        plan = self.plan
        return (assemble(plan.region.whole, plan.spacing, plan.dtype, plan.time_step),)

    @property
    def held_mirrors(self) -> Sequence[Mirror]:
        """All mirrors: the domain is joined with its images."""
        return self.plan.region.mirrors

    @cached_property
    def absorptions(self) -> Sequence[Absorption]:
        """The absorption of the obstacles in the domain."""
        region = self.plan.region
        part = absorption(self.assemblies[0], region.whole, region.mirrors)
        return [part] if part else []

    def radiators(self, drive: torch.Tensor) -> list[Radiators]:
        """Return nothing: reflectors of a domain absorb nothing."""
        return []

    def _in_enclosed_cells(self, points: torch.Tensor) -> torch.Tensor:
        enclosed = self.assemblies[0].is_enclosed(points.reshape(-1, 3))
        return torch.from_numpy(enclosed).reshape(points.shape[:-1])

    def _read_at(self, points: torch.Tensor) -> torch.Tensor:
        return self.assemblies[0].read_at(points)

    def _check(self, points: torch.Tensor) -> None:
        require_inside(self.plan.scene.domain, "points", points)
        require_in_front(self.plan.scene.reflectors, "points", points)

    def _simulate(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures, stepped: Stepped
    ) -> tuple[torch.Tensor, list[Run]]:
        (assembly,), plan = self.assemblies, self.plan
        points = assembly.interpolation(receivers.positions, receivers.weights)
        cells = distinct_cells(points.index, math.prod(assembly.grid.shape))
        every = math.ceil(len(receivers.centers) / MOST_JUDGED)
        reading, drives = points.matrix(cells), list(zip(sources, strength, strict=True))
        judged = reading[::every]

        def drive(runs: Index) -> Sources:
            imaged = (self.imaged(*drives[run]) for run in runs)
            return _joined([assembly.sources(each.positions, force, each.weights) for each, force in imaged])

        def observe(phasors: torch.Tensor, runs: Index) -> list[torch.Tensor]:
            return [torch.from_numpy(judged @ phasors.cpu().numpy())]

        floors = [self._silence(receivers.positions[::every], *each) for each in drives]
        begin = time.perf_counter()
        states = run_to_steady_state(
            assembly, self._kernel, drive, cells, [plan.tolerance] * len(drives), plan.max_periods, observe,
            stepped, torch.tensor([floors], **REAL),
        )  # fmt: skip
        seconds = (time.perf_counter() - begin) / len(drives)
        phasors = torch.stack([state.pressure for state in states], dim=1).cpu()
        pressure = torch.from_numpy(reading @ phasors.numpy())
        return pressure.mT, [Run.of(state, seconds) for state in states]


def _joined(parts: Sequence[Sources]) -> Sources:
    index = torch.unique(torch.cat([part.index for part in parts]))
    force = parts[0].force.new_zeros((len(parts), len(index), 2))
    for run, part in zip(force, parts, strict=True):
        run[torch.searchsorted(index, part.index)] = part.force[0]
    return Sources(index, force)
