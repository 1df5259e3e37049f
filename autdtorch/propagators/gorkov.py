"""The force of sound on small particles: Gor'kov's potential, force and stiffness.

    U = V (f1 |p|^2 / (4 rho c^2) - 3 f2 |grad p|^2 / (8 rho w^2))

with peak amplitudes p, the volume V and the factors f1, f2 of `Particle.contrasts` (Gor'kov 1962, Sov. Phys.
Dokl. 6, 773; Bruus 2012, doi:10.1039/c2lc21068a). The force is -grad U, with a relative error of about (ka)^2
/ 2. Waves between particle and bodies are left out. `Trap` and `radiation_force` take the exact force on a
sphere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from autdtorch.propagators.derivatives import Derivatives, field_derivatives, nodes_around
from autdtorch.propagators.propagator import Propagator
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.particle import BEAD, Particle
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import device_of
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import ArrayLike, Vector, invalid, points_grid, require_kind, unit_vector

LARGEST = 0.1
"""LARGEST: radius of a small particle, relative to the wavelength; the force then errs by a quarter."""


@dataclass(frozen=True, eq=False)
class Gorkov:
    """Potential, force and stiffness of a particle at P points under drives.

    Attributes:
        potential: U (..., P) [J].
        force: -grad U (..., P, 3) [N].
        stiffness: the second derivatives of U (..., P, 3, 3) [N/m]; positive where a displaced particle is
            pulled back.
    """

    potential: torch.Tensor
    force: torch.Tensor
    stiffness: torch.Tensor

    @property
    def principal_stiffness(self) -> torch.Tensor:
        """The eigenvalues of the stiffness (..., P, 3) [N/m], the least first; a trap has positive ones."""
        values: torch.Tensor = torch.linalg.eigvalsh(self.stiffness)
        return values

    @property
    def displacement(self) -> torch.Tensor:
        """The place of equilibrium by the stiffness, from each point (..., P, 3) [m].

        `ValueError` where a stiffness is 0 along some direction, as without sound.
        """
        solved, wrong = torch.linalg.solve_ex(self.stiffness, self.force)
        if wrong.any():
            index = tuple(wrong.nonzero()[0].tolist())
            accepted = "must not be 0 along any direction, as it is without sound"
            raise invalid(f"stiffness{list(index)}", self.stiffness[index].tolist(), accepted, "N/m")
        displaced: torch.Tensor = solved
        return displaced


def gorkov(
    propagator: Propagator,
    points: ArrayLike,
    drive: torch.Tensor,
    particle: Particle = BEAD,
    *,
    up: Vector | None = None,
) -> Gorkov:
    """Return Gor'kov's potential, the force and the stiffness of a small particle at points.

    Derivatives are exact: from pressures on a sphere of 1.5 / k around each point, 2 mm at 40 kHz.

    Args:
        propagator: any, free space or with obstacles.
        points: (P, 3), or a grid (..., 3) [m], which takes the place of P below.
        drive: (..., M) complex, |q| <= 1.
        particle: the particle, by default a bead of EPS with a radius of 0.5 mm. Potential, force and
            stiffness go with its volume.
        up: direction against gravity (3,); the weight of the particle then counts in potential and force.
            Without it, sound alone.

    Returns:
        Potential (..., P) [J], force (..., P, 3) [N] and stiffness (..., P, 3, 3) [N/m], differentiable as
        the propagator's `field` is.

    Raises:
        ValueError: a drive or points of another shape or out of range, or a point nearer than the sphere to
            the array, an obstacle or a reflector.

    Warns:
        ScaleWarning: a particle of a radius above 0.1 wavelength.
    """
    require_kind("propagator", propagator, Propagator)
    scene = propagator.scene
    require_kind("particle", particle, Particle)
    warn_of_large(particle, scene)
    places, grid = points_grid("points", points)
    device, drive = device_of(drive), validate_drive(drive, len(scene.array)).cpu()
    field = field_derivatives(propagator, drive, nodes_around(scene, places.cpu()))
    potential, force, stiffness = _of(field, particle, scene)
    if up is not None:
        upwards = force.new_tensor(unit_vector("up", up))
        potential = potential + particle.weight * (places.to(force) @ upwards)
        force = force - particle.weight * upwards
    shape = (*drive.shape[:-1], *grid)
    parts = potential.reshape(shape), force.reshape(*shape, 3), stiffness.reshape(*shape, 3, 3)
    return Gorkov(*(part.to(device) for part in parts))


def warn_of_large(particle: Particle, scene: Scene) -> None:
    """Warn if a particle is not small against the wavelength."""
    size = particle.radius / scene.wavelength
    if size > LARGEST:
        valid = f"Gor'kov's force is right for up to {LARGEST:g}, and `radiation_force` of a sphere for all"
        warn_user(f"particle: its radius is {size:.2f} wavelengths; {valid}")


def _of(
    field: Derivatives, particle: Particle, scene: Scene
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    medium, volume = scene.medium, 4 / 3 * math.pi * particle.radius**3
    f1, f2 = particle.contrasts(medium)
    alpha = volume * f1 / (4 * medium.density * medium.sound_speed**2)
    beta = volume * 3 * f2 / (8 * medium.density * scene.angular_frequency**2)
    p, first, second, third = field
    potential = alpha * p.abs().square() - beta * first.abs().square().sum(dim=-1)
    by_pressure = p.conj()[..., None] * first
    by_velocity = torch.einsum("...i,...ij->...j", first.conj(), second)
    force = -2 * (alpha * by_pressure - beta * by_velocity).real
    by_pressure = first.conj()[..., :, None] * first[..., None, :] + p.conj()[..., None, None] * second
    by_velocity = torch.einsum("...il,...ij->...lj", second.conj(), second)
    by_velocity = by_velocity + torch.einsum("...i,...ijl->...lj", first.conj(), third)
    return potential, force, 2 * (alpha * by_pressure - beta * by_velocity).real
