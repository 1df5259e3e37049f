"""The matrix T of obstacles that scatter as one body: in closed form, kept from before, or simulated.

Each column of T is the answer to one regular wave, by a run of the box solver. Where mirrors of the grid's
axes map the body onto itself, waves of different parities scatter into waves of different parities: they
share a run, and are separated after it.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
import torch

from autdtorch.analytic.spherical_waves import (
    degrees,
    mirrored,
    outgoing_waves,
    parities,
    real_waves,
    regular_waves,
    sphere_coefficients,
)
from autdtorch.fdtd.grouping import USUAL_PERIODS, one_box
from autdtorch.fdtd.kernels import make_kernel
from autdtorch.fdtd.scattered_field import ScatteredField
from autdtorch.fdtd.steady_state import MOST_JUDGED, fewest_periods
from autdtorch.fdtd.symmetry import symmetries
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.box_scatterer import BoxScatterer, Couplings
from autdtorch.propagators.notices import warn_of_no_steady_state
from autdtorch.propagators.plan import Plan, plan
from autdtorch.propagators.store import BODIES, Store, key_of
from autdtorch.propagators.tmatrix.body_matrix import BodyMatrix
from autdtorch.propagators.tmatrix.obstacle_groups import enough_degrees, has_closed_form
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import sphere_points
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle, Sphere
from autdtorch.scene.obstacles.moving import at_rest, circumscribed, is_movable, shifted
from autdtorch.scene.scene import OverlapWarning, ScaleWarning, Scene
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.process import cached_property, one_library_thread, require_memory
from autdtorch.utils.progress import show_progress

logger = logging.getLogger(__name__)

_ENTRY_BYTES = 48.0  # of T and what makes it
_TOGETHER = 16  # Runs whose forces are computed together
# Distances of the transducer and of points from a body [radii], and the transducer's direction, in no plane
# of symmetry
_TRANSDUCER, _POINTS, _DIRECTION = 4.0, 3.0, (0.36, 0.48, 0.8)
_DIGITS = 10  # Decimals of the places [m] of obstacles in their body, so that poses are the same body


class SimulatedT(NamedTuple):
    """A simulated T (N, N), the axes of its grid (3, 3) and the largest residual of its runs."""

    matrix: torch.Tensor
    axes: torch.Tensor
    residual: float

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return self.matrix.nbytes


class Solver(NamedTuple):
    """The settings of a simulation, as of `make_propagator`; `error` is the tolerance."""

    spacing: float
    error: float
    kernel: str
    dtype: torch.dtype = torch.float32
    max_periods: int = 600
    time_step: float | None = None


@dataclass(frozen=True)
class StillBody:
    """A body at rest around the origin, all that decides its matrix, and the simulation of that.

    Its waves are those around the centre of the circumscribed sphere.
    """

    obstacles: tuple[Obstacle, ...]
    medium: Medium
    frequency: float
    solver: Solver
    fewest_degrees: int = 0

    @cached_property
    def sphere(self) -> tuple[torch.Tensor, float]:
        """Centre (3,) and radius [m] of the circumscribed sphere."""
        return circumscribed(self.obstacles)

    @cached_property
    def scene(self) -> Scene:
        """The body alone, with a transducer and points around it: their pressures contain its resonances."""
        center, radius = self.sphere
        aside = center.new_tensor([_DIRECTION]) * _TRANSDUCER * radius
        array = TransducerArray(center + aside, (-1.0, 0.0, 0.0), radius=0)
        points = sphere_points(center, _POINTS * radius, MOST_JUDGED)
        with warnings.catch_warnings():  # of the scene that it is part of
            warnings.simplefilter("ignore", OverlapWarning)
            warnings.simplefilter("ignore", ScaleWarning)
            return Scene(array, self.medium, self.frequency, points, self.obstacles, name="body")

    @cached_property
    def degree(self) -> int:
        """The largest degree of the waves."""
        return max(
            enough_degrees(self.scene.wavenumber * self.sphere[1], self.solver.error), self.fewest_degrees
        )

    @cached_property
    def axes(self) -> torch.Tensor:
        """The axes of the grid, along which waves are taken: the columns of a matrix (3, 3)."""
        return torch.from_numpy(self.plan.grouping.grids[0].axes).mT.contiguous()

    @cached_property
    def runs(self) -> list[list[int]]:
        """The real waves of each run, at most one of each kind; those of similar degree together."""
        kinds = self._kinds
        of_kind = [torch.nonzero(kinds == kind)[:, 0].tolist() for kind in range(int(kinds.max()) + 1)]
        return [[wave for wave in waves if wave is not None] for waves in zip_longest(*of_kind)]

    @one_library_thread()
    def simulated(self) -> SimulatedT:
        """Simulate T."""
        spacing, size = 1e3 * self.solver.spacing, (self.degree + 1) ** 2
        logger.debug("simulating a T-matrix: %d waves, cells of %.3g mm", size, spacing)
        if not len(self._box.assembly.heterogeneous.index):  # obstacles of the medium's own material
            return SimulatedT(torch.zeros((size, size), **COMPLEX), self.axes, 0.0)
        box, plan, count = self._box, self.plan, len(self.runs)
        mixing = real_waves(self.degree)
        incoming = self._regular(box.driven) @ mixing
        strength = incoming.norm(dim=0).clamp_min(torch.finfo(torch.float64).tiny)
        outgoing = mixing.mH @ self._multipoles()
        judged = sphere_points((0.0, 0.0, 0.0), self.sphere[1], MOST_JUDGED)
        observed = outgoing_waves(self.degree, box.wavenumber, judged) @ mixing @ outgoing

        def forces(runs: Sequence[Sequence[int]]) -> torch.Tensor:
            fields = [(incoming[:, waves] / strength[waves]).sum(dim=1) for waves in runs]
            return box.forces(torch.stack(fields, dim=1))

        parts = [self.runs[first : first + _TOGETHER] for first in range(0, count, _TOGETHER)]
        nowhere = box.near_to_far(Apertures(judged[:0]))
        periods = math.ceil(count * USUAL_PERIODS * fewest_periods(box.assembly.grid.arrival))
        with show_progress(periods, "simulating the waves of a body") as progress:
            body = BoxScatterer(plan, make_kernel(plan.kernel), Couplings(()), progress.advance, nowhere)
            states = body.answers(
                torch.cat([forces(part) for part in parts], dim=1), [plan.tolerance] * count,
                lambda phasors, _: [observed @ phasors.cpu()],
            )  # fmt: skip
        answers = outgoing @ torch.stack([steady.pressure for steady in states], dim=1).cpu()
        matrix, kinds = torch.zeros_like(mixing), self._kinds
        for waves, answer in zip(self.runs, answers.mT, strict=True):
            for wave in waves:
                matrix[:, wave] = torch.where(kinds == kinds[wave], answer * strength[wave], 0)
        residual = max(steady.residual for steady in states)
        return SimulatedT(mixing @ matrix @ mixing.mH, self.axes, residual)

    @cached_property
    def plan(self) -> Plan:
        """The plan of its simulation."""
        chosen = plan(self.scene, "box", *self.solver)
        return replace(chosen, grids=one_box(chosen.region, chosen.spacing))

    @cached_property
    def _box(self) -> ScatteredField:
        return BoxSimulation(self.plan, Store()).boxes[0]

    @cached_property
    def _kinds(self) -> torch.Tensor:
        """The kind (N,) of each real wave; waves of different kinds do not scatter into one another."""
        box, odd = self._box, parities(self.degree).numpy()
        mirrors = symmetries([box.assembly], box.axes, Apertures(self.sphere[0][None]))
        turns = [box.axes @ symmetry.matrix @ box.axes.T for symmetry in mirrors]
        flips = np.stack([np.diag(turn) < 0 for turn in turns if np.allclose(np.abs(turn), np.eye(3))])
        odd = odd @ flips.T.astype(np.int64) % 2  # by wave and symmetry
        return torch.from_numpy(np.unique(odd, axis=0, return_inverse=True)[1].reshape(-1))

    def _regular(self, places: torch.Tensor) -> torch.Tensor:
        """Return regular waves (n, N) at places (n, 3) [m]."""
        return regular_waves(self.degree, self._box.wavenumber, (places - self.sphere[0]) @ self.axes)

    def _multipoles(self) -> torch.Tensor:
        """Return the map (N, n) from phasors of the Huygens surface to outgoing waves."""
        box = self._box
        place, sign = mirrored(self.degree)
        conjugate = sign * self._regular(box.radiating)[:, place]  # j_l Y_lm^*, also for a complex wavenumber
        factor = 4j * math.pi * box.wavenumber * box.surface.factor
        return factor * torch.from_numpy((box.surface.weights.T @ conjugate.numpy()).T)


class Placed(NamedTuple):
    """A body with the turn (3, 3) and the shift (3,) [m] that bring it to its place."""

    body: StillBody
    turn: torch.Tensor
    shift: torch.Tensor

    @property
    def runs(self) -> int:
        """Number of simulations that T takes where it is not there."""
        body = self.body
        return 0 if has_closed_form(body.obstacles) else len(body.runs)

    def matrix(self, store: Store) -> BodyMatrix:
        """Return T and its place, from memory or the store's folder if it is there."""
        body, scene = self.body, self.body.scene
        center, radius = body.sphere
        count = (body.degree + 1) ** 2
        require_memory("obstacles", f"{count} waves", _ENTRY_BYTES * count**2)
        if has_closed_form(body.obstacles):
            matrix, axes = _of_sphere(body.obstacles[0], scene, body.degree), torch.eye(3, **REAL)
        else:
            settings = tuple(str(entry) if isinstance(entry, torch.dtype) else entry for entry in body.solver)
            key = key_of(body.obstacles, body.medium, body.frequency, settings)
            simulated = BODIES.get(key, lambda: _loaded(body, key, store) or body.simulated())
            matrix, axes = simulated.matrix.clone(), simulated.axes
            if simulated.residual > body.solver.error:
                what = f"of the waves of a body after {body.solver.max_periods} periods"
                warn_of_no_steady_state(what, simulated.residual, body.solver.error)
            elif store.folder is not None and store.load(key, tuple(matrix.shape), 1) is None:
                store.save(key, matrix.numpy(), simulated.residual)
        place = self.turn @ center + self.shift
        return BodyMatrix(matrix, scene.complex_wavenumber, radius, place, self.turn @ axes)


