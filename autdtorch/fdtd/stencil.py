"""The 27-point stencil tuned to one frequency (nonstandard FDTD, Mickens 1994, Cole 2002).

A step in uniform air is p_new = 2 p - p_old + C sum_j g_j (p_j - p). The weights g have three values, for the
6 faces, the 12 edges and the 8 corners of the surrounding cube. These make the symbol

    L(kappa) = sum_j g_j (1 - cos(kappa . n_j)),        kappa = k h,

equal to (k h)^2 for long waves and independent of direction at the drive frequency. C makes the frequency of
that wave exact for the time step. Other frequencies are not tuned; the steady state does not contain them.

Where air absorbs, a term D (p_new - p_old) is added on the left. With attenuation eta per cell, a wave solves

    2 cos(w dt) - 2 i D sin(w dt) = 2 - C L(kappa + i eta):

the real part determines C, and the imaginary part D. D damps all waves; the bound on C is that without loss.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from autdtorch.utils.array_types import Array, Index

# The 27 neighbour offsets in row-major order; entry 13 is the cell itself
OFFSETS = tuple((x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1))
ROW_ROUNDING = 1e-9  # Stencil rows that differ by less are equal


def flat_strides(shape: Sequence[int]) -> NDArray[np.int64]:
    """Return the strides (3,) of flat indices of a grid."""
    return np.array((shape[1] * shape[2], shape[2], 1))


def flat_offsets(shape: Sequence[int]) -> NDArray[np.int64]:
    """Return the offsets (27,) of flat indices to the neighbours."""
    return np.asarray(np.array(OFFSETS) @ flat_strides(shape), np.int64)


def places_of(index: Index, shape: Sequence[int]) -> Index:
    """Return the cells (..., 3) of flat indices (...)."""
    return np.stack(np.unravel_index(index, tuple(shape)), axis=-1)


@dataclass(frozen=True)
class Stencil:
    """Spatial weights tuned at one wavenumber."""

    kappa: float  # wavenumber times spacing at which the stencil is tuned [rad]
    eta: float  # attenuation times spacing [Np]
    face: float  # weight of the 6 face neighbours
    edge: float  # weight of the 12 edge neighbours
    corner: float  # weight of the 8 corner neighbours
    symbol: float  # real part of the symbol at kappa + i eta, averaged over directions
    loss: float  # imaginary part of it
    slope: complex  # derivative of the symbol at kappa + i eta, averaged over directions

    @property
    def weights(self) -> Array:
        """Weights (27,) in the order of `OFFSETS`, zero for the cell itself."""
        by_distance = (0.0, self.face, self.edge, self.corner)
        return np.array([by_distance[sum(map(abs, offset))] for offset in OFFSETS])

    def differs_from(self, rows: Array) -> NDArray[np.bool_]:
        """Return which stencil rows (n, 27) are not those of air."""
        differs = np.abs(rows[:, 0] - self.corner) > ROW_ROUNDING  # at surfaces, nearly all
        rest = np.flatnonzero(~differs)
        differs[rest] = (np.abs(rows[rest] - self.weights) > ROW_ROUNDING).any(axis=1)
        return np.asarray(differs)

    @property
    def total(self) -> float:
        """Sum of the weights of all neighbours."""
        return 6 * self.face + 12 * self.edge + 8 * self.corner

    @property
    def largest_symbol(self) -> float:
        """Largest symbol of all waves: at a corner of the Brillouin zone, as it is affine in cosines."""
        corners = np.array([(x, y, z) for x in (0, np.pi) for y in (0, np.pi) for z in (0, np.pi)])
        return float((_basis(corners) @ (self.face, self.edge, self.corner)).max())

    def isotropic_symbol(self, kappa: float) -> float:
        """Return the mean real part of the symbol of another sound speed, at equal loss per wavelength."""
        return self.mean_symbol(kappa * complex(1, self.eta / self.kappa)).real

    def mean_symbol(self, kappa: complex) -> complex:
        """Return the symbol at a complex wavenumber times spacing, averaged over directions."""
        return _mean_symbol(kappa, (self.face, self.edge, self.corner))

    def time_factor(self, steps_per_period: float) -> float:
        """Return C, the factor on the weights for `steps_per_period` steps per period."""
        return 2 * (1 - math.cos(2 * math.pi / steps_per_period)) / self.symbol

    def damping(self, steps_per_period: float) -> float:
        """Return D, the loss of a step; zero where air does not absorb."""
        turn = 2 * math.pi / steps_per_period
        return self.time_factor(steps_per_period) * self.loss / (2 * math.sin(turn))

    def source_factor(self, steps_per_period: float) -> complex:
        """Return the force per step and unit S/h of a point source with the far field S e^{ikr}/r.

        The discrete Green's function is a Fourier integral over 1/(C L - 2 + 2 cos(w dt) - 2 i D sin(w dt)).
        Its far field follows from the slope of the symbol at the pole, in the continuum 2 (kappa + i eta).
        """
        factor = self.time_factor(steps_per_period) / (1 + self.damping(steps_per_period))
        return 4 * math.pi * factor * self.slope / (2 * complex(self.kappa, self.eta))


def _basis(kappa: NDArray[Any]) -> NDArray[Any]:
    """Return contributions (..., 3) of unit face, edge and corner weights to the symbol at kappa (..., 3)."""
    x, y, z = np.moveaxis(np.cos(kappa), -1, 0)
    face = 6 - 2 * (x + y + z)
    edge = 12 - 4 * (x * y + y * z + z * x)
    corner = 8 - 8 * x * y * z
    return np.stack((face, edge, corner), axis=-1)


def _directions() -> tuple[Array, Array]:
    """Return a Gauss product rule over one octant of the sphere; the others are symmetric."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    cosine, angle = (nodes + 1) / 2, (nodes + 1) * np.pi / 4
    sine = np.sqrt(1 - cosine**2)
    x, y = np.outer(sine, np.cos(angle)), np.outer(sine, np.sin(angle))
    directions = np.stack((x, y, np.repeat(cosine[:, None], 12, axis=1)), axis=-1)
    return directions.reshape(-1, 3), np.outer(weights, weights).reshape(-1)


