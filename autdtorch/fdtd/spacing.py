"""Convergence with the spacing: an error estimate from two grids, and the spacing for a tolerance."""

from __future__ import annotations

import math

import torch

from autdtorch.fdtd.grid import FAIR_CELLS_PER_WAVELENGTH
from autdtorch.fdtd.region import Region

RATIO = 1.5  # Ratio of the spacings of the two grids: the coarser costs a fifth of the finer
# Assumed order of convergence: twice the exponent 2/3 of the field at a rigid wedge. Curved surfaces converge
# with order two; their error is overestimated by three quarters.
ORDER = 4 / 3
_PILOT_CELLS = 6.0  # Cells per wavelength of the finer of two grids that a spacing is chosen from


def coarsest_spacing(region: Region) -> float:
    """Return the largest spacing [m] with a fair number of cells per wavelength everywhere."""
    return min(region.sound_speeds.values()) / region.frequency / FAIR_CELLS_PER_WAVELENGTH


def pilot_spacing(region: Region) -> float:
    """Return the spacing [m] of the finer of two coarse grids that a spacing is chosen from."""
    return min(region.wavelength / _PILOT_CELLS, coarsest_spacing(region))


def second_spacing(region: Region, spacing: float) -> float:
    """Return the spacing [m] of the second grid of an error estimate: coarser where fair, else finer."""
    coarser = RATIO * spacing
    return coarser if coarser <= coarsest_spacing(region) else spacing / RATIO


def grid_error(matrix: torch.Tensor, second: torch.Tensor, coarser: bool) -> float:
    """Return the estimated relative error (L2) of a matrix, given one on a grid `RATIO` coarser or finer."""
    difference = float((matrix - second).norm() / matrix.norm())
    gain: float = RATIO**ORDER
    return difference / (gain - 1) if coarser else difference * gain / (gain - 1)


def spacing_for(tolerance: float, error: float, spacing: float) -> float:
    """Return the spacing [m] for an error of `tolerance`, given the error at another spacing."""
    return float(spacing * (tolerance / error) ** (1 / ORDER)) if error > 0 else math.inf
