"""Heterogeneous cells that are differentiable by materials: of obstacles, or of maps of the domain.

For obstacles the derivatives are central differences of the whole assembly. Maps are differentiated by
autograd. On a map two cells are coupled by both densities in series, 2 / (rho_i + rho_j). The
mass of a cell is 1 / (rho_i f_i), with density and speed factor f as in `assembly/unions.py`. Uniform maps
give the stencil rows of an obstacle of that material. Surfaces are staircases half-way between two cells, for
which densities are scaled.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells, heterogeneous_cells
from autdtorch.fdtd.damping import SteppedCells, stepped_cells
from autdtorch.fdtd.grid import Grid, domain_extent
from autdtorch.fdtd.kernels.contract import Sources
from autdtorch.fdtd.region import Fluid, Region
from autdtorch.fdtd.stencil import OFFSETS, Stencil
from autdtorch.fdtd.stepping import Assembly, air_stencil, assembly_of
from autdtorch.utils.array_types import REAL, Array, Index
from autdtorch.utils.fluids import fluid

_STEP = 1e-4  # Relative step of the central differences: truncation and rounding are about 1e-8
_RIM = 2  # Cells of air around the maps: the first depends on them, the second is its neighbour


@dataclass(frozen=True)
class DifferentiableCells:
    """Heterogeneous cells and their differentiable properties."""

    heterogeneous: HeterogeneousCells
    weight: Tensor  # their stencil rows (n, 27), differentiable
    mass: Tensor  # their mass (n,), differentiable
    loss: Tensor  # losses of the lossy ones (l, 29), differentiable

    def assembly(self, grid: Grid, region: Region, dtype: torch.dtype, time_step: float | None) -> Assembly:
        """Return an assembly that is differentiable by its stencil rows; see `assembly_of`."""
        assembly = assembly_of(grid, region, self.heterogeneous, dtype, time_step)
        coefficients = assembly.coefficients
        cells = self._at_time_step(assembly)
        weight = (coefficients.face / assembly.stencil.face * cells.weight).to(dtype)
        rows = replace(
            coefficients,
            heterogeneous_weight=weight,
            loss_weight=cells.loss.to(dtype),
            loss_ground=cells.ground.to(dtype),
        )
        return replace(assembly, coefficients=rows)

    def _at_time_step(self, assembly: Assembly) -> SteppedCells:
        rows = self.weight, self.mass, torch.from_numpy(self.heterogeneous.lossy), self.loss
        return stepped_cells(*rows, assembly.stencil, float(assembly.steps_per_period))

    def driven(self, sources: Sources, assembly: Assembly) -> Sources:
        """Return the assembly's sources, differentiable also by the mass of the cells they are in."""
        index = self.heterogeneous.index
        _, place, driven = np.intersect1d(index, sources.index.numpy(), return_indices=True)
        share = torch.ones(len(sources.index), dtype=self.mass.dtype, device="cpu")
        mass = self._at_time_step(assembly).mass
        share[driven] = torch.from_numpy(assembly.heterogeneous.mass[place]) / mass[place]
        return Sources(sources.index, share.to(sources.force)[:, None] * sources.force)


def cells_of_obstacles(
    region: Region, grid: Grid, density: Tensor | None = None, sound_speed: Tensor | None = None
) -> DifferentiableCells:
    """Return the cells of K bodies, differentiable by density and sound speed (K,).

    Rigid bodies are not. Of a lossy fluid these are the real part of the density and the phase speed; the
    imaginary part of the density and the attenuation of its waves stay.
    """
    stencil = air_stencil(grid, region)
    materials = {"density": density, "sound_speed": sound_speed}
    base = _assembled(region, grid, stencil, materials)
    differences = list(_differences(region, grid, stencil, materials))
    every = [base.index, *(cells.index for _, _, sides in differences for cells in sides)]
    index = np.unique(np.concatenate(every))
    weight, mass, loss = (torch.from_numpy(part) for part in _on(index, base, stencil))
    lossy = loss.any(dim=1).numpy()
    for value, step, sides in differences:
        ahead, behind = (_on(index, side, stencil) for side in sides)
        rows, masses, losses = ((more - less) / (2 * step) for more, less in zip(ahead, behind, strict=True))
        lossy |= losses.any(axis=1)
        changed = np.flatnonzero(rows.any(axis=1) | (masses != 0) | losses.any(axis=1))
        if not grid.inside(index[changed]).all():
            reason = "an obstacle that is differentiated reaches into the absorbing layers"
            raise ValueError(f"density, sound_speed: {reason}; must end inside the domain")
        places, shift = torch.from_numpy(changed), value - value.detach()
        weight = weight.index_add(0, places, shift * torch.from_numpy(rows[changed]))
        mass = mass.index_add(0, places, shift * torch.from_numpy(masses[changed]))
        loss = loss.index_add(0, places, shift * torch.from_numpy(losses[changed]))
    loss = loss[torch.from_numpy(lossy)]
    rows, masses, losses = (each.detach().numpy() for each in (weight, mass, loss))
    place = np.flatnonzero(lossy)
    cells = replace(base, index=index, weight=rows, mass=masses, lossy=place, loss=losses)
    return DifferentiableCells(cells, weight, mass, loss)


