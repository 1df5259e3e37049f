"""The stress of sound on surfaces, and the force on bodies, by the field around them, of any propagator.

Between two spheres around a body, the field is a sum of the regular waves that come in and of the outgoing
ones that it scatters. Pressures on both spheres tell them apart; the force follows as by a T-matrix
(`propagators.tmatrix.force`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from autdtorch.analytic.momentum import linear_momentum, taken_up
from autdtorch.analytic.spherical_waves import (
    degrees,
    outgoing_radial,
    regular_radial,
    sphere_rule,
    to_harmonics,
)
from autdtorch.propagators.derivatives import field_derivatives, nodes_around
from autdtorch.propagators.propagator import Propagator
from autdtorch.propagators.tmatrix.force import radiation_force
from autdtorch.propagators.tmatrix.obstacle_groups import ObstacleGroup, bodies_of, room_around
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import REAL, device_of
from autdtorch.utils.validation import ArrayLike, points_grid, real_tensor, require_kind

_APART = 0.15, 0.3  # wavelengths between a body's circumscribed sphere and the two around it
_MORE_DEGREES = 7  # than k r of the outer one

_AT_ONCE = 1024
"""Points whose derivatives are computed at once, from 128 pressures each."""


def forces_on_obstacles(propagator: Propagator, drive: torch.Tensor) -> torch.Tensor:
    """Return the mean radiation force (K, 3) [N] on each obstacle under a drive (M,).

    Obstacles whose circumscribed spheres overlap are one body, and have the force on it. NaN where another
    body, a reflector or the array is too near for the spheres around the body. By boxes it is as exact as
    the grid.
    """
    scene, bodies = propagator.scene, bodies_of(propagator.scene.obstacles)
    forces = torch.full((len(scene.obstacles), 3), math.nan, **REAL)
    if isinstance(propagator, TMatrixPropagator):
        for number, body in enumerate(bodies):
            forces[list(body.numbers)] = radiation_force(propagator, drive, number).detach()
    elif spheres := [around for body in bodies if (around := _Spheres.around(body, bodies, scene))]:
        # one simulation for all; a grid, which may be near obstacles without a warning
        pressures = propagator.field(drive, torch.cat([each.points for each in spheres], dim=1))
        sizes = [each.points.shape[1] for each in spheres]
        for each, pressure in zip(spheres, torch.split(pressures, sizes, dim=1), strict=True):
            forces[list(each.body.numbers)] = each.force(pressure, scene)
    return forces


class _Spheres(NamedTuple):
    """Two spheres around a body, with no other between them and it."""

    body: ObstacleGroup
    radii: torch.Tensor  # (2,) [m]
    degree: int  # of the waves between them
    points: torch.Tensor  # nodes (2, S, 3) [m]

    @classmethod
    def around(cls, body: ObstacleGroup, bodies: Sequence[ObstacleGroup], scene: Scene) -> _Spheres | None:
        """Return the spheres around one of the bodies of a scene, or None where there is no room for them."""
        radii = torch.tensor([body.radius + share * scene.wavelength for share in _APART], **REAL)
        if room_around(body.center, [other for other in bodies if other is not body], scene) <= radii[1]:
            return None
        degree = math.ceil(scene.wavenumber * float(radii[1])) + _MORE_DEGREES
        return cls(body, radii, degree, body.center + radii[:, None, None] * sphere_rule(degree + 1)[0])

    def force(self, pressure: torch.Tensor, scene: Scene) -> torch.Tensor:
        """Return the force (3,) [N] on the body from pressures (2, S) at the nodes."""
        on_spheres = pressure @ to_harmonics(self.degree, self.degree + 1)  # (2, N)
        size = scene.complex_wavenumber * self.radii
        outgoing_waves = outgoing_radial(self.degree, size).mT[:, degrees(self.degree)]
        radial = regular_radial(self.degree, size[:, None]), outgoing_waves
        columns = torch.stack(radial, dim=-1).movedim(1, 0)  # (N, spheres, kinds)
        scale = columns.abs().amax(dim=1, keepdim=True)
        solved = torch.linalg.solve(columns / scale, on_spheres.mT[..., None])[..., 0] / scale[:, 0]
        incoming, outgoing = solved[:, :1], solved[:, 1:]
        factor = 1 / (2 * scene.medium.density * scene.angular_frequency**2)
        force: torch.Tensor = factor * taken_up(linear_momentum, incoming, outgoing)[:, 0, 0].real
        return force


def radiation_stress(
    propagator: Propagator, drive: torch.Tensor, points: ArrayLike, normals: ArrayLike
) -> torch.Tensor:
    """Return the mean force per area [Pa] on what is behind a surface, by the sound in front of it.

    It is -<L> n - rho <v (v n)>, where L = p^2 / (2 rho c^2) - rho v^2 / 2 of the linear field. Its
    integral over a closed surface is the force on all within, wherever the surface is. Over an open one, such
    as a plane through a focus, it is the momentum that passes. In air that absorbs, that at the surface.

    Args:
        propagator: any, with the body that the sound meets among the obstacles or reflectors.
        drive: (..., M) complex, |q| <= 1.
        points: (P, 3), or a grid (..., 3) [m], which takes the place of P below. Each is 1.5 / k, 2 mm at 40
            kHz, or more from bodies, for the gradient of the pressure.
        normals: of the surface, into the sound: (3,), or one for each point; any length.

    Returns:
        float64 (..., P, 3); the pressure on the surface is its product with -n. Differentiable by the drive.

    Raises:
        ValueError: an argument of another shape or out of range, or a point too near.
    """
    require_kind("propagator", propagator, Propagator)
    scene, (places, grid) = propagator.scene, points_grid("points", points)
    device, drive = device_of(drive), validate_drive(drive, len(scene.array)).cpu()
    normals = _unit_normals(normals, grid)
    medium, parts = scene.medium, []
    for nodes in torch.split(nodes_around(scene, places.detach().cpu()), _AT_ONCE):
        parts.append(field_derivatives(propagator, drive, nodes)[:2])
    pressure, slope = (torch.cat(each, dim=drive.ndim - 1) for each in zip(*parts, strict=True))
    velocity = slope / (1j * scene.angular_frequency * medium.density)
    potential = pressure.abs().square() / (4 * medium.density * medium.sound_speed**2)
    kinetic = medium.density / 4 * velocity.abs().square().sum(dim=-1)
    through = (velocity.conj() * normals).sum(dim=-1, keepdim=True)
    stress = (kinetic - potential)[..., None] * normals - medium.density / 2 * (velocity * through).real
    return stress.reshape(*drive.shape[:-1], *grid, 3).to(device)


def _unit_normals(normals: ArrayLike, grid: torch.Size) -> torch.Tensor:
    """Return unit normals (3,) or (P, 3) of points on a grid, after checking them."""
    vectors = real_tensor("normals", normals).cpu().detach()
    if vectors.shape not in ((3,), (*grid, 3)):
        accepted = f"must be (3,) or {(*grid, 3)}, as the points"
        raise ValueError(f"normals: shape {tuple(vectors.shape)}; {accepted}")
    lengths = vectors.norm(dim=-1, keepdim=True)
    if not (lengths > 0).all():
        raise ValueError("normals: 0; each must have a length")
    unit: torch.Tensor = vectors / lengths
    return unit.reshape(-1, 3) if vectors.ndim > 1 else unit
