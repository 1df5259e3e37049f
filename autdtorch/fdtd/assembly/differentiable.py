"""Heterogeneous cells that autograd can go back through: to the materials of obstacles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells, heterogeneous_cells
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.kernels.contract import Sources
from autdtorch.fdtd.region import Fluid, Region
from autdtorch.fdtd.stencil import Stencil
from autdtorch.fdtd.stepping import Assembly, air_stencil, assembly_of
from autdtorch.utils.arrays import Array, Index
from autdtorch.utils.validation import fluid

_SMALL = 1e-4
"""Relative step of the central differences: what they miss and the rounding in them are about 1e-8."""


@dataclass(frozen=True)
class DifferentiableCells:
    """Heterogeneous cells, and what of them is differentiable.

    Attributes:
        heterogeneous: the cells.
        weight: their weights (n, 27), differentiable.
        mass: their mass (n,), differentiable.
    """

    heterogeneous: HeterogeneousCells
    weight: torch.Tensor
    mass: torch.Tensor

    def assembly(self, grid: Grid, region: Region, dtype: torch.dtype, time_step: float | None) -> Assembly:
        """Ready to step, differentiable by `coefficients.heterogeneous_weight`; see `assemble_on`."""
        stencil = air_stencil(grid, region)
        assembly = assembly_of(grid, stencil, self.heterogeneous, region.frequency, dtype, time_step)
        coefficients = assembly.coefficients
        weight = (coefficients.face / stencil.face * self.weight).to(dtype)
        return replace(assembly, coefficients=replace(coefficients, heterogeneous_weight=weight))

    def driven(self, sources: Sources) -> Sources:
        """Sources of the assembly, differentiable also by the mass of the cells they are in."""
        _, place, own = np.intersect1d(self.heterogeneous.index, sources.index.numpy(), return_indices=True)
        share = torch.ones(len(sources.index), dtype=self.mass.dtype, device="cpu")
        share[own] = torch.from_numpy(self.heterogeneous.mass[place]) / self.mass[place]
        return Sources(sources.index, share.to(sources.force)[:, None] * sources.force)


@dataclass(frozen=True)
class _Difference:
    """The cells for a number (a tensor of no axes) a little larger and smaller, 2 `step` apart."""

    number: torch.Tensor
    step: float
    ahead: HeterogeneousCells
    behind: HeterogeneousCells


def with_materials(region: Region, density: torch.Tensor | None, sound_speed: torch.Tensor | None) -> Region:
    """Return a region whose K bodies have the densities (K,) and sound speeds (K,) given.

    Sound-hard bodies stay sound-hard.

    Raises:
        ValueError: a density or a sound speed is out of range.
    """
    bodies = list(region.bodies)
    for number, body in enumerate(bodies):
        if body.fluid is not None:
            rho, speed = (
                own if given is None else float(given[number])
                for own, given in zip(body.fluid, (density, sound_speed), strict=True)
            )
            bodies[number] = replace(body, fluid=Fluid(*fluid(f"obstacles[{number}]", rho, speed)))
    return replace(region, bodies=tuple(bodies))


def cells_of_obstacles(
    region: Region, grid: Grid, density: torch.Tensor | None = None, sound_speed: torch.Tensor | None = None
) -> DifferentiableCells:
    """Heterogeneous cells of a region's K bodies, differentiable by their materials.

    The derivatives are central differences of the whole assembly, one for each number of a tensor that asks
    for gradients.

    Args:
        region: gives everything else.
        grid: on which.
        density: (K,) [kg/m^3]; what is given for rigid obstacles does not count.
        sound_speed: (K,) [m/s], likewise.

    Raises:
        ValueError: an obstacle that is differentiated reaches into the boundary layers.
    """
    stencil = air_stencil(grid, region)
    fixed = [None if given is None else given.detach() for given in (density, sound_speed)]
    base = _assembled(region, grid, stencil, *fixed)
    differences = list(_differences(region, grid, stencil, density, sound_speed))
    every = [base.index, *(each.index for one in differences for each in (one.ahead, one.behind))]
    index = np.unique(np.concatenate(every))
    weight, mass = (torch.from_numpy(part) for part in _on(index, base, stencil))
    heterogeneous = HeterogeneousCells(index, weight.numpy(), mass.numpy(), base.sound_hard, base.shell)
    for one in differences:
        ahead, behind = _on(index, one.ahead, stencil), _on(index, one.behind, stencil)
        rows, masses = ((more - less) / (2 * one.step) for more, less in zip(ahead, behind, strict=True))
        changed = np.flatnonzero(rows.any(axis=1) | (masses != 0))
        if not grid.inside(index[changed]).all():
            raise ValueError(
                "density, sound_speed: an obstacle that is differentiated reaches into the boundary layers; "
                "must end inside the domain"
            )
        places, shift = torch.from_numpy(changed), one.number - one.number.detach()
        weight = weight.index_add(0, places, shift * torch.from_numpy(rows[changed]))
        mass = mass.index_add(0, places, shift * torch.from_numpy(masses[changed]))
    return DifferentiableCells(heterogeneous, weight, mass)


def _differences(
    region: Region,
    grid: Grid,
    stencil: Stencil,
    density: torch.Tensor | None,
    sound_speed: torch.Tensor | None,
) -> Iterator[_Difference]:
    given = {"density": density, "sound_speed": sound_speed}
    fixed = {name: None if each is None else each.detach() for name, each in given.items()}
    for name, values in given.items():
        if values is None or not values.requires_grad:
            continue
        for number, body in enumerate(region.bodies):
            if body.fluid is None:
                continue
            step = _SMALL * float(values.detach()[number])
            sides = []
            for way in (1, -1):
                moved = values.detach().clone()
                moved[number] += way * step
                sides.append(_assembled(region, grid, stencil, **(fixed | {name: moved})))
            yield _Difference(values[number], step, *sides)


def _assembled(
    region: Region,
    grid: Grid,
    stencil: Stencil,
    density: torch.Tensor | None,
    sound_speed: torch.Tensor | None,
) -> HeterogeneousCells:
    changed = with_materials(region, density, sound_speed)
    return heterogeneous_cells(elements_of(changed, grid, stencil), stencil)


def _on(index: Index, cells: HeterogeneousCells, stencil: Stencil) -> tuple[Array, Array]:
    """Rows (n, 27) and mass (n,) of `index` (n,), which holds all of `cells` and besides them air."""
    weight, mass = np.tile(stencil.weights, (len(index), 1)), np.ones(len(index))
    place = np.searchsorted(index, cells.index)
    weight[place], mass[place] = cells.weight, cells.mass
    return weight, mass
