"""The place where a sphere rests in a field, with the waves between it and the bodies of the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from autdtorch.propagators.free_space import FreeSpacePropagator
from autdtorch.propagators.propagator import Propagator
from autdtorch.propagators.tmatrix.force import radiation_force
from autdtorch.propagators.tmatrix.obstacle_groups import room_around
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.propagators.tmatrix.tmatrix import TMatrix, TMatrixCluster
from autdtorch.scene.drive import validate_single_drive
from autdtorch.scene.obstacles import Sphere
from autdtorch.scene.particle import Particle
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import ArrayLike, Vector, finite_vector, invalid, require_kind, unit_vector

_ERROR = 1e-6  # of the sphere's T-matrix
_FARTHEST = 0.5  # wavelengths from the point, where the next traps are
_STEP = 0.05  # wavelengths, the longest step
_MOST_STEPS = 40
_SETTLED = 1e-6  # wavelengths, the last step
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """The force on a sphere at a point, and the place of equilibrium near it, if there is one.

    Attributes:
        force: at the point, with the weight (3,) [N].
        place: where the force is 0 (3,) [m]; None if the sphere goes away from the point, by half a
            wavelength or to a body or transducer.
        stiffness: -dF_i/dx_j (3, 3) [N/m], at the place, or at the point without one.
    """

    force: torch.Tensor
    place: torch.Tensor | None
    stiffness: torch.Tensor

    @property
    def principal_stiffness(self) -> torch.Tensor:
        """The eigenvalues of its symmetric part (3,) [N/m], the least first."""
        values: torch.Tensor = torch.linalg.eigvalsh((self.stiffness + self.stiffness.mT) / 2)
        return values

    @property
    def holds(self) -> bool:
        """True if the sphere rests at the place, and is pulled back to it from all sides."""
        return self.place is not None and float(self.principal_stiffness[0]) > 0


def equilibrium(
    propagator: Propagator,
    drive: ArrayLike,
    particle: Particle,
    point: ArrayLike,
    *,
    up: Vector | None = None,
) -> Equilibrium:
    """Return where a sphere rests near a point, by the exact force on it among the bodies of the scene.

    It has the waves back and forth between sphere and bodies, which `Trap` and `Levitate` leave out. The
    sphere follows the force from the point, by Newton's method where it is pulled back from all sides.

    Args:
        propagator: of method "tmatrix", or "free_space".
        drive: (M,) complex, |q| <= 1.
        particle: the sphere, of any size.
        point: (3,) [m], such as the place that it was put to.
        up: direction against gravity (3,); the weight then counts. Without it, sound alone.

    Raises:
        ValueError: an argument of another shape or kind, or a sphere that is not clear of bodies,
            reflectors and transducers at the point.
    """
    if not isinstance(propagator, TMatrixPropagator | FreeSpacePropagator):
        raise invalid("propagator", propagator, 'must be of method "tmatrix" or "free_space"')
    scene = propagator.scene
    require_kind("particle", particle, Particle)
    drive = validate_single_drive(drive, len(scene.array)).detach().cpu()
    start = torch.tensor(finite_vector("point", point), **REAL)
    upwards = torch.zeros(3, **REAL) if up is None else torch.tensor(unit_vector("up", up), **REAL)
    others = propagator.bodies.bodies if isinstance(propagator, TMatrixPropagator) else ()
    sphere = Sphere(
        (0.0, 0.0, 0.0), particle.radius, density=particle.density, sound_speed=particle.sound_speed
    )
    ball = TMatrix.of(sphere, scene.medium, scene.frequency, error=_ERROR)

    def force(place: torch.Tensor) -> torch.Tensor:
        bodies = TMatrixCluster([*others, ball.moved(place)], scene.reflectors)
        sound = radiation_force(bodies, drive, len(others), array=scene.array, medium=scene.medium)
        return sound - particle.weight * upwards

    def is_clear(place: torch.Tensor) -> bool:
        return room_around(place, others, scene) >= particle.radius

    if not is_clear(start):
        raise invalid(
            "point", tuple(start.tolist()), "must leave room for the sphere beside bodies and array", "m"
        )
    first, stiffness = _with_stiffness(force, start)
    place, now, at_start, longest = start, first, stiffness, _STEP * scene.wavelength
    for _ in range(_MOST_STEPS):
        step = _step(now, stiffness)
        step = step * min(1.0, longest / max(float(step.norm()), _TINY))
        place = place + step
        if float((place - start).norm()) > _FARTHEST * scene.wavelength or not is_clear(place):
            break
        now, stiffness = _with_stiffness(force, place)
        if float(step.norm()) < _SETTLED * scene.wavelength:
            return Equilibrium(first, place, stiffness)
    return Equilibrium(first, None, at_start)


@torch.inference_mode(False)
@torch.enable_grad()
def _with_stiffness(
    force: Callable[[torch.Tensor], torch.Tensor], place: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the force (3,) [N] at a place (3,) [m], and the stiffness (3, 3) [N/m]."""
    variable = place.clone().requires_grad_()
    value = force(variable)
    rows = [torch.autograd.grad(part, variable, retain_graph=True)[0] for part in value]
    return value.detach(), -torch.stack(rows)


def _step(force: torch.Tensor, stiffness: torch.Tensor) -> torch.Tensor:
    """Return the step (3,) [m] of Newton's method, or one along the force where it does not pull back."""
    values, axes = torch.linalg.eigh((stiffness + stiffness.mT) / 2)
    if float(values[0]) > 0:
        solved: torch.Tensor = torch.linalg.solve(stiffness, force)
        return solved
    along: torch.Tensor = axes @ ((axes.mT @ force) / values.abs().clamp_min(_TINY))
    return along
