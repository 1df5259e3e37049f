"""Derivatives of the pressure at a point, by the regular waves of the field around it.

In a ball without bodies and sources, the field is a sum of regular waves j_l(kr) Y_lm around its centre.
Waves above a degree L hardly reach a sphere of k r below L, so that the pressures at nodes on the sphere give
the others: the error falls faster than any power of L. No derivative is a difference of neighbouring values,
whose errors a small step would magnify, and a propagator needs to know nothing but pressures.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from autdtorch.analytic.momentum import linear_momentum
from autdtorch.analytic.spherical_waves import regular_radial, sphere_rule, to_harmonics
from autdtorch.propagators.propagator import Propagator
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.process import cached_tensors
from autdtorch.utils.validation import invalid

SIZE = 1.5
"""SIZE: k r of the sphere; a larger one has smaller errors of rounding, and less room beside bodies."""

_RINGS = 8  # of the sphere: waves of the degree 2 * 8 - 3 are the first to be taken for others, at 3e-11
_THIRD = 3  # largest degree that matters to third derivatives
_COUNTS = [1, 3, 9, 27]


class Derivatives(NamedTuple):
    """The pressure and its derivatives at points, with leading dimensions of points, drives or transducers.

    Attributes:
        pressure: p (...) [Pa].
        first: dp/dx_i (..., 3) [Pa/m].
        second: (..., 3, 3) [Pa/m^2].
        third: (..., 3, 3, 3) [Pa/m^3].
    """

    pressure: torch.Tensor
    first: torch.Tensor
    second: torch.Tensor
    third: torch.Tensor


def nodes_around(scene: Scene, points: torch.Tensor) -> torch.Tensor:
    """Return the nodes (P, S, 3) [m] on spheres around points (P, 3), after checking that nothing is within.

    Raises:
        ValueError: an obstacle, a reflector or a transducer is nearer than the radius of the sphere, 1.5 / k.
    """
    radius = SIZE / scene.wavenumber
    places = points.detach().cpu()
    apart = torch.cdist(places, scene.array.nodes.positions.reshape(-1, 3)).amin(dim=1)
    near = {"the array": apart <= radius}
    for number, obstacle in enumerate(scene.obstacles):
        near[f"obstacles[{number}]"] = obstacle.contains(places, margin=radius)
    for number, reflector in enumerate(scene.reflectors):
        near[f"reflectors[{number}]"] = reflector.mirror.height(places) <= radius
    for name, wrong in near.items():
        if wrong.any():
            index = int(wrong.nonzero()[0])
            accepted = f"must be at least {1e3 * radius:.2f} mm from {name}, as its derivatives are needed"
            raise invalid(f"points[{index}]", tuple(places[index].tolist()), accepted, "m")
    return points[:, None] + radius * sphere_rule(_RINGS)[0].to(points.device)


def regular_coefficients(pressure: torch.Tensor, wavenumber: complex, degree: int) -> torch.Tensor:
    """Return the coefficients (..., N) of regular waves up to a degree from pressures at nodes (..., S).

    The nodes take degrees of 11 and more for others: an error of 4e-7 in degree 5, far less in lower ones.
    """
    return pressure @ _to_waves(wavenumber, degree)


def derivatives(pressure: torch.Tensor, wavenumber: complex) -> Derivatives:
    """Return the derivatives at points from pressures (..., S) at the nodes around them."""
    flat = regular_coefficients(pressure, wavenumber, _THIRD) @ _to_derivatives(wavenumber)
    parts = torch.split(flat, _COUNTS, dim=-1)
    shape = flat.shape[:-1]
    return Derivatives(*(part.reshape(*shape, *[3] * order) for order, part in enumerate(parts)))


def field_derivatives(propagator: Propagator, drive: torch.Tensor, nodes: torch.Tensor) -> Derivatives:
    """Return the derivatives at P points under drives (..., M), by the field at the nodes (P, S, 3)."""
    pressure = propagator.field(drive, nodes.reshape(-1, 3)).reshape(*drive.shape[:-1], *nodes.shape[:2])
    return derivatives(pressure, propagator.scene.complex_wavenumber)


@cached_tensors(8)
def _to_waves(wavenumber: complex, degree: int) -> torch.Tensor:
    """Return the map (S, N) from pressures at nodes to coefficients of regular waves."""
    size = torch.tensor([[wavenumber * SIZE / wavenumber.real]], **COMPLEX)
    return to_harmonics(degree, _RINGS) / regular_radial(degree, size)


@cached_tensors(8)
def _to_derivatives(wavenumber: complex) -> torch.Tensor:
    """Return the map (N, 40) from coefficients of waves to p and its first, second and third derivatives."""
    each, columns = torch.eye((_THIRD + 1) ** 2, **COMPLEX), []
    for order in range(_THIRD + 1):
        at_center = (1j * wavenumber) ** order / math.sqrt(4 * math.pi) * each[..., 0, :]
        columns.append(at_center.reshape(-1, at_center.shape[-1]))
        each = linear_momentum(each)  # -i grad / k
    return torch.cat(columns).mT