_DIRECTIONS, _SOLID_ANGLES = _directions()


def _mean_symbol(wavenumber: complex, weights: tuple[float, ...]) -> complex:
    return complex(np.average(_basis(wavenumber * _DIRECTIONS) @ weights, weights=_SOLID_ANGLES))


@lru_cache(maxsize=64)
def tuned_stencil(kappa: float, eta: float = 0.0) -> Stencil:
    """Return the stencil whose symbol at `kappa` in (0, pi) varies least over directions (least squares)."""
    basis = _basis(kappa * _DIRECTIONS)
    scale = np.sqrt(_SOLID_ANGLES / _SOLID_ANGLES.sum())[:, None]
    # face = 1 - 4 edge - 4 corner keeps long waves exact; the other two flatten the symbol.
    free = basis[:, 1:] - 4 * basis[:, :1]
    mean = (scale**2 * np.concatenate((free, basis[:, :1]), axis=1)).sum(0)
    target = -scale[:, 0] * (basis[:, 0] - mean[2])
    solution, *_ = np.linalg.lstsq(scale * (free - mean[:2]), target, rcond=None)
    edge, corner = map(float, solution)
    weights = np.array((1 - 4 * edge - 4 * corner, edge, corner))

    wavenumber, step = kappa * complex(1, eta / kappa), 1e-4 * kappa
    symbol, ahead, behind = (_mean_symbol(wavenumber + shift, tuple(weights)) for shift in (0.0, step, -step))
    slope = (ahead - behind) / (2 * step)
    return Stencil(kappa, eta, float(weights[0]), edge, corner, symbol.real, symbol.imag, slope)
