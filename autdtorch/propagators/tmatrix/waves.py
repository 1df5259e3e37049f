"""The runs of the box solver that make the T-matrix of a body.

Each column of T is the answer to one regular wave. Where mirrors of the grid's axes map the body onto itself,
waves of different parities scatter into waves of different parities: they share a run, and are separated
after it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np
import torch

from autdtorch.analytic.spherical_waves import mirrored, outgoing_waves, parities, real_waves, regular_waves
from autdtorch.fdtd.grouping import Grouping, one_box
from autdtorch.fdtd.kernels import make_kernel
from autdtorch.fdtd.scattered_field import ScatteredField
from autdtorch.fdtd.steady_state import MOST_JUDGED, SteadyState, run_to_steady_state
from autdtorch.fdtd.symmetry import symmetries
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.store import Store
from autdtorch.scene.geometry import sphere_points
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.process import cached_property, one_library_thread, spread
from autdtorch.utils.progress import show_progress


@dataclass(frozen=True)
class BodyWaves:
    """The simulation of a body's answers to regular waves up to a degree.

    Centre (3,) and radius [m] are those of its circumscribed sphere.
    """

    plan: Plan
    center: torch.Tensor
    radius: float
    degree: int

    @cached_property
    def axes(self) -> torch.Tensor:
        """The axes of the grid, along which waves are taken: the columns of a matrix (3, 3)."""
        return torch.from_numpy(self._grouping.grids[0].axes).mT.contiguous()

    @cached_property
    def runs(self) -> list[list[int]]:
        """The real waves of each run, at most one of each kind; those of similar degree together."""
        kinds = self._kinds
        of_kind = [torch.nonzero(kinds == kind)[:, 0].tolist() for kind in range(int(kinds.max()) + 1)]
        return [[wave for wave in waves if wave is not None] for waves in zip_longest(*of_kind)]

    @one_library_thread()
    def matrix(self) -> tuple[torch.Tensor, float]:
        """Simulate T (N, N); return also the largest residual of the runs, relative."""
        if not len(self._box.assembly.heterogeneous.index):  # obstacles of the medium's own material
            count = (self.degree + 1) ** 2
            return torch.zeros((count, count), **COMPLEX), 0.0
        box, plan, kernel = self._box, self.plan, make_kernel(self.plan.kernel)
        mixing = real_waves(self.degree)
        incoming = self._regular(box.driven) @ mixing
        size = incoming.norm(dim=0).clamp_min(torch.finfo(torch.float64).tiny)
        outgoing = mixing.mH @ self._multipoles()
        judged = sphere_points((0.0, 0.0, 0.0), self.radius, MOST_JUDGED)
        observed = outgoing_waves(self.degree, box.wavenumber, judged) @ mixing @ outgoing
        with show_progress(len(self.runs), "simulating the waves of a body") as progress:

            @torch.no_grad()
            def run(waves: list[int]) -> SteadyState:
                forces = box.sources(box.forces((incoming[:, waves] / size[waves]).sum(dim=1)))
                settings = (
                    plan.tolerance,
                    plan.max_periods,
                    lambda phasors: [observed @ phasors],
                    lambda _: None,
                )
                steady = run_to_steady_state(box.assembly, kernel, forces, box.surface[1], *settings)
                progress.advance(1)
                return steady

            states = spread(run, self.runs, kernel.at_once(box.assembly.grid.shape))
        answers = outgoing @ torch.stack([steady.pressure for steady in states], dim=1)
        matrix, kinds = torch.zeros_like(mixing), self._kinds
        for waves, answer in zip(self.runs, answers.mT, strict=True):
            for wave in waves:
                matrix[:, wave] = torch.where(kinds == kinds[wave], answer * size[wave], 0)
        return mixing @ matrix @ mixing.mH, max(steady.residual for steady in states)

    @cached_property
    def _grouping(self) -> Grouping:
        return one_box(self.plan.region, self.plan.spacing)

    @cached_property
    def _box(self) -> ScatteredField:
        return BoxSimulation(replace(self.plan, grouping=self._grouping), Store()).boxes[0]

    @cached_property
    def _kinds(self) -> torch.Tensor:
        """The kind (N,) of each real wave; waves of different kinds do not scatter into one another."""
        box, odd = self._box, parities(self.degree).numpy()
        mirrors = symmetries([box.assembly], box.axes, Apertures.of_points(self.center[None]))
        turns = [box.axes @ symmetry.matrix @ box.axes.T for symmetry in mirrors]
        flips = np.stack([np.diag(turn) < 0 for turn in turns if np.allclose(np.abs(turn), np.eye(3))])
        odd = odd @ flips.T.astype(np.int64) % 2  # by wave and symmetry
        return torch.from_numpy(np.unique(odd, axis=0, return_inverse=True)[1].reshape(-1))

    def _regular(self, places: torch.Tensor) -> torch.Tensor:
        """Return regular waves (n, N) at places (n, 3) [m]."""
        return regular_waves(self.degree, self._box.wavenumber, (places - self.center) @ self.axes)

    def _multipoles(self) -> torch.Tensor:
        """Return the map (N, n) from phasors of the Huygens surface to outgoing waves."""
        positions, _, outward = self._box.surface
        place, sign = mirrored(self.degree)
        conjugate = sign * self._regular(positions)[:, place]  # j_l Y_lm^*, also for a complex wavenumber
        return 4j * math.pi * self._box.wavenumber * torch.from_numpy((outward.T @ conjugate.numpy()).T)
