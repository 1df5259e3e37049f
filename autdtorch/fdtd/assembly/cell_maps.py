"""A medium given cell by cell: rows from maps of density and sound speed, by autograd's own operations.

A bond between two cells has the mobility of both in series, 2 / (rho_i + rho_j), and a cell the mass
1 / (rho_i f_i), with density and the speed factor f those of `medium.py`. Where the maps are uniform the rows
are those of an obstacle of that material; surfaces are staircases, half-way between two cells.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from autdtorch.fdtd.assembly.differentiable import DifferentiableCells
from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells
from autdtorch.fdtd.grid import Grid, domain_extent
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.stencil import OFFSETS, Stencil
from autdtorch.fdtd.stepping import air_stencil

_RIM = 2
"""Cells of air around the maps: the first varies with them, the second is its neighbour."""


def domain_cells(region: Region, grid: Grid) -> tuple[slice, ...]:
    """Which cells of a grid of the region's domain are in the domain, per axis: those that maps are of."""
    margin = domain_extent(region, grid.spacing).margin
    return tuple(slice(a + margin, b - margin) for a, b in zip(grid.first, grid.last, strict=True))


def cells_of_maps(
    region: Region, grid: Grid, density: torch.Tensor | None = None, sound_speed: torch.Tensor | None = None
) -> DifferentiableCells:
    """Return heterogeneous cells of maps (nx, ny, nz) of density [kg/m^3] and sound speed [m/s].

    Raises:
        ValueError: a map has another shape than the domain has cells.
    """
    cells = domain_cells(region, grid)
    shape = tuple(part.stop - part.start for part in cells)
    for name, given in (("density", density), ("sound_speed", sound_speed)):
        if given is not None and given.shape != shape:
            raise ValueError(f"{name}: shape {tuple(given.shape)}; must be {shape}, the cells of the domain")
    stencil = air_stencil(grid, region)
    air = torch.ones(shape, dtype=torch.float64, device="cpu")
    relative = air if density is None else density / region.fluid.density
    speed = air if sound_speed is None else sound_speed / region.fluid.sound_speed
    relative = relative / _flow_factor(stencil, speed)
    fluidity = relative * _speed_factor(stencil, speed)
    return DifferentiableCells(*_rows(cells, grid, stencil, relative, fluidity))


def _flow_factor(stencil: Stencil, speed_ratio: torch.Tensor) -> torch.Tensor:
    """`medium.flow_factor`, cell by cell."""
    own = stencil.kappa / 2 / speed_ratio
    return math.tan(stencil.kappa / 2) / (stencil.kappa / 2) * own / torch.tan(own)


def _speed_factor(stencil: Stencil, speed_ratio: torch.Tensor) -> torch.Tensor:
    """`medium.speed_factor`, cell by cell: over all directions cos(k . n) has the mean sin(|k n|) / |k n|."""
    wave = complex(stencil.kappa, stencil.eta) / speed_ratio
    symbol = torch.zeros_like(speed_ratio)
    for count, weight, length in (
        (6, stencil.face, 1.0), (12, stencil.edge, math.sqrt(2)), (8, stencil.corner, math.sqrt(3))
    ):  # fmt: skip
        symbol = symbol + count * weight * (1 - torch.sin(length * wave) / (length * wave)).real
    return stencil.symbol / symbol


def _rows(
    cells: tuple[slice, ...], grid: Grid, stencil: Stencil, density: torch.Tensor, fluidity: torch.Tensor
) -> tuple[HeterogeneousCells, torch.Tensor, torch.Tensor]:
    """Rows and mass of the mapped cells and of those around them; `fluidity` is one over the mass."""
    density, fluidity = (
        torch.nn.functional.pad(part, (_RIM,) * 6, value=1.0) for part in (density, fluidity)
    )
    own = (slice(1, -1),) * 3
    weight = torch.stack(
        [
            2 * bond * fluidity[own] / (density[own] + density[_shifted(offset)])
            for bond, offset in zip(stencil.weights, OFFSETS, strict=True)
        ],
        dim=-1,
    ).reshape(-1, 27)
    mass = (1 / fluidity[own]).reshape(-1)
    axes = [np.arange(part.start - 1, part.stop + 1) for part in cells]
    index = np.ravel_multi_index(np.meshgrid(*axes, indexing="ij"), grid.shape).ravel()
    nothing = np.zeros(0, np.int64)
    values = weight.detach().numpy(), mass.detach().numpy()
    return HeterogeneousCells(index, *values, nothing, nothing), weight, mass


def _shifted(offset: tuple[int, int, int]) -> tuple[slice, ...]:
    """The neighbours at an offset, of all cells but those on the rim."""
    return tuple(slice(1 + step, step - 1 or None) for step in offset)
