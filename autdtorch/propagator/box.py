"""FDTD of the scattered field in a box around the obstacles, exact everywhere else."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import torch

from autdtorch.array import Nodes
from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.scatter import Scattering
from autdtorch.fdtd.steady_state import run_to_steady_state
from autdtorch.fdtd.stepping import Assembly, assemble_on
from autdtorch.propagator.base import MOST_JUDGED, SimulatedPropagator
from autdtorch.validation import LENGTH_TOLERANCE, ArrayLike, distances, invalid, points_tensor


class BoxPropagator(SimulatedPropagator):
    """FDTD in a box around the obstacles; see `SimulatedPropagator`.

    The incident field and the way from the box to the points are exact (Green's function): array and points
    cost no grid, wherever they are.
    """

    method = "box"

    def _assembled(self, dtype: torch.dtype, time_step: float | None) -> Assembly:
        assembly = assemble_on(make_box(self.scene, self.spacing), self.scene, dtype, time_step)
        self._scattering = Scattering(assembly, self.scene.complex_wavenumber)
        return assembly

    def _checked(self, points: ArrayLike) -> torch.Tensor:
        points = points_tensor("points", points).cpu()
        each = [distances(points, nodes) for nodes in self.scene.array.nodes.positions.unbind(1)]
        nearest = torch.stack([apart.amin(dim=1) for apart in each]).amin(dim=0)
        if nearest.min() < LENGTH_TOLERANCE:
            index = int(nearest.argmin())
            accepted = f"lies on a transducer, must be at least {LENGTH_TOLERANCE:g} m away"
            raise invalid(f"points[{index}]", points[index], accepted, "m")
        return points

    def _near_obstacle(self, points: torch.Tensor) -> bool:
        return self._assembly.touches_varying(points[self._scattering.inside(points)])

    @torch.no_grad()
    def _simulate(self, origins: Sequence[Nodes], strength: torch.Tensor, targets: Nodes) -> torch.Tensor:
        scattering, points = self._scattering, targets.positions
        reach = scattering.reach(targets)
        every = math.ceil(len(points) / MOST_JUDGED)
        judged = reach.matrix(every)
        pressure, phasors = [], []
        for nodes, own in zip(origins, strength, strict=True):
            begin = time.perf_counter()
            self._warn_near_obstacle(nodes)
            incident = scattering.incident(points.reshape(-1, 3), nodes, own).reshape(points.shape[:-1])
            pressure.append(incident @ targets.weights.to(incident.dtype))
            steady = run_to_steady_state(
                self._assembly, self._kernel, scattering.sources(nodes, own), reach.cells, self.tolerance,
                self.max_periods, _heard(pressure[-1][::every], judged),
            )  # fmt: skip
            self._note(steady, time.perf_counter() - begin)
            phasors.append(steady.pressure)
        total = torch.stack(pressure) + reach.field(torch.stack(phasors, dim=1)).mT
        silent = torch.zeros(len(points), dtype=torch.bool)
        for obstacle in self.scene.obstacles:  # the later counts
            silent = torch.where(obstacle.contains(points).any(dim=1), obstacle.rigid, silent)
        return total.masked_fill(silent, 0)


def _heard(incident: torch.Tensor, matrix: torch.Tensor) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda phasor: incident + matrix @ phasor
