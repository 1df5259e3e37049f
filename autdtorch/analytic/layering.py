"""Fluid half-spaces and slabs: their response to plane waves and, as an integral of these, to sources."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from scipy.special import hankel1, hankel2, jv

from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.fluids import fluid_ratios
from autdtorch.utils.units import real_wavenumber
from autdtorch.utils.validation import ArrayLike, invalid, positive, real_tensor

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
# A panel of 32 Gauss nodes has errors below 1e-13 up to these limits.
_PANEL_PHASE = 20.0  # [rad] along it
_PANEL_LENGTH = 3.0  # times the distance to the nearest singularity
# Depth of the contour below the axis times the offset; J_0 grows to e^4 there, at a loss of two digits
_DIP = 4.0
# Legs of the diagonal; the first leaves out 8^-6 = 4e-6 of the dip, with an error of its square
_DIAGONAL_LEGS = 6
_TAIL = 40.0  # exponent of decay at the end of a tail: e^-40 = 4e-18


@dataclass(frozen=True)
class Layering:
    """A fluid behind a plane front face, a half-space or a slab in a medium, and its response to plane waves.

    Responses are pressures over the incident pressure at the front face, for horizontal wavenumbers kappa
    [rad/m]. They also hold for complex kappa, on the sheet that `vertical_wavenumber` defines. The transfer
    matrix of a slab is multiplied by e^{i gamma_1 d}, so that decaying waves do not overflow. It contains
    sin(gamma_1 x) / gamma_1, so that gamma_1 = 0 needs no special case.

    Source: Brekhovskikh & Godin, Acoustics of Layered Media I (1990), section 2.2 and chapter 2.
    """

    wavenumber: float  # k of the medium in front [rad/m]
    density_ratio: complex  # rho_1 / rho of the fluid and the medium
    speed_ratio: complex  # c_1 / c of the fluid and the medium
    thickness: float | None = None  # d of a slab [m], None for a half-space

    def __post_init__(self) -> None:
        object.__setattr__(self, "wavenumber", real_wavenumber(self.wavenumber))
        density, speed = fluid_ratios(self.density_ratio, self.speed_ratio)
        object.__setattr__(self, "density_ratio", density)
        object.__setattr__(self, "speed_ratio", speed)

    @property
    def inner_wavenumber(self) -> complex:
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


def vertical_wavenumber(wavenumber: complex, kappa: ComplexArray) -> ComplexArray:
    """Return the root gamma of k^2 - kappa^2 with the branch cut from kappa = k upwards.

    For real kappa >= 0 the wave travels or decays away from its source. The root is analytic in the fourth
    quadrant, and in the first to the right of k, where contours of integration run.
    """
    below: ComplexArray = np.sqrt(-1j * (wavenumber - kappa)) * np.exp(0.25j * np.pi)
    return below * np.sqrt(wavenumber + kappa)


def step_coefficients(
    angle: ArrayLike, density_ratio: complex, speed_ratio: complex
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the reflection and transmission coefficients of a plane wave at a fluid half-space.

    Beyond the critical angle the transmitted wave decays, and |R| = 1.

    Args:
        angle: of incidence, any shape [rad], in [0, pi/2).
        density_ratio: rho_1 / rho > 0, complex in a fluid that absorbs.
        speed_ratio: c_1 / c > 0, complex in a fluid that absorbs.

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
    angle: ArrayLike, wavenumber: float, thickness: float, density_ratio: complex, speed_ratio: complex
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


def source_response(layering: Layering, offset: float, height: float, source_height: float) -> complex:
    """Return the field at a horizontal `offset` and a `height` [m] of a point source at `source_height` [m].

    It is the reflected wave for `height` >= 0, else the total field: i / 4 pi times the integral of
    F(kappa) J_0(kappa offset) kappa / gamma from kappa = 0 to infinity (Brekhovskikh & Godin, Acoustics of
    Layered Media II, 1992, chapter 1). F = e^{i gamma height} gives `green`. Singularities of F lie between
    0 and the larger wavenumber: branch points and poles of guided waves on the real axis, poles of leaky
    waves above it, and all above it in a fluid that absorbs. The contour passes below all of them. Beyond,
    where F decays like e^{-kappa height}, both halves of J_0 follow their paths of steepest descent. Without
    absorption F is real there for real kappa.
    """
    wavenumbers = layering.wavenumber, layering.inner_wavenumber
    vertical, end = source_height + abs(height), 1.5 * max(map(abs, wavenumbers))

    def integrand(kappa: ComplexArray) -> ComplexArray:
        gamma = vertical_wavenumber(layering.wavenumber, kappa)
        if height >= 0:
            spectrum = layering.reflected(kappa) * np.exp(1j * gamma * vertical)
        else:
            spectrum = layering.transmitted(kappa, -height) * np.exp(1j * gamma * source_height)
        return spectrum * kappa / gamma

    kappa, weights = _contour(wavenumbers, end, offset, vertical + 2 * layering.depth)
    total = np.sum(weights * integrand(kappa) * jv(0, kappa * offset))
    is_real = not isinstance(layering.density_ratio * layering.speed_ratio, complex)
    return complex(0.25j / np.pi * (total + _tail(integrand, end, offset, vertical, is_real)))


def _contour(
    wavenumbers: tuple[float, complex], end: float, offset: float, vertical: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return nodes and weights along 0, dip - i dip, end - i dip, end.

    The first part is diagonal, because evanescent leaky waves have poles to the left of the negative
    imaginary axis. Its legs grow eightfold, because waves near their cut-off have poles near 0.
    """
    dip = 0.5 * wavenumbers[0]
    if offset > 0:
        dip = min(dip, _DIP / offset)
    down = [dip * (1 - 1j) / 8**leg for leg in range(_DIAGONAL_LEGS, -1, -1)]
    nodes, weights = [], []
    for start, stop in pairwise([0j, *down, end - 1j * dip, complex(end)]):
        edges = _panel_edges(start, stop, wavenumbers, offset, vertical) if start else np.array([0.0, 1.0])
        fractions, fraction_weights = _gauss(edges)
        nodes.append(start + (stop - start) * fractions)
        weights.append((stop - start) * fraction_weights)
    return np.concatenate(nodes, dtype=np.complex128), np.concatenate(weights, dtype=np.complex128)


