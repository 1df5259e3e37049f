"""The radiation stress of sound on surfaces: what presses on a palm, a plate, or a surface around a body."""

from __future__ import annotations

import torch

from autdtorch.propagators.derivatives import field_derivatives, nodes_around
from autdtorch.propagators.propagator import Propagator
from autdtorch.scene.drive import validate_drive
from autdtorch.utils.validation import ArrayLike, points_grid, real_tensor, require_kind

_AT_ONCE = 1024
"""Points whose derivatives are computed at once, from 128 pressures each."""


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
    drive = validate_drive(drive, len(scene.array)).cpu()
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
    return stress.reshape(*drive.shape[:-1], *grid, 3)


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
