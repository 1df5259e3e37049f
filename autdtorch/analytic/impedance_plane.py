"""Point sources in front of an infinite plane whose surface has an impedance and reacts locally."""

from __future__ import annotations

import cmath
import math

import numpy as np
import torch

from autdtorch.analytic.green import green
from autdtorch.utils.fluids import passive_impedance
from autdtorch.utils.units import real_wavenumber
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    boolean,
    finite_vector,
    invalid,
    points_tensor,
    unit_vector,
)

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_PANEL_PHASE = 6.0  # phase of a panel that 16 Gauss nodes integrate with errors below 1e-13 [rad]
_DECAY = 36.0  # nepers after which the line of images ends
_DIRECTION = math.radians(60)  # angle of 1 + b times the depth on the line of images
_LEAST = math.radians(5)  # angle of the line of images to both axes,
_OFF_BRANCH = 1e-6  # but to the imaginary one where weights would grow along it [rad]


def impedance_plane(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    origin: Vector,
    normal: Vector,
    impedance: complex,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources in front of a plane with an impedance: sources and lines of images.

    Arguments, returns and errors as for `rigid_plane`, with the `impedance` of the surface as a ratio to
    rho c of the medium: pressure over the velocity into it, with a real part >= 0. The error is about 1e-11
    of the direct wave, and 1e-7 where a surface without losses guides waves.

    The images of a source lie on a line from its mirror image, at the distance R, into complex depths s:

        e^{ikR} / R + 2 i k b int_0^inf e^{ikbs} e^{ik R(s)} / R(s) ds,    R(s)^2 = r^2 + (h + s)^2,

    with the admittance b = 1 / impedance, the distance r along the plane, and the sum h of both heights.

    Source: Thomasson (1976), J. Acoust. Soc. Am. 59, 780; Di & Gilbert (1993), J. Acoust. Soc. Am. 93, 714.
    """
    targets = points_tensor("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    wavenumber, scattered = real_wavenumber(wavenumber), boolean("scattered", scattered)
    admittance = 1 / passive_impedance("impedance", impedance)
    axis = targets.new_tensor(unit_vector("normal", normal))
    base = axis.new_tensor(finite_vector("origin", origin))
    heights = [(places - base) @ axis for places in (targets, origins)]
    for name, height in zip(("points", "sources"), heights, strict=True):
        if height.min() < -LENGTH_TOLERANCE:
            lowest = int(height.argmin())
            raise invalid(f"{name}[{lowest}]", float(height[lowest]), "must be in front of the plane", "m")
    images = origins - 2 * heights[1][:, None] * axis
    apart = (heights[0][:, None] + heights[1]).clamp(min=0)
    between = targets[:, None] - images
    offsets = (between - (between @ axis)[..., None] * axis).norm(dim=-1)
    image = green(targets, images, wavenumber)
    lines = [
        [_line(wavenumber, admittance, offset, height) for offset, height in zip(row, above, strict=True)]
        for row, above in zip(offsets.tolist(), apart.tolist(), strict=True)
    ]
    line = torch.tensor(lines, dtype=torch.complex128, device=targets.device)
    reflected = image + 0.5j / math.pi * wavenumber * admittance * line
    return reflected if scattered else reflected + green(targets, origins, wavenumber)


def _line(wavenumber: float, admittance: complex, offset: float, height: float) -> complex:
    """Return the integral over the images of a source, at a distance along the plane and a sum of heights.

    They decay as e^{ik (b + 1) s} far along the line, and at least as their weights e^{ikbs} everywhere. The
    direction of the line keeps off the branch point of R(s).
    """
    turn = cmath.phase(1 + admittance)
    direction = min(max(_DIRECTION - turn, _LEAST), math.pi / 2 - _LEAST)
    # On surfaces with guided waves, weights grow along the line unless it is steep.
    direction = max(direction, min(cmath.phase(admittance.conjugate()), math.pi / 2 - _OFF_BRANCH))
    along = cmath.rect(1.0, direction)
    weights_end = _DECAY / wavenumber / max((admittance * along).imag, 1e-9)
    length = min(2 * offset + _DECAY / wavenumber / ((1 + admittance) * along).imag, weights_end)
    edges = [0.0]
    while edges[-1] < length:  # panels are shorter than half the way to the branch point, and than some waves
        depth = height + edges[-1] * along
        slope = abs(depth) / max(abs(cmath.sqrt(offset**2 + depth**2)), _OFF_BRANCH * offset)
        rate = abs(admittance) + max(1.0, slope)
        edges.append(edges[-1] + min(abs(depth - 1j * offset) / 2, _PANEL_PHASE / (wavenumber * rate)))
    half = np.diff(edges)[:, None] / 2
    depths = np.complex128(along) * (np.array(edges[:-1])[:, None] + half * (1 + _NODES))
    distance = np.sqrt(offset**2 + (height + depths) ** 2)
    terms = np.exp(1j * wavenumber * (admittance * depths + distance)) / distance
    return complex(along * np.sum(half * _WEIGHTS * terms))
