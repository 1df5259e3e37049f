"""FDTD on the whole domain."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from autdtorch.fdtd.steady_state import run_to_steady_state
from autdtorch.fdtd.stepping import Assembly, assemble
from autdtorch.propagators.base import SimulatedPropagator
from autdtorch.propagators.scene_region import region_of
from autdtorch.propagators.workload import MOST_JUDGED
from autdtorch.scene.arrays import Nodes
from autdtorch.scene.scene import require_inside
from autdtorch.utils.validation import ArrayLike, points_tensor


class FullPropagator(SimulatedPropagator):
    """FDTD on the whole domain, in the steady state of the drive; see `SimulatedPropagator`."""

    method = "full"

    def _assembled(self, dtype: torch.dtype, time_step: float | None) -> Sequence[Assembly]:
        return (assemble(region_of(self.scene), self.spacing, dtype, time_step),)

    def _checked(self, points: ArrayLike) -> torch.Tensor:
        points = points_tensor("points", points).cpu()
        require_inside(self.scene.domain, "points", points)
        return points

    def _near_obstacle(self, points: torch.Tensor) -> bool:
        return self._assemblies[0].touches_heterogeneous(points)

    @torch.no_grad()
    def _simulate(
        self,
        origins: Sequence[Nodes],
        strength: torch.Tensor,
        targets: Nodes,
        stepped: Callable[[int], None],
    ) -> torch.Tensor:
        (assembly,) = self._assemblies
        points = assembly.interpolation(targets.positions, targets.weights)
        cells = np.unique(points.index)
        read = points.matrix(cells)
        some = read[:: math.ceil(len(targets.positions) / MOST_JUDGED)]
        rows = []
        for nodes, own in zip(origins, strength, strict=True):
            begin = time.perf_counter()
            steady = run_to_steady_state(
                assembly, self._kernel, assembly.sources(nodes.positions, own, nodes.weights), cells,
                self.tolerance, self.max_periods, lambda phasor: torch.from_numpy(some @ phasor.numpy()),
                stepped,
            )  # fmt: skip
            self._note(steady, time.perf_counter() - begin)
            rows.append(torch.from_numpy(read @ steady.pressure.numpy()))
        return torch.stack(rows)
