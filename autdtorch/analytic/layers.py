"""Plane waves at a fluid half-space and at a fluid slab."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.utils.array_types import ComplexArray
from autdtorch.utils.validation import ArrayLike, invalid, positive, real_tensor


@dataclass(frozen=True)
class Layering:
    """A fluid behind a plane front face, a half-space or a slab in a medium, and its response to plane waves.

    Responses are pressures over the incident pressure at the front face, for horizontal wavenumbers kappa
    [rad/m]. They also hold for complex kappa, on the sheet that `vertical_wavenumber` defines. The transfer
    matrix of a slab is multiplied by e^{i gamma_1 d}, so that decaying waves do not overflow. It is written
    with sin(gamma_1 x) / gamma_1, so that gamma_1 = 0 is an ordinary case.

    Source: Brekhovskikh & Godin, Acoustics of Layered Media I (1990), section 2.2 and chapter 2.

    Attributes:
        wavenumber: k of the medium in front [rad/m], > 0.
        density_ratio: rho_1 / rho of the fluid and the medium, > 0.
        speed_ratio: c_1 / c of the fluid and the medium, > 0.
        thickness: d of a slab [m], > 0; None for a half-space.
    """

    wavenumber: float
    density_ratio: float
    speed_ratio: float
    thickness: float | None = None

    def __post_init__(self) -> None:
        """Check the attributes and make them floats."""
        object.__setattr__(self, "wavenumber", positive("wavenumber", self.wavenumber, "rad/m"))
        object.__setattr__(self, "density_ratio", positive("density_ratio", self.density_ratio))
        object.__setattr__(self, "speed_ratio", positive("speed_ratio", self.speed_ratio))

    @property
    def inner_wavenumber(self) -> float:
        """Wavenumber in the fluid [rad/m]."""
        return self.wavenumber / self.speed_ratio

    @property
    def depth(self) -> float:
        """Distance over which waves are reflected back and forth behind the front face [m]."""
        return self.thickness or 0.0

    def reflected(self, kappa: ComplexArray) -> ComplexArray:
        """Return the reflected pressure at the front face."""
        outer, inner, denominator = self._terms(kappa)
        if self.thickness is None:
            return (outer - inner) / denominator
        _, sine = _scaled_cosine_and_sine(inner, self.thickness)
        return -1j * (outer**2 - inner**2) * sine / denominator

    def transmitted(self, kappa: ComplexArray, depth: float) -> ComplexArray:
        """Return the total pressure at `depth` [m] >= 0 behind the front face, in the fluid or beyond it."""
        outer, inner, denominator = self._terms(kappa)
        if self.thickness is None:
            return 2 * outer / denominator * np.exp(1j * inner * depth)
        inside = min(depth, self.thickness)
        # At the back face, p and its slope over the density are those of the transmitted wave.
        cosine, sine = _scaled_cosine_and_sine(inner, self.thickness - inside)
        pressure = 2 * outer * (cosine - 1j * outer * sine) / denominator * np.exp(1j * inner * inside)
        return pressure * np.exp(1j * outer / self.density_ratio * (depth - inside))

    def _terms(self, kappa: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return the vertical wavenumbers outside, times the density ratio, and inside, and a denominator."""
        outer = self.density_ratio * vertical_wavenumber(self.wavenumber, kappa)
        inner = vertical_wavenumber(self.inner_wavenumber, kappa)
        if self.thickness is None:
            return outer, inner, outer + inner
        cosine, sine = _scaled_cosine_and_sine(inner, self.thickness)
        return outer, inner, 2 * outer * cosine - 1j * (outer**2 + inner**2) * sine


def vertical_wavenumber(wavenumber: float, kappa: ComplexArray) -> ComplexArray:
    """Return the root gamma of k^2 - kappa^2 with the branch cut from kappa = k upwards.

    For real kappa >= 0 the wave travels or decays away from its source. The root is analytic in the fourth
    quadrant, and in the first to the right of k, where contours of integration run.
    """
    below: ComplexArray = np.sqrt(-1j * (wavenumber - kappa)) * np.exp(0.25j * np.pi)
    return below * np.sqrt(wavenumber + kappa)


def step_coefficients(
    angle: ArrayLike, density_ratio: float, speed_ratio: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the reflection and transmission coefficients of a plane wave at a fluid half-space.

    Beyond the critical angle the transmitted wave decays, and |R| = 1.

    Args:
        angle: of incidence, any shape [rad], in [0, pi/2).
        density_ratio: rho_1 / rho > 0.
        speed_ratio: c_1 / c > 0.

    Returns:
        R and T, complex128 in the shape of `angle`: reflected and transmitted pressure at the faces over the
        incident pressure at the front face.

    Raises:
        ValueError: an argument out of the range given above.

    Source: Brekhovskikh & Godin, Acoustics of Layered Media I (1990), section 2.2; Pierce, Acoustics,
        section 3-6.
    """
    return _coefficients(angle, Layering(1.0, density_ratio, speed_ratio))


def slab_coefficients(
    angle: ArrayLike, wavenumber: float, thickness: float, density_ratio: float, speed_ratio: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the reflection and transmission coefficients of a plane wave at a fluid slab in a medium.

    Arguments, returns and errors as for `step_coefficients`, with `wavenumber` k of the medium [rad/m], > 0,
    and `thickness` [m], > 0.

    Source: Brekhovskikh & Godin, Acoustics of Layered Media I (1990), chapter 2; Pierce, Acoustics,
        section 3-7.
    """
    thickness = positive("thickness", thickness, "m")
    return _coefficients(angle, Layering(wavenumber, density_ratio, speed_ratio, thickness))


def _coefficients(angle: ArrayLike, layering: Layering) -> tuple[torch.Tensor, torch.Tensor]:
    angles = real_tensor("angle", angle, "rad").detach()
    if ((angles < 0) | (angles >= math.pi / 2)).any():
        raise invalid("angle", angles, "every entry must be in [0, pi/2)", "rad")
    kappa = layering.wavenumber * np.sin(angles.cpu().numpy()).astype(np.complex128)
    reflected = torch.from_numpy(np.asarray(layering.reflected(kappa)))
    transmitted = torch.from_numpy(np.asarray(layering.transmitted(kappa, layering.depth)))
    return reflected.to(angles.device), transmitted.to(angles.device)


def _scaled_cosine_and_sine(inner: ComplexArray, length: float) -> tuple[ComplexArray, ComplexArray]:
    """Return cos(inner length) and sin(inner length) / inner, both times e^{i inner length}."""
    phase = 2j * length * inner
    # expm1(z) / z is 1 at z = 0.
    safe = np.where(phase == 0, 1, phase)
    sine = length * np.where(phase == 0, 1, np.expm1(safe) / safe)
    return np.asarray((1 + np.exp(phase)) / 2, np.complex128), np.asarray(sine, np.complex128)