def _panel_edges(
    start: complex, stop: complex, wavenumbers: tuple[float, complex], offset: float, vertical: float
) -> Array:
    """Return the edges of panels, as fractions of a leg, for the limits of phase and length."""
    length, singular = abs(stop - start), max(abs(wavenumber) for wavenumber in wavenumbers)
    nearest = max(min(-start.imag, -stop.imag), min(start.real, stop.real) - singular)
    along = np.linspace(0, 1, 2 + int(8 * length / nearest))
    kappa = (start + (stop - start) * along).astype(np.complex128)
    clearance = np.maximum(-kappa.imag, kappa.real - singular)
    outer, inner = (np.abs(kappa / vertical_wavenumber(wavenumber, kappa)) for wavenumber in wavenumbers)
    density = 1 / (_PANEL_LENGTH * clearance) + (offset + vertical * (outer + inner)) / _PANEL_PHASE
    steps = length * np.diff(along) * (density[:-1] + density[1:]) / 2
    panels = np.concatenate([[0.0], np.cumsum(steps)])
    return np.interp(np.linspace(0, panels[-1], 1 + int(np.ceil(panels[-1]))), panels, along)


def _tail(
    integrand: Callable[[ComplexArray], ComplexArray],
    start: float,
    offset: float,
    height: float,
    is_real: bool,
) -> complex:
    distance = float(np.hypot(offset, height))
    length = _TAIL / distance
    edges = [0.0, min(start, length)]
    while edges[-1] < length:  # widths grow with the distance to the singularities
        edges.append(min(2 * edges[-1], length))
    along, weights = _gauss(np.array(edges))
    if offset <= height:
        kappa = (start + along).astype(np.complex128)
        return complex(np.sum(weights * integrand(kappa) * jv(0, kappa * offset)))
    direction = (height + 1j * offset) / distance
    kappa = (start + direction * along).astype(np.complex128)
    upper = np.sum(weights * direction * integrand(kappa) * hankel1(0, kappa * offset))
    # 2 J_0 = H^(1) + H^(2). Without absorption, integrand(conj kappa) = -conj integrand(kappa): the integral
    # of H^(2) on the mirrored path is minus the conjugate of the integral of H^(1).
    if is_real:
        return complex(1j * upper.imag)
    below = kappa.conj()
    lower = np.sum(weights * direction.conjugate() * integrand(below) * hankel2(0, below * offset))
    return complex((upper + lower) / 2)


def _gauss(edges: Array) -> tuple[Array, Array]:
    """Return nodes and weights of Gauss quadrature on each interval between `edges`."""
    half = np.diff(edges)[:, None] / 2
    middle = (edges[1:] + edges[:-1])[:, None] / 2
    return (middle + half * _NODES).ravel(), (half * _WEIGHTS).ravel()
