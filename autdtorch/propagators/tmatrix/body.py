"""The matrix T of obstacles that scatter as one body: in closed form, kept from before, or simulated."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from autdtorch.analytic.spherical_waves import degrees, sphere_coefficients
from autdtorch.propagators.notices import SteadyStateWarning
from autdtorch.propagators.plan import plan
from autdtorch.propagators.store import BODIES, Store, key_of
from autdtorch.propagators.tmatrix.bodies import enough_degrees, has_closed_form
from autdtorch.propagators.tmatrix.waves import BodyWaves
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle, Sphere
from autdtorch.scene.obstacles.moving import at_rest, circumscribed, is_movable, shifted
from autdtorch.scene.scene import OverlapWarning, ScaleWarning, Scene
from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import cached_property, require_memory
from autdtorch.utils.units import warn_user

logger = logging.getLogger(__name__)

_ENTRY_BYTES = 48.0  # of T and what makes it
_DIGITS = 10  # Decimals of the places [m] of obstacles in their body, so that poses are the same body


class BodyMatrix(NamedTuple):
    """The attributes of a `TMatrix`."""

    matrix: torch.Tensor
    wavenumber: complex
    radius: float
    center: torch.Tensor
    axes: torch.Tensor


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
    """A body at rest around the origin, and all that decides its matrix."""

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
        """The body alone, with a transducer and a point that play no part."""
        center, radius = self.sphere
        aside = center.new_tensor([[3 * radius, 0.0, 0.0]])
        array = TransducerArray(center + aside, (-1.0, 0.0, 0.0), radius=0)
        with warnings.catch_warnings():  # of the scene that it is part of
            warnings.simplefilter("ignore", OverlapWarning)
            warnings.simplefilter("ignore", ScaleWarning)
            return Scene(array, self.medium, self.frequency, center - aside, self.obstacles, name="body")

    @property
    def degree(self) -> int:
        """The largest degree of the waves."""
        return max(
            enough_degrees(self.scene.wavenumber * self.sphere[1], self.solver.error), self.fewest_degrees
        )

    @property
    def waves(self) -> BodyWaves:
        """The simulation of its waves."""
        planned = plan(self.scene, "box", *self.solver)
        return BodyWaves(planned, *self.sphere, self.degree)


class Placed(NamedTuple):
    """A body with the turn (3, 3) and the shift (3,) [m] that bring it to its place."""

    body: StillBody
    turn: torch.Tensor
    shift: torch.Tensor

    @property
    def runs(self) -> int:
        """Number of simulations that T takes where it is not there."""
        body = self.body
        return 0 if has_closed_form(body.obstacles) else len(body.waves.runs)

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
            simulated = BODIES.get(key, lambda: _loaded(body, key, store) or _simulated(body))
            matrix, axes = simulated.matrix.clone(), simulated.axes
            if simulated.residual > body.solver.error:
                _warn_of_unsettled(body.solver, simulated.residual)
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
        still = tuple(shifted(one, -shift, _DIGITS) for one in still)
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
    """Return T that an earlier process saved, if it is there."""
    saved = store.load(key, 2 * ((body.degree + 1) ** 2,), 1)
    if saved is None:
        return None
    logger.info("T-matrix of an earlier run, kept in %s", store.folder)
    return SimulatedT(torch.from_numpy(saved[0]), body.waves.axes, saved[1][0])


def _simulated(body: StillBody) -> SimulatedT:
    spacing = 1e3 * body.solver.spacing
    logger.debug("simulating a T-matrix: %d waves, cells of %.3g mm", (body.degree + 1) ** 2, spacing)
    waves = body.waves
    matrix, residual = waves.matrix()
    return SimulatedT(matrix, waves.axes, residual)


def _warn_of_unsettled(solver: Solver, residual: float) -> None:
    warn_user(
        f"no steady state of the waves of a body after {solver.max_periods} periods: estimated relative "
        f"error up to {residual:.1e}, tolerance {solver.error:g}; raise max_periods or tolerance",
        SteadyStateWarning,
    )
