"""FDTD on the whole domain."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
import torch

from autdtorch.fdtd.steady_state import MOST_JUDGED, run_to_steady_state
from autdtorch.fdtd.stepping import Assembly, assemble
from autdtorch.propagators.absorbed_power import Radiators, absorption
from autdtorch.propagators.simulation import AbsorbingCells, Run, Simulation, Stepped
from autdtorch.scene.checks import require_inside
from autdtorch.scene.reflectors import require_in_front
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.images import Mirror
from autdtorch.utils.process import cached_property, one_library_thread


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
    def absorptions(self) -> Sequence[AbsorbingCells]:
        """The cells of the domain that absorb."""
        (assembly,), region = self.assemblies, self.plan.region
        form = absorption(assembly, region.whole)
        places = torch.from_numpy(assembly.grid.centers_of(form.cells))
        return [AbsorbingCells.of(form, places, region.whole, region.mirrors)]

    def radiators(self, drive: torch.Tensor) -> list[Radiators]:
        """Return nothing: reflectors of a domain absorb nothing."""
        return []

    def _in_enclosed_cells(self, points: torch.Tensor) -> torch.Tensor:
        enclosed = self.assemblies[0].is_enclosed(points.reshape(-1, 3), self.plan.region.walls)
        return torch.from_numpy(enclosed).reshape(points.shape[:-1])

    def _check(self, points: torch.Tensor) -> None:
        require_inside(self.plan.scene.domain, "points", points)
        require_in_front(self.plan.scene.reflectors, "points", points)

    def _simulate(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures, stepped: Stepped
    ) -> tuple[torch.Tensor, list[Run]]:
        (assembly,), plan = self.assemblies, self.plan
        points = assembly.interpolation(receivers.positions, receivers.weights)
        cells = np.unique(points.index)
        reading = points.matrix(cells)
        every = math.ceil(len(receivers.centers) / MOST_JUDGED)
        judged = reading[::every]
        rows, runs = [], []
        for source, amplitude in zip(sources, strength, strict=True):
            begin = time.perf_counter()
            everything, strengths = self.imaged(source, amplitude)
            forces = assembly.sources(everything.positions, strengths, everything.weights)
            steady = run_to_steady_state(
                assembly, self._kernel, forces, cells, plan.tolerance, plan.max_periods,
                lambda phasor: [torch.from_numpy(judged @ phasor.numpy())], stepped,
                [self._silence(receivers.positions[::every], source, amplitude)],
            )  # fmt: skip
            runs.append(Run.of(steady, time.perf_counter() - begin))
            rows.append(torch.from_numpy(reading @ steady.pressure.numpy()))
        return torch.stack(rows), runs
