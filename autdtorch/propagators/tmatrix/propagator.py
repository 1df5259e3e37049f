"""The propagator of T-matrices: each body of a scene is simulated once, wherever it is."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch

from autdtorch.fdtd.grid_errors import grid_errors, rigid_errors, shape_errors, sizes
from autdtorch.propagators.absorbed_power import AbsorbedPower, power_into_sphere
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.propagator import ScenePropagator
from autdtorch.propagators.simulated import SimulatedPropagator
from autdtorch.propagators.simulation import Run
from autdtorch.propagators.store import Store
from autdtorch.propagators.tmatrix.body_simulation import Placed, Solver, placed
from autdtorch.propagators.tmatrix.obstacle_groups import (
    ObstacleGroup,
    are_outside,
    bodies_of,
    has_closed_form,
)
from autdtorch.propagators.tmatrix.scattering import scattered_waves, waves_at, waves_of_body
from autdtorch.propagators.tmatrix.tmatrix import TMatrix, TMatrixCluster
from autdtorch.scene.checks import require_clear
from autdtorch.scene.reflectors import require_in_front
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL, device_of
from autdtorch.utils.mirror_images import Image
from autdtorch.utils.process import cached_property, one_library_thread
from autdtorch.utils.validation import ArrayLike, differentiable_points, points_tensor

logger = logging.getLogger(__name__)

_AT_ONCE = 512  # Points whose waves are computed at once: 4 to 6 MB for the paper's cubes
_FEWER = 2  # Degrees left out to see how waves converge; even, as parities may alternate
_SLOWEST = 0.9  # Ratio of successive pairs of degrees up to which a sum is extrapolated
_ERRORS = 1e-8, 0.1  # Range of the error at which degrees are left out
_MORE_WAVES = 1e-3  # Tolerance for which the waves left out are computed, relative to the one asked for
_ROUNDING = 1e-12  # Error of sums of all waves
_NEAREST = 0.68  # Largest relative place of a limit point that is resolved: 48 degrees for 1e-8
_TINY = torch.finfo(torch.float64).tiny


class TMatrixPropagator(ScenePropagator):
    """A propagator by the T-matrices of a scene's bodies, simulated once or in closed form.

    Obstacles whose circumscribed spheres overlap make one body. Points inside a sphere, or so near that the
    waves have not converged to the tolerance, are served by a propagator of method "box", which is logged.

    Attributes:
        scene: the scene it was made for.
        method: "tmatrix".
        spacing: edge of a cell [m].
        tolerance: relative error at which waves are left out, and at which runs end.
        plan: the plan.
        max_periods: periods after which a run ends in any case.
    """

    def __init__(
        self,
        plan: Plan,
        store: Store | None = None,
        make_box: Callable[[], SimulatedPropagator] | None = None,
        bodies: TMatrixCluster | None = None,
    ) -> None:
        """Use `make_propagator`, which checks its arguments. Nothing is computed here.

        `make_box` makes the propagator of points near a body; by default it has the plan's spacing.
        `bodies` are those of the scene, where they are known.
        """
        self.scene, self.method, self.spacing = plan.scene, plan.method, plan.spacing
        self.tolerance, self.max_periods = plan.tolerance, plan.max_periods
        self.plan, self._store, self._bodies = plan, store or Store(), bodies
        self._make_box = make_box or functools.partial(SimulatedPropagator, plan.on_grids, self._store)

    def __repr__(self) -> str:
        cells = f"spacing {1e3 * self.spacing:.4g} mm" if self.plan.runs else "exact waves"
        settings = f"tmatrix, {cells}, waves left out at {self.tolerance:g}"
        return f"TMatrixPropagator(scene {self.scene.name!r}, {settings})"

    def for_scene(self, scene: Scene, bodies: TMatrixCluster | None = None) -> TMatrixPropagator:
        """Return the propagator of a changed scene with these settings; its bodies need not be simulated."""
        return TMatrixPropagator(self.plan.of(scene), self._store, bodies=bodies)

    @property
    def runs(self) -> list[Run]:
        """The simulations of points that are served by the box; those of the bodies are not counted."""
        return self._box.runs

    @property
    def time_step(self) -> float:
        """The time step of the box [s]."""
        return self._box.time_step

    @property
    def cells(self) -> int:
        """Number of cells of all grids; 0 where T-matrices have a closed form."""
        return self.plan.cells if self.plan.runs else 0

    @cached_property
    def bodies(self) -> TMatrixCluster:
        """The bodies of the scene."""
        if self._bodies is not None:
            return self._bodies
        with torch.inference_mode(False):  # later calls may need gradients
            return TMatrixCluster(
                [TMatrix(**vars(body.matrix(self._store))) for body in placed_bodies(self.plan)],
                self.scene.reflectors,
            )

    @property
    def planned_runs(self) -> int:
        """Number of simulations of all T-matrices, if none is there."""
        return sum(body.runs for body in placed_bodies(self.plan))

    def serves(self, points: ArrayLike) -> torch.Tensor:
        """Return which points (P, 3) [m] are outside all bodies' spheres; none if a transducer is not."""
        nodes = self.scene.array.nodes.positions.reshape(-1, 3)
        outside = are_outside(points_tensor("points", points).cpu(), self._spheres)
        return (outside & are_outside(nodes, self._spheres).all()).to(device_of(points))

    @cached_property
    def _spheres(self) -> list[ObstacleGroup]:
        return bodies_of(self.scene.obstacles)

    @one_library_thread()
    def _matrix(self, points: ArrayLike | None, with_error: bool) -> tuple[torch.Tensor, float]:
        places = self._checked(points)
        matrix, served = self.by_waves(places)
        near, box_error = places[~served].detach(), 0.0
        if len(near):
            rows, box_error = self._box._matrix(near, with_error)
            matrix = matrix.index_put((~served,), rows)
        if not with_error:
            return matrix, 0.0
        size = matrix.detach().norm(dim=1)
        errors = self._wave_errors(places.detach()[served], matrix.detach()[served]) * size[served]
        error = math.hypot(float(errors.norm()), box_error * float(size[~served].norm()))
        return matrix, error / float(size.norm().clamp_min(_TINY))

    @one_library_thread()
    def point_errors(self, points: ArrayLike | None = None) -> torch.Tensor:
        """Return the estimated relative error of each point's row of the transfer matrix, float64 (P,)."""
        places = self._checked(points).detach()
        matrix, served = self.by_waves(places)
        errors = torch.zeros(len(places), **REAL)
        errors[served] = self._wave_errors(places[served], matrix[served])
        if not served.all():
            errors[~served] = self._box.point_errors(places[~served])
        return errors.to(device_of(points))

    def _wave_errors(self, points: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
        """Return the estimated errors (P,) of rows of G (P, M) that the waves serve."""
        if not len(points):
            return torch.zeros(0, **REAL)
        free = free_space_matrix(points, self.scene.array, self.scene.complex_wavenumber, self.scene.images)
        region = self.plan.region
        if not self.plan.runs:  # exact up to the waves left out
            more = self.plan.at(self.spacing, _MORE_WAVES * self.tolerance)
            other, served = TMatrixPropagator(more, self._store).by_waves(points)
            left_out = (matrix - other).norm(dim=1) / sizes(matrix, free)
            errors = torch.full((len(points),), self.tolerance, **REAL)
            return torch.where(served, left_out + _ROUNDING, errors)
        second = TMatrixPropagator(self.plan.second, self._store)
        other = second.transfer_matrix(points)
        others = [(other, second.spacing)]
        errors = grid_errors(matrix, free, self.spacing, others, self.plan.law)
        known = shape_errors(matrix, free, region) + rigid_errors(matrix, free, region)
        resonances = self._resonance_error * (matrix - free).norm(dim=1) / sizes(matrix, free)
        return self.tolerance + torch.hypot(errors, resonances) + known

    @cached_property
    def _resonance_error(self) -> float:
        """The error of what bodies scatter by the shift of their resonances, which a run of each tells."""
        bodies = [each.body for each in placed_bodies(self.plan) if each.runs]
        return max(SimulatedPropagator(body.plan, self._store).resonance_error for body in bodies)

    @one_library_thread()
    def _field(self, drive: torch.Tensor, points: torch.Tensor, is_picture: bool) -> torch.Tensor:
        places = self._checked(points)
        parts, masks = [], []
        for part in torch.split(places, _AT_ONCE):
            matrix, served = self.by_waves(part)
            parts.append(drive @ matrix.mT)
            masks.append(served)
        field, served = torch.cat(parts, dim=-1), torch.cat(masks)
        if not served.all():
            field = field.clone()
            field[..., ~served] = self._box._field(drive, places[~served].detach(), is_picture)
        return field

    @one_library_thread()
    def _absorbed(self, drive: torch.Tensor) -> AbsorbedPower:
        scene, bodies = self.scene, self._spheres
        absorb = any(abs(reflector.reflection) < 1 for reflector in scene.reflectors)
        if absorb or not all(has_closed_form(body.obstacles) for body in bodies):
            return self._box._absorbed(drive)
        power = torch.zeros((len(drive), len(scene.obstacles)), **REAL)
        for number, body in enumerate(bodies):
            waves = waves_of_body(self.bodies.bodies, number, scene.array, scene.images, drive)
            power[:, list(body.numbers)] = power_into_sphere(*waves, body.radius, scene)[:, None]
        return AbsorbedPower(power, torch.zeros((len(drive), len(scene.reflectors)), **REAL))

    @cached_property
    def _box(self) -> SimulatedPropagator:
        """The propagator of points near a body; it is made, and its spacing chosen, when the first is met."""
        return self._make_box()

    def _checked(self, points: ArrayLike | None) -> torch.Tensor:
        places = differentiable_points("points", self.scene.control_points if points is None else points)
        require_clear(self.scene.array, "points", places.detach())
        require_in_front(self.scene.reflectors, "points", places.detach())
        return places.cpu()

    def by_waves(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return G (P, M) at points (P, 3), and which rows (P,) the waves serve; others are 0."""
        served = self.serves(points)
        matrix = torch.zeros((len(points), len(self.scene.array)), **COMPLEX)
        if served.any():
            outside = points[served]
            parts = [self._converged(part) for part in torch.split(outside, _AT_ONCE)]
            rows, converged = (torch.cat(part) for part in zip(*parts, strict=True))
            served = served.index_put((served.clone(),), converged)
            matrix = matrix.index_put((served,), rows[converged])
        if not served.all():
            logger.debug("%d points are too near an obstacle for its waves: by box", int((~served).sum()))
        return matrix, served

    def _converged(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return G (P, M) at points (P, 3), and where (P,) the waves have converged to the tolerance."""
        waves, scattered = waves_at(self.bodies.bodies, points, self.scene.images), self._scattered
        direct = free_space_matrix(points, self.scene.array, self.scene.complex_wavenumber, self.scene.images)
        matrix = waves @ scattered[0] + direct
        left_out = self._left_out(waves.detach(), scattered)
        return matrix, left_out <= self.tolerance * matrix.detach().norm(dim=1)

    @cached_property
    def _scattered(self) -> list[torch.Tensor]:
        """Outgoing waves (N, M) of all bodies, by all degrees and with the highest ones left out."""
        with torch.inference_mode(False):
            bodies, scene = self.bodies.bodies, self.scene
            return scattered_waves(bodies, scene.array, scene.images, (0, _FEWER, 2 * _FEWER))

    @staticmethod
    def _left_out(waves: torch.Tensor, scattered: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return what the waves left out would add (P,), extrapolated from the last two pairs of degrees."""
        last, before = ((waves @ (one - other)).norm(dim=1) for one, other in pairwise(scattered))
        ratio = (last / before.clamp_min(_TINY)).clamp_max(_SLOWEST)
        left_out: torch.Tensor = last * ratio / (1 - ratio)
        return left_out


def placed_bodies(plan: Plan) -> list[Placed]:
    """Return the bodies of a plan's scene, before they are simulated."""
    scene, error = plan.scene, min(max(plan.tolerance, _ERRORS[0]), _ERRORS[1])
    solver = Solver(plan.spacing, error, plan.kernel, plan.dtype, plan.max_periods, plan.time_step)
    bodies, settings = bodies_of(scene.obstacles), (scene.medium, scene.frequency, solver)
    degrees = [
        _degrees_between(body, bodies, scene.images, error)
        if has_closed_form(body.obstacles)  # others would take more runs
        else 0
        for body in bodies
    ]
    return [placed(body.obstacles, *settings, fewest) for body, fewest in zip(bodies, degrees, strict=True)]


def _degrees_between(
    body: ObstacleGroup, bodies: Sequence[ObstacleGroup], images: Sequence[Image], error: float
) -> int:
    """Return the degrees of the waves between a body and its nearest neighbour or image.

    Waves that go back and forth between two spheres come from a limit point in each, as images of images do.
    """
    fewest = 0
    for other in bodies:
        for image in images[1:] if other is body else images:
            apart = float((body.center - image.of(other.center)).norm())
            middle = (apart**2 + body.radius**2 - other.radius**2) / (2 * apart) / body.radius
            place = middle - math.sqrt(max(middle**2 - 1, 0.0))  # of the limit point, relative to the radius
            share = place**2 if other is body else place  # what comes back from a plane has gone both ways
            fewest = max(fewest, math.ceil(math.log(error) / math.log(min(share, _NEAREST))))
    return fewest
