"""Plane waves at a fluid half-space and at a fluid slab."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from autdtorch.utils.arrays import ComplexArray
from autdtorch.utils.validation import ArrayLike, invalid, positive, real_tensor


class Layering(Protocol):
    """What lies behind a plane front face, seen by plane waves of horizontal wavenumber kappa [rad/m].

    Responses are pressures per unit incident pressure at the front face. They hold for complex kappa too, on
    the sheet that `vertical_wavenumber` defines.
    """

    @property
    def wavenumber(self) -> float:
        """Of the medium in front [rad/m]."""

    @property
    def inner_wavenumber(self) -> float:
        """Of the fluid behind the front face [rad/m]."""

    @property
    def thickness(self) -> float:
        """How far waves run to and fro behind the front face [m]."""

    def reflected(self, kappa: ComplexArray) -> ComplexArray:
        """The reflected pressure at the front face."""

    def transmitted(self, kappa: ComplexArray, depth: float) -> ComplexArray:
        """The total pressure at `depth` [m] >= 0 behind the front face."""


@dataclass(frozen=True)
class HalfSpace:
    """A fluid without end (Brekhovskikh & Godin, Acoustics of Layered Media I (1990), section 2.2)."""

    wavenumber: float
    density_ratio: float
    speed_ratio: float
    thickness: float = 0.0

    @property
    def inner_wavenumber(self) -> float:
        """Of the fluid behind the front face [rad/m]."""
        return self.wavenumber / self.speed_ratio

    def reflected(self, kappa: ComplexArray) -> ComplexArray:
        """The reflected pressure at the front face."""
        heavy = self.density_ratio * vertical_wavenumber(self.wavenumber, kappa)
        inner = vertical_wavenumber(self.inner_wavenumber, kappa)
        return (heavy - inner) / (heavy + inner)

    def transmitted(self, kappa: ComplexArray, depth: float) -> ComplexArray:
        """The total pressure at `depth` [m] >= 0 behind the front face."""
        heavy = self.density_ratio * vertical_wavenumber(self.wavenumber, kappa)
        inner = vertical_wavenumber(self.inner_wavenumber, kappa)
        return 2 * heavy / (heavy + inner) * np.exp(1j * inner * depth)


@dataclass(frozen=True)
class Slab:
    """A fluid layer with the medium on both sides (Brekhovskikh & Godin I, chapter 2).

    The transfer matrix of the layer, times e^{i gamma_1 d} so that nothing overflows where waves in it decay,
    and in terms of sin(gamma_1 x) / gamma_1 so that gamma_1 = 0 is an ordinary case.
    """

    wavenumber: float
    density_ratio: float
    speed_ratio: float
    thickness: float

    @property
    def inner_wavenumber(self) -> float:
        """Of the fluid in the slab [rad/m]."""
        return self.wavenumber / self.speed_ratio

    def reflected(self, kappa: ComplexArray) -> ComplexArray:
        """The reflected pressure at the front face."""
        heavy, inner, denominator = self._terms(kappa)
        _, sine = _scaled_cosine_and_sine(inner, self.thickness)
        return -1j * (heavy**2 - inner**2) * sine / denominator

    def transmitted(self, kappa: ComplexArray, depth: float) -> ComplexArray:
        """The total pressure at `depth` [m] >= 0 behind the front face, in the slab or beyond it."""
        heavy, inner, denominator = self._terms(kappa)
        inside = min(depth, self.thickness)
        # Seen from the back face, where p and its slope over the density are those of the transmitted wave.
        cosine, sine = _scaled_cosine_and_sine(inner, self.thickness - inside)
        pressure = 2 * heavy * (cosine - 1j * heavy * sine) / denominator * np.exp(1j * inner * inside)
        return pressure * np.exp(1j * heavy / self.density_ratio * (depth - inside))

    def _terms(self, kappa: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        heavy = self.density_ratio * vertical_wavenumber(self.wavenumber, kappa)
        inner = vertical_wavenumber(self.inner_wavenumber, kappa)
        cosine, sine = _scaled_cosine_and_sine(inner, self.thickness)
        return heavy, inner, 2 * heavy * cosine - 1j * (heavy**2 + inner**2) * sine


def vertical_wavenumber(wavenumber: float, kappa: ComplexArray) -> ComplexArray:
    """The root gamma of k^2 - kappa^2, cut from kappa = k upwards.

    For real kappa >= 0 it is that of waves which travel or decay away from their source. It is analytic in
    the fourth quadrant and in the first to the right of k, where contours of integration run.
    """
    below: ComplexArray = np.sqrt(-1j * (wavenumber - kappa)) * np.exp(0.25j * np.pi)
    return below * np.sqrt(wavenumber + kappa)


def step_coefficients(
    angle: ArrayLike, density_ratio: float, speed_ratio: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Pressure reflection and transmission coefficients of a plane wave at a fluid half-space.

    Beyond the critical angle the transmitted wave is the one that decays, and |R| = 1.

    Args:
        angle: of incidence, any shape [rad], in [0, pi/2).
        density_ratio: rho_1 / rho > 0.
        speed_ratio: c_1 / c > 0.

    Returns:
        R and T, complex128 in the shape of `angle`, reflected and transmitted pressure over incident pressure
        at the face.

    Raises:
        ValueError: an argument out of the range given above.

    Source: Brekhovskikh & Godin, Acoustics of Layered Media I (1990), section 2.2; Pierce, Acoustics,
        section 3-6.
    """
    return _coefficients(angle, half_space(1.0, density_ratio, speed_ratio))