def placed(
    obstacles: Sequence[Obstacle], medium: Medium, frequency: float, solver: Solver, fewest_degrees: int = 0
) -> Placed:
    """Return the body that obstacles make, around the origin where they can be moved."""
    still, turn = at_rest(obstacles)
    shift = torch.zeros(3, **REAL)
    if all(map(is_movable, still)):
        shift, _ = circumscribed(still)
        still = tuple(shifted(obstacle, -shift, _DIGITS) for obstacle in still)
    return Placed(StillBody(still, medium, frequency, solver, fewest_degrees), turn, turn @ shift)


def _of_sphere(sphere: Obstacle, scene: Scene, degree: int) -> torch.Tensor:
    assert isinstance(sphere, Sphere)
    wavenumber = scene.complex_wavenumber if scene.attenuation else scene.wavenumber
    slower = wavenumber / scene.wavenumber  # ratios are those to a medium of this wavenumber
    density: complex = math.inf
    speed: complex = 1.0
    if (material := sphere.fluid_at(scene.frequency)) is not None:
        density, speed = material[0] / scene.medium.density, material[1] / scene.medium.sound_speed * slower
    impedance = None if sphere.impedance is None else sphere.impedance * slower
    each = torch.from_numpy(
        sphere_coefficients(degree, wavenumber * sphere.radius, density, speed, impedance)
    )
    return torch.diag(each[degrees(degree)])


def _loaded(body: StillBody, key: str, store: Store) -> SimulatedT | None:
    saved = store.load(key, 2 * ((body.degree + 1) ** 2,), 1)
    if saved is None:
        return None
    logger.info("T-matrix of an earlier run, kept in %s", store.folder)
    return SimulatedT(torch.from_numpy(saved[0]), body.axes, saved[1][0])
