"""FDTD of the scattered field in a box around the obstacles, exact everywhere else."""

from __future__ import annotations

import math
import time

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
    def _simulate(self, origins: Nodes, strength: torch.Tensor, targets: Nodes) -> torch.Tensor:
        if not strength.any():
            return torch.zeros(len(targets.positions), dtype=torch.complex128)
        begin = time.perf_counter()
        assembly, kernel, scattering = self._assembly, self._kernel, self._scattering
        self._warn_near_obstacle(origins)
        sources = scattering.sources(origins, strength)
        points = targets.positions
        reach = scattering.reach(targets)
        incident = scattering.incident(points.reshape(-1, 3), origins, strength)
        pressure = incident.reshape(points.shape[:-1]) @ targets.weights.to(incident.dtype)
        every = math.ceil(len(points) / MOST_JUDGED)
        steady = run_to_steady_state(
            assembly, kernel, sources, reach.cells, self.tolerance, self.max_periods,
            lambda phasor: pressure[::every] + reach.field(phasor, every),
        )  # fmt: skip
        pressure = pressure + reach.field(steady.pressure)
        silent = torch.zeros(len(points), dtype=torch.bool)
        for obstacle in self.scene.obstacles:  # the later counts
            silent = torch.where(obstacle.contains(points).any(dim=1), obstacle.rigid, silent)
        pressure[silent] = 0
        self._note(steady, time.perf_counter() - begin)
        return pressure
