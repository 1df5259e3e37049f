"""Varying cells that autograd can go back through, to the obstacles' materials and places."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.bonds import VaryingCells, varying_cells
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.kernels.contract import Sources
from autdtorch.fdtd.medium import fill_elements
from autdtorch.fdtd.stencil import Stencil
from autdtorch.fdtd.stepping import Assembly, air_stencil, assembly_of
from autdtorch.obstacles import Moved, Obstacle
from autdtorch.scene import Scene

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_SMALL = 1e-4
"""Step of the central differences, relative to a material's value or in cells. Rounding is then 1e-8 of what
is told from it, and so is the curvature."""


@dataclass(frozen=True)
class VariableCells:
    """Varying cells, and what of them is differentiable.

    Attributes:
        varying: the cells.
        weight: their weights (n, 27), differentiable.
        mass: their mass (n,), differentiable.
    """

    varying: VaryingCells
    weight: torch.Tensor
    mass: torch.Tensor

    def assembly(self, grid: Grid, scene: Scene, dtype: torch.dtype, time_step: float | None) -> Assembly:
        """Ready to step, differentiable by `coefficients.varying_weight`; see `assemble_on`."""
        stencil = air_stencil(grid, scene)
        assembly = assembly_of(grid, stencil, self.varying, scene.frequency, dtype, time_step)
        factor = assembly.coefficients.face / stencil.face
        weight = (factor * self.weight).to(dtype)
        return replace(assembly, coefficients=replace(assembly.coefficients, varying_weight=weight))

    def driven(self, sources: Sources) -> Sources:
        """Sources of an assembly, differentiable by the mass of the cells they are in, too."""
        _, place, own = np.intersect1d(self.varying.index, sources.index.numpy(), return_indices=True)
        share = torch.ones(len(sources.index), dtype=self.mass.dtype)
        share[own] = torch.from_numpy(self.varying.mass[place]) / self.mass[place]
        return Sources(sources.index, share.to(sources.force)[:, None] * sources.force)


def with_materials(
    scene: Scene, density: torch.Tensor | None, sound_speed: torch.Tensor | None, offset: torch.Tensor | None
) -> tuple[Obstacle, ...]:
    """A scene's K obstacles of other density (K,), sound speed (K,), and moved by (K, 3), where given."""
    changed = []
    for number, obstacle in enumerate(scene.obstacles):
        if not obstacle.rigid:
            if density is not None:
                obstacle = replace(obstacle, density=float(density[number]))
            if sound_speed is not None:
                obstacle = replace(obstacle, sound_speed=float(sound_speed[number]))
        if offset is not None and offset[number].any():
            x, y, z = offset[number].tolist()
            obstacle = Moved(
                shape=obstacle, offset=(x, y, z), density=obstacle.density,
                sound_speed=obstacle.sound_speed, rigid=obstacle.rigid,
            )  # fmt: skip
        changed.append(obstacle)
    return tuple(changed)


def cells_of_obstacles(
    scene: Scene,
    grid: Grid,
    density: torch.Tensor | None = None,
    sound_speed: torch.Tensor | None = None,
    offset: torch.Tensor | None = None,
) -> VariableCells:
    """Varying cells of a scene's K obstacles, differentiable by what is given as a tensor that asks for it.

    The derivatives are central differences of the whole assembly, one for each number. Values that do not
    ask for gradients, and materials of rigid obstacles, take none.

    Args:
        scene: of which all else is taken.
        grid: that does not move with the obstacles.
        density: (K,) [kg/m^3].
        sound_speed: (K,) [m/s].
        offset: by which the obstacles are moved (K, 3) [m].

    Raises:
        ValueError: a derivative reaches into the boundary layers, or a cell of a rigid obstacle opens or
            closes within the difference.
    """
    given = (density, sound_speed, offset)
    stencil = air_stencil(grid, scene)

    def assembled(values: Sequence[torch.Tensor | None]) -> VaryingCells:
        changed = copy.copy(scene)  # not checked again: it differs by 1e-4 of a cell
        object.__setattr__(changed, "obstacles", with_materials(scene, *values))
        return varying_cells(fill_elements(changed, grid, stencil), stencil)

    fixed = [None if value is None else value.detach() for value in given]
    base = assembled(fixed)
    entries, pairs = [], []
    for which, value in enumerate(given):
        if value is None or not value.requires_grad:
            continue
        for place in np.ndindex(*value.shape):
            if which < 2 and scene.obstacles[place[0]].rigid:
                continue
            step = _SMALL * (grid.spacing if which == 2 else float(value[place]))
            moved = []
            for sign in (1, -1):
                other = value.detach().clone()
                other[place] += sign * step
                moved.append(assembled([*fixed[:which], other, *fixed[which + 1 :]]))
            _require_alike(place[0], base, moved)
            entries.append(value[place] / (2 * step))
            pairs.append(moved)
    return _linear(base, entries, pairs, grid, stencil)


def _require_alike(number: int, base: VaryingCells, moved: Sequence[VaryingCells]) -> None:
    if not all(np.array_equal(base.rigid, other.rigid) for other in moved):
        raise ValueError(
            f"offset[{number}]: a cell of the rigid obstacle opens or closes just here; move it a little"
        )


def _linear(
    base: VaryingCells,
    entries: Sequence[torch.Tensor],
    pairs: Sequence[Sequence[VaryingCells]],
    grid: Grid,
    stencil: Stencil,
) -> VariableCells:
    """Cells whose rows and masses have the values of `base`, and half the pairs' differences as slopes."""
    index = np.unique(np.concatenate([base.index, *(each.index for pair in pairs for each in pair)]))
    weight, mass = _on(index, base, stencil)
    varying = VaryingCells(index, weight, mass, base.rigid, base.shell)
    variable_weight, variable_mass = torch.from_numpy(weight), torch.from_numpy(mass)
    for entry, (ahead, behind) in zip(entries, pairs, strict=True):
        rows, masses = (
            more - less
            for more, less in zip(_on(index, ahead, stencil), _on(index, behind, stencil), strict=True)
        )
        changed = np.flatnonzero(rows.any(axis=1) | (masses != 0))
        if not grid.inside(index[changed]).all():
            raise ValueError(
                "density, sound_speed, offset: reach the boundary layers; obstacles to be differentiated must end "
                "inside the domain"
            )
        shift = entry - entry.detach()
        variable_weight = variable_weight.index_add(
            0, torch.from_numpy(changed), shift * torch.from_numpy(rows[changed])
        )
        variable_mass = variable_mass.index_add(
            0, torch.from_numpy(changed), shift * torch.from_numpy(masses[changed])
        )
    return VariableCells(varying, variable_weight, variable_mass)


def _on(index: Index, cells: VaryingCells, stencil: Stencil) -> tuple[Array, Array]:
    """Rows (n, 27) and mass (n,) on cells of which some may be of air."""
    weight, mass = np.tile(stencil.weights, (len(index), 1)), np.ones(len(index))
    place = np.searchsorted(index, cells.index)
    weight[place], mass[place] = cells.weight, cells.mass
    return weight, mass
