"""The force on the bodies of a scene under one drive, by the field around each, of any propagator.

Between two spheres around a body, the field is a sum of the regular waves that come in and of the outgoing
ones that it scatters. Pressures on both spheres tell them apart; the force follows as by a T-matrix
(`propagators.tmatrix.force`).
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from scipy.special import spherical_jn, spherical_yn

from autdtorch.analytic.momentum import linear_momentum
from autdtorch.analytic.spherical_waves import degrees, harmonics
from autdtorch.propagators.propagator import Propagator
from autdtorch.propagators.tmatrix.bodies import ObstacleGroup, bodies_of
from autdtorch.propagators.tmatrix.force import radiation_force
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import REAL

_APART = 0.15, 0.3  # wavelengths between a body's circumscribed sphere and the two around it
_MORE_DEGREES = 7  # than k r of the outer one


def forces_on_obstacles(propagator: Propagator, drive: torch.Tensor) -> torch.Tensor:
    """Return the mean radiation force (K, 3) [N] on each obstacle under a drive (M,).

    Obstacles whose circumscribed spheres overlap are one body, and have the force on it. NaN where another
    body, a reflector or the array is too near for the spheres around the body. By boxes it is as exact as
    the grid.
    """
    scene, bodies = propagator.scene, bodies_of(propagator.scene.obstacles)
    forces = torch.full((len(scene.obstacles), 3), math.nan, **REAL)
    for number, body in enumerate(bodies):
        rows = list(body.numbers)
        if isinstance(propagator, TMatrixPropagator):
            forces[rows] = radiation_force(propagator, drive, number).detach()
        elif _is_alone(scene, bodies, body):
            forces[rows] = _force_on(propagator, drive, body)
    return forces


def _is_alone(scene: Scene, bodies: list[ObstacleGroup], body: ObstacleGroup) -> bool:
    """Return whether nothing else is within the spheres around a body."""
    radius = body.radius + _APART[1] * scene.wavelength
    others = [float((one.center - body.center).norm()) - one.radius for one in bodies if one is not body]
    others += [float(each.mirror.height(body.center)) for each in scene.reflectors]
    others.append(float((scene.array.nodes.positions - body.center).norm(dim=-1).min()))
    return min(others) > radius


def _force_on(propagator: Propagator, drive: torch.Tensor, body: ObstacleGroup) -> torch.Tensor:
    """Return the force (3,) [N] on a body by the pressures on two spheres around it."""
    scene = propagator.scene
    k, radii = scene.complex_wavenumber, [body.radius + share * scene.wavelength for share in _APART]
    degree = math.ceil(scene.wavenumber * radii[1]) + _MORE_DEGREES
    nodes, to_waves = _sphere(degree)
    points = torch.cat([body.center + radius * nodes for radius in radii])
    # a grid, which may be near obstacles without a warning
    on_spheres = propagator.field(drive, points[None]).reshape(2, -1) @ to_waves  # (2, N)
    orders = np.arange(degree + 1)
    regular = np.array([spherical_jn(orders, k * radius) for radius in radii])
    radial = np.stack(
        [regular, regular + 1j * np.array([spherical_yn(orders, k * r) for r in radii])], axis=1
    )
    columns = torch.from_numpy(radial)[..., degrees(degree)].movedim(-1, 0)  # (N, spheres, kinds)
    scale = columns.abs().amax(dim=1, keepdim=True)
    solved = torch.linalg.solve(columns / scale, on_spheres.mT[..., None])[..., 0] / scale[:, 0]
    incoming, outgoing = solved[:, :1], solved[:, 1:]
    momentum = linear_momentum(incoming + outgoing).conj()
    factor = 1 / (2 * scene.medium.density * scene.angular_frequency**2)
    force: torch.Tensor = -factor * (momentum * outgoing).sum(dim=(-2, -1)).real
    return force


@functools.lru_cache(4)
def _sphere(degree: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return nodes (S, 3) on the unit sphere, and the map (S, N) from values there to those of harmonics."""
    rings = degree + 1
    z, weight = np.polynomial.legendre.leggauss(rings)
    angle = math.pi / rings * np.arange(2 * rings)
    across = np.sqrt(1 - z**2)[:, None]
    nodes = np.stack(np.broadcast_arrays(across * np.cos(angle), across * np.sin(angle), z[:, None]), axis=-1)
    places = torch.from_numpy(nodes.reshape(-1, 3))
    weights = torch.from_numpy(np.repeat(weight * math.pi / rings, 2 * rings))
    return places, weights[:, None] * harmonics(degree, places).conj()
