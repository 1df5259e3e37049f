"""How the error falls with the spacing: an estimate from two grids, and the spacing for a tolerance."""

from __future__ import annotations

import math

import torch

from autdtorch.fdtd.grid import FAIR_CELLS_PER_WAVELENGTH
from autdtorch.fdtd.region import Region

RATIO = 1.5
"""Between the spacings of the two grids: the coarser costs a fifth of the finer."""

ORDER = 4 / 3
"""Order of convergence that estimates assume: that of the field at sharp edges (a rigid wedge's, r^(2/3),
squared). Curved surfaces converge with order two, and their error is then overestimated by three quarters."""

_PILOT_CELLS = 6.0
"""Cells per wavelength of the finer of the two grids that a spacing is chosen from."""


def coarsest_spacing(region: Region) -> float:
    """Largest spacing [m] with a fair number of cells per wavelength, in the air and in every obstacle."""
    return min(region.sound_speeds.values()) / region.frequency / FAIR_CELLS_PER_WAVELENGTH


def pilot_spacing(region: Region) -> float:
    """Spacing [m] of a coarse grid that tells what a scene takes: the finer of two that choose a spacing."""
    return min(region.wavelength / _PILOT_CELLS, coarsest_spacing(region))


def second_spacing(region: Region, spacing: float) -> float:
    """Spacing [m] of the grid that tells the error of another: coarser where that is fair, else finer."""
    coarser = RATIO * spacing
    return coarser if coarser <= coarsest_spacing(region) else spacing / RATIO


def grid_error(matrix: torch.Tensor, second: torch.Tensor, coarser: bool) -> float:
    """Estimated relative error (L2) of a matrix, from a second one on a grid `RATIO` coarser or finer."""
    difference = float((matrix - second).norm() / matrix.norm())
    gain: float = RATIO**ORDER
    return difference / (gain - 1) if coarser else difference * gain / (gain - 1)


def spacing_for(tolerance: float, error: float, spacing: float) -> float:
    """Return the spacing [m] at which the error should be `tolerance`, from that at another spacing."""
    return float(spacing * (tolerance / error) ** (1 / ORDER)) if error > 0 else math.inf
