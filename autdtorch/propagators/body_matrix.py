"""The matrix T of obstacles that scatter as one body: in closed form, kept from before, or simulated."""

from __future__ import annotations

import functools
import logging
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch

from autdtorch.analytic.spherical_waves import degrees, enough_degrees, sphere_coefficients
from autdtorch.propagators.body_waves import BodyWaves
from autdtorch.propagators.cache import DiskCache
from autdtorch.propagators.plan import plan
from autdtorch.propagators.scene_bodies import has_closed_form
from autdtorch.propagators.simulated import SteadyStateWarning
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle, Sphere
from autdtorch.scene.obstacles.moving import at_rest, circumscribed, is_movable, shifted
from autdtorch.scene.scene import OverlapWarning, ScaleWarning, Scene
from autdtorch.utils.array_types import REAL
from autdtorch.utils.cached import cached_property
from autdtorch.utils.digest import digest_of, package_versions, source_digest
from autdtorch.utils.memory import require_memory

logger = logging.getLogger(__name__)

_ENTRY_BYTES = 48.0  # of T and what makes it
_KEPT = 4  # Matrices kept: 8 MB each for the paper's cubes
_DIGITS = 10  # Decimals of the places [m] of obstacles in their body, so that poses are the same body


class BodyMatrix(NamedTuple):
    """The attributes of a `ScatteringOperator`."""

    matrix: torch.Tensor
    wavenumber: complex
    radius: float
    center: torch.Tensor
    axes: torch.Tensor


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
        return enough_degrees(self.scene.wavenumber * self.sphere[1], self.solver.error)

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
        return 0 if has_closed_form(body.obstacles, body.medium) else len(body.waves.runs)

    def matrix(self, cache: DiskCache | None) -> BodyMatrix:
        """Return T, from memory or disk if it is there."""
        body, scene = self.body, self.body.scene
        center, radius = body.sphere
        count = (body.degree + 1) ** 2
        require_memory("obstacles", f"{count} waves", _ENTRY_BYTES * count**2)
        if has_closed_form(body.obstacles, body.medium):
            matrix, axes = (
                _of_sphere(body.obstacles[0], scene, body.degree),
                torch.eye(3, **REAL),
            )
        else:
            comparable = all(map(is_movable, body.obstacles))  # others may have no hash
            simulate = _simulated if comparable else _simulated.__wrapped__
            kept, axes, residual = simulate(body, cache and cache.folder)
            matrix = kept.clone()
            if residual > body.solver.error:
                _warn_of_unsettled(body.solver, residual)
        place = self.turn @ center + self.shift
        return BodyMatrix(matrix, scene.complex_wavenumber, radius, place, self.turn @ axes)


def placed(obstacles: Sequence[Obstacle], medium: Medium, frequency: float, solver: Solver) -> Placed:
    """Return the body that obstacles make, around the origin where they can be moved."""
    still, turn = at_rest(obstacles)
    shift = torch.zeros(3, **REAL)
    if all(map(is_movable, still)):
        shift, _ = circumscribed(still)
        still = tuple(shifted(one, -shift, _DIGITS) for one in still)
    return Placed(StillBody(still, medium, frequency, solver), turn, turn @ shift)


def _of_sphere(sphere: Obstacle, scene: Scene, degree: int) -> torch.Tensor:
    assert isinstance(sphere, Sphere)
    ratios = math.inf, 1.0
    if not sphere.rigid:
        assert sphere.density is not None
        assert sphere.sound_speed is not None
        ratios = sphere.density / scene.medium.density, sphere.sound_speed / scene.medium.sound_speed
    each = torch.from_numpy(sphere_coefficients(degree, scene.wavenumber * sphere.radius, *ratios))
    return torch.diag(each[degrees(degree)])


@functools.lru_cache(_KEPT)
def _simulated(body: StillBody, folder: Path | None) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Return T of a body from the cache in a folder, or simulate it.

    With the axes of its grid and the largest residual of its runs; the last ones are kept in memory.
    """
    waves, shape = body.waves, 2 * ((body.degree + 1) ** 2,)
    cache = None if folder is None else DiskCache(folder)
    digest = digest_of(source_digest(), package_versions(), _described(body))
    if cache is not None and (found := cache.load(digest, shape, 1)) is not None:
        logger.info("scattering operator of an earlier run, kept in %s", folder)
        return torch.from_numpy(found[0]), waves.axes, found[1][0]
    spacing = 1e3 * body.solver.spacing
    logger.debug("simulating a scattering operator: %d waves, cells of %.3g mm", shape[0], spacing)
    matrix, residual = waves.matrix()
    if cache is not None and residual <= body.solver.error:
        cache.save(digest, matrix.numpy(), residual)
    return matrix, waves.axes, residual


def _warn_of_unsettled(solver: Solver, residual: float) -> None:
    warnings.warn(
        f"no steady state of the waves of a body after {solver.max_periods} periods: estimated relative "
        f"error up to {residual:.1e}, tolerance {solver.error:g}; raise max_periods or tolerance",
        SteadyStateWarning,
        stacklevel=4,  # about where the operator is made
    )


def _described(body: StillBody) -> tuple[object, ...]:
    settings = tuple(str(each) if isinstance(each, torch.dtype) else each for each in body.solver)
    return body.obstacles, body.medium, body.frequency, settings
