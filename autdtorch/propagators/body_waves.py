"""The runs of the box solver that make the scattering operator of a body.

Each column of T is the answer to one regular wave. Where mirrors of the grid's axes map the body onto itself,
waves of different parities scatter into waves of different parities: they share a run, and are told apart
after it.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from autdtorch.analytic.spherical_waves import mirrored, outgoing_waves, parities, real_waves, regular_waves
from autdtorch.fdtd.scattered_field import ScatteredField
from autdtorch.fdtd.steady_state import SteadyState, run_to_steady_state
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.grids import one_box
from autdtorch.propagators.plan import MOST_JUDGED, Plan, make_kernel
from autdtorch.propagators.simulated import SteadyStateWarning
from autdtorch.propagators.symmetry import symmetries
from autdtorch.scene.geometry import sphere_points
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.progress import show_progress
from autdtorch.utils.threads import one_library_thread, spread


@one_library_thread()
def simulated_operator(
    plan: Plan, center: torch.Tensor, radius: float, degree: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Simulate T (N, N) of a plan's obstacles around a centre (3,) [m], along the axes of the grid.

    Returns:
        T, and the axes, the columns of a matrix (3, 3).
    """
    box = BoxSimulation(replace(plan, grouping=one_box(plan.region, plan.spacing))).boxes[0]
    axes, kernel = torch.from_numpy(box.axes).mT.contiguous(), make_kernel(plan.kernel)
    kind, mixing = _kinds(box, center, degree), real_waves(degree)
    runs = _sharing(kind)
    incoming = regular_waves(degree, box.wavenumber, (box.driven - center) @ axes) @ mixing
    size = incoming.norm(dim=0).clamp_min(torch.finfo(torch.float64).tiny)
    outgoing = mixing.mH @ _multipoles(box, (box.surface[0] - center) @ axes, degree)
    judged = torch.as_tensor(sphere_points((0.0, 0.0, 0.0), radius, MOST_JUDGED))
    observed = outgoing_waves(degree, box.wavenumber, judged) @ mixing @ outgoing
    with show_progress(len(runs), "simulating the waves of a body") as progress:

        @torch.no_grad()
        def run(waves: list[int]) -> SteadyState:
            forces = box.sources((incoming[:, waves] / size[waves]).sum(dim=1))
            settings = plan.tolerance, plan.max_periods, lambda phasors: observed @ phasors, lambda _: None
            steady = run_to_steady_state(box.assembly, kernel, forces, box.surface[1], *settings)
            progress.advance(1)
            return steady

        found = spread(run, runs, kernel.at_once(box.assembly.grid.shape))
    _warn_of_unsettled(found, plan)
    answers = outgoing @ torch.stack([steady.pressure for steady in found], dim=1)
    matrix = torch.zeros(len(mixing), len(mixing), dtype=torch.complex128, device="cpu")
    for waves, answer in zip(runs, answers.mT, strict=True):
        for wave in waves:
            matrix[:, wave] = torch.where(kind == kind[wave], answer * size[wave], 0)
    return mixing @ matrix @ mixing.mH, axes


def _kinds(box: ScatteredField, center: torch.Tensor, degree: int) -> torch.Tensor:
    """Return the kind (N,) of each real wave: waves of different kinds do not scatter into one another."""
    found = symmetries([box.assembly], box.axes, Apertures.of_points(center[None]))
    turns = [box.axes @ symmetry.matrix @ box.axes.T for symmetry in found]
    flips = np.stack([np.diag(turn) < 0 for turn in turns if np.allclose(np.abs(turn), np.eye(3))])
    odd = parities(degree).numpy() @ flips.T.astype(np.int64) % 2  # by wave and symmetry
    return torch.from_numpy(np.unique(odd, axis=0, return_inverse=True)[1].reshape(-1))


def _sharing(kind: torch.Tensor) -> list[list[int]]:
    """Return the waves of each run, at most one of each kind; those of similar degree together."""
    of_kind = [torch.nonzero(kind == own)[:, 0].tolist() for own in range(int(kind.max()) + 1)]
    return [[wave for wave in waves if wave is not None] for waves in itertools.zip_longest(*of_kind)]


def _multipoles(box: ScatteredField, offsets: torch.Tensor, degree: int) -> torch.Tensor:
    """Return the map (N, n) from phasors of the Huygens surface, at offsets (m, 3), to outgoing waves."""
    waves = regular_waves(degree, box.wavenumber, offsets)
    place, sign = mirrored(degree)
    conjugate = sign * waves[:, place]  # j_l Y_lm^*, with the same j_l for a complex wavenumber
    return 4j * math.pi * box.wavenumber * torch.from_numpy((box.surface[2].T @ conjugate.numpy()).T)


def _warn_of_unsettled(found: Sequence[SteadyState], plan: Plan) -> None:
    if unsettled := [steady for steady in found if not steady.converged]:
        error = max(steady.residual for steady in unsettled)
        warnings.warn(
            f"no steady state after {plan.max_periods} periods in {len(unsettled)} of {len(found)} runs of a "
            f"body: estimated relative error up to {error:.1e}, asked for {plan.tolerance:g}",
            SteadyStateWarning,
            stacklevel=5,  # the caller of `ScatteringOperator.of`, through the decorator
        )