def slab_coefficients(
    angle: ArrayLike, wavenumber: float, thickness: float, density_ratio: float, speed_ratio: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Pressure reflection and transmission coefficients of a plane wave at a fluid slab in a medium.

    Args:
        angle: of incidence, any shape [rad], in [0, pi/2).
        wavenumber: k of the medium [rad/m], > 0.
        thickness: [m], > 0.
        density_ratio: rho_1 / rho > 0.
        speed_ratio: c_1 / c > 0.

    Returns:
        R and T, complex128 in the shape of `angle`, the reflected pressure at the front face and the
        transmitted pressure at the back face, over the incident pressure at the front face.

    Raises:
        ValueError: an argument out of the range given above.

    Source: Brekhovskikh & Godin, Acoustics of Layered Media I (1990), chapter 2; Pierce, Acoustics,
        section 3-7.
    """
    return _coefficients(angle, slab(wavenumber, thickness, density_ratio, speed_ratio))


def half_space(wavenumber: float, density_ratio: float, speed_ratio: float) -> HalfSpace:
    """A checked `HalfSpace`."""
    return HalfSpace(
        positive("wavenumber", wavenumber, "rad/m"),
        positive("density_ratio", density_ratio),
        positive("speed_ratio", speed_ratio),
    )


def slab(wavenumber: float, thickness: float, density_ratio: float, speed_ratio: float) -> Slab:
    """A checked `Slab`."""
    return Slab(
        positive("wavenumber", wavenumber, "rad/m"),
        positive("density_ratio", density_ratio),
        positive("speed_ratio", speed_ratio),
        positive("thickness", thickness, "m"),
    )


def _coefficients(angle: ArrayLike, layering: Layering) -> tuple[torch.Tensor, torch.Tensor]:
    angles = real_tensor("angle", angle, "rad").detach()
    if ((angles < 0) | (angles >= math.pi / 2)).any():
        raise invalid("angle", angles, "every entry must be in [0, pi/2)", "rad")
    kappa = layering.wavenumber * np.sin(angles.cpu().numpy()).astype(np.complex128)
    reflected = torch.from_numpy(np.asarray(layering.reflected(kappa)))
    transmitted = torch.from_numpy(np.asarray(layering.transmitted(kappa, layering.thickness)))
    return reflected.to(angles.device), transmitted.to(angles.device)


def _scaled_cosine_and_sine(inner: ComplexArray, length: float) -> tuple[ComplexArray, ComplexArray]:
    """Cos(inner length) and sin(inner length) / inner, both times e^{i inner length}."""
    phase = 2j * length * inner
    # expm1(z) / z is 1 at z = 0.
    safe = np.where(phase == 0, 1, phase)
    sine = length * np.where(phase == 0, 1, np.expm1(safe) / safe)
    return np.asarray((1 + np.exp(phase)) / 2, np.complex128), np.asarray(sine, np.complex128)