def _differences(
    region: Region, grid: Grid, stencil: Stencil, materials: dict[str, Tensor | None]
) -> Iterator[tuple[Tensor, float, list[HeterogeneousCells]]]:
    """Yield each number that requires gradients, a step, and the cells for the number plus and minus it."""
    for name, values in materials.items():
        if values is None or not values.requires_grad:
            continue
        for number in (number for number, body in enumerate(region.bodies) if body.fluid is not None):
            here, sides = float(values.detach()[number]), []
            ends = here + _STEP * here, here - _STEP * here
            for end in ends:
                moved = values.detach().clone()
                moved[number] = end
                sides.append(_assembled(region, grid, stencil, materials | {name: moved}))
            yield values[number], (ends[0] - ends[1]) / 2, sides


def _assembled(
    region: Region, grid: Grid, stencil: Stencil, materials: dict[str, Tensor | None]
) -> HeterogeneousCells:
    """Assemble a region whose K bodies have other densities and sound speeds (K,)."""
    bodies = list(region.bodies)
    for number, body in enumerate(bodies):
        if body.fluid is not None and any(values is not None for values in materials.values()):
            usual = body.fluid
            parts = zip((usual.density.real, usual.phase_speed), materials.values(), strict=True)
            density, sound_speed = (part if each is None else each[number].item() for part, each in parts)
            density, sound_speed = fluid(f"obstacles[{number}]", density, sound_speed)
            changed_fluid = Fluid(density, sound_speed)
            if usual.is_lossy:
                slowness = complex(1 / sound_speed, (1 / usual.sound_speed).imag)
                changed_fluid = Fluid(complex(density, usual.density.imag), 1 / slowness)
            bodies[number] = replace(body, fluid=changed_fluid)
    changed = replace(region, bodies=tuple(bodies))
    return heterogeneous_cells(elements_of(changed, grid, stencil), stencil)


def _on(index: Index, cells: HeterogeneousCells, stencil: Stencil) -> tuple[Array, Array, Array]:
    """Return rows (n, 27), mass (n,) and losses (n, 29) at `index` (n,), air's rows beside `cells`."""
    weight, mass = np.tile(stencil.weights, (len(index), 1)), cells.mass_of(index)
    loss = np.zeros((len(index), 29))
    place = np.searchsorted(index, cells.index)
    weight[place], loss[place] = cells.weight, cells.loss_rows
    return weight, mass, loss


def domain_cells(region: Region, grid: Grid) -> tuple[slice, ...]:
    """Return the cells of the domain along each axis, the shape of maps."""
    return grid.deeper(domain_extent(region, grid.spacing).margin)


def cells_of_maps(
    region: Region, grid: Grid, density: Tensor | None = None, sound_speed: Tensor | None = None
) -> DifferentiableCells:
    """Return the heterogeneous cells of maps (nx, ny, nz) of density [kg/m^3] and sound speed [m/s]."""
    cells = domain_cells(region, grid)
    shape = tuple(part.stop - part.start for part in cells)
    for name, values in (("density", density), ("sound_speed", sound_speed)):
        if values is not None and values.shape != shape:
            raise ValueError(f"{name}: shape {tuple(values.shape)}; must be {shape}, the cells of the domain")
    stencil = air_stencil(grid, region)
    air = torch.ones(shape, **REAL)
    relative = air if density is None else density / region.fluid.density
    speed = air if sound_speed is None else sound_speed / region.fluid.sound_speed
    # the impedance of a face half-way between two cells is off by tan(k / 2) / (k / 2)
    outer, inner = stencil.kappa / 2, stencil.kappa / 2 / speed
    relative = relative / (math.tan(outer) / outer * inner / torch.tan(inner))
    fluidity = relative * _speed_factor(stencil, speed)
    weight, mass = _rows(stencil, relative, fluidity)
    axes = [np.arange(part.start - 1, part.stop + 1) for part in cells]
    index = np.ravel_multi_index(np.meshgrid(*axes, indexing="ij"), grid.shape).ravel()
    no, numbers = np.zeros(0, np.int64), (weight.detach().numpy(), mass.detach().numpy())
    heterogeneous = HeterogeneousCells(index, *numbers, no, no, no, no, np.zeros(0))
    return DifferentiableCells(heterogeneous, weight, mass, torch.zeros((0, 29), **REAL))


def _speed_factor(stencil: Stencil, speed_ratio: Tensor) -> Tensor:
    """Return `materials.speed_factor` for each cell: cos(k . n) averages to sin(|k n|) / |k n|."""
    wave = complex(stencil.kappa, stencil.eta) / speed_ratio
    symbol = torch.zeros_like(speed_ratio)
    for count, weight, length in (
        (6, stencil.face, 1.0), (12, stencil.edge, math.sqrt(2)), (8, stencil.corner, math.sqrt(3))
    ):  # fmt: skip
        symbol = symbol + count * weight * (1 - torch.sin(length * wave) / (length * wave)).real
    return stencil.symbol / symbol


def _rows(stencil: Stencil, density: Tensor, fluidity: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows and mass of the mapped cells and of those around them; `fluidity` is 1 over the mass."""
    density, fluidity = (
        torch.nn.functional.pad(part, (_RIM,) * 6, value=1.0) for part in (density, fluidity)
    )
    middle, weight = (slice(1, -1),) * 3, []
    for coupling, offset in zip(stencil.weights, OFFSETS, strict=True):
        beside = tuple(slice(1 + step, step - 1 or None) for step in offset)
        weight.append(2 * coupling * fluidity[middle] / (density[middle] + density[beside]))
    return torch.stack(weight, dim=-1).reshape(-1, 27), (1 / fluidity[middle]).reshape(-1)
