"""Point sources as superpositions of plane and evanescent waves: the Sommerfeld integral."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.integrate import cumulative_trapezoid
from scipy.special import hankel1, jv

from autdtorch.analytic.layers import vertical_wavenumber
from autdtorch.utils.array_types import ComplexArray

Spectrum = Callable[[ComplexArray], ComplexArray]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
# A panel of 32 Gauss nodes has errors below 1e-13 up to these limits.
_PANEL_PHASE = 20.0  # [rad] along it
_PANEL_LENGTH = 3.0  # times the distance to the nearest singularity
_DIP = 4.0
"""Depth of the contour below the axis times the offset; J_0 grows to e^4 there, at a loss of two digits."""
_DIAGONAL_LEGS = 6
"""Legs of the diagonal; the first leaves out 8^-6 = 4e-6 of the dip, with an error of its square."""
_TAIL = 40.0  # exponent of decay at the end of a tail: e^-40 = 4e-18


def sommerfeld_integral(
    spectrum: Spectrum, wavenumbers: tuple[float, float], offset: float, height: float, reverberation: float
) -> complex:
    """Return i / 4 pi times the integral of F(kappa) J_0(kappa offset) kappa / gamma, kappa = 0 to infinity.

    F = e^{i gamma height} gives `green` (Brekhovskikh & Godin, Acoustics of Layered Media II, 1992, chapter
    1). Branch points and poles of guided waves lie on the real axis and poles of leaky waves above it, so the
    contour passes below all of them. Beyond the last one, both halves of J_0 follow their paths of
    steepest descent, where they do not oscillate.

    Args:
        spectrum: F; it must decay like e^{-kappa height} and be real for real kappa beyond both wavenumbers.
            Singularities must lie between 0 and the larger wavenumber, on or above the axis.
        wavenumbers: k in gamma = sqrt(k^2 - kappa^2), and the wavenumber in the layer [rad/m].
        offset: horizontal distance [m], >= 0.
        height: vertical distance [m], >= 0; not zero together with `offset`.
        reverberation: length of the path back and forth in a layer [m], which makes F oscillate faster.
    """
    wavenumber = wavenumbers[0]

    def integrand(kappa: ComplexArray) -> ComplexArray:
        return spectrum(kappa) * kappa / vertical_wavenumber(wavenumber, kappa)

    end = 1.5 * max(wavenumbers)
    kappa, weights = _contour(wavenumbers, end, offset, height + reverberation)
    total = np.sum(weights * integrand(kappa) * jv(0, kappa * offset))
    return complex(0.25j / np.pi * (total + _tail(integrand, end, offset, height)))


def _contour(
    wavenumbers: tuple[float, float], end: float, offset: float, vertical: float
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
    start: complex, stop: complex, wavenumbers: tuple[float, float], offset: float, vertical: float
) -> npt.NDArray[np.float64]:
    """Return the edges of panels, as fractions of a leg, for the limits of phase and length."""
    length, singular = abs(stop - start), max(wavenumbers)
    nearest = max(min(-start.imag, -stop.imag), min(start.real, stop.real) - singular)
    along = np.linspace(0, 1, 2 + int(8 * length / nearest))
    kappa = (start + (stop - start) * along).astype(np.complex128)
    clearance = np.maximum(-kappa.imag, kappa.real - singular)
    outer, inner = (np.abs(kappa / vertical_wavenumber(wavenumber, kappa)) for wavenumber in wavenumbers)
    density = 1 / (_PANEL_LENGTH * clearance) + (offset + vertical * (outer + inner)) / _PANEL_PHASE
    panels = length * cumulative_trapezoid(density, along, initial=0)
    return np.interp(np.linspace(0, panels[-1], 1 + int(np.ceil(panels[-1]))), panels, along)


def _tail(integrand: Spectrum, start: float, offset: float, height: float) -> complex:
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
    # 2 J_0 = H^(1) + H^(2), and here integrand(conj kappa) = -conj integrand(kappa): the integral of H^(2) on
    # the mirrored path is minus the conjugate of the integral of H^(1).
    return complex(1j * upper.imag)


def _gauss(edges: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return nodes and weights of Gauss quadrature on each interval between `edges`."""
    half = np.diff(edges)[:, None] / 2
    middle = (edges[1:] + edges[:-1])[:, None] / 2
    return (middle + half * _NODES).ravel(), (half * _WEIGHTS).ravel()
