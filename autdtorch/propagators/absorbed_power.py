"""The power that obstacles and reflectors absorb, from the phasors of a steady state."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import spherical_jn

from autdtorch.analytic.green import directivity
from autdtorch.analytic.spherical_waves import degrees, outgoing_radial
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.fdtd.stepping import Assembly
from autdtorch.scene.arrays import apertures_of, complex_strengths_of
from autdtorch.scene.scene import Scene
from autdtorch.utils.apertures import Discs, centers_of, image_of
from autdtorch.utils.array_types import COMPLEX, REAL, Array, Index
from autdtorch.utils.mirror_images import Mirror, images_of
from autdtorch.utils.spatial import distinct_cells, places_among
from autdtorch.utils.validation import invalid

_MORE = 20
"""Degrees of a far field beyond wavenumber times radius: those that are left out are below 1e-6."""

_AT_ONCE = 4_000_000
"""Pairs of a direction and a source whose waves are in memory at once."""


class AbsorbedPower(NamedTuple):
    """The power [W] that each obstacle (..., K) and each reflector (..., J) absorbs, float64."""

    obstacles: torch.Tensor
    reflectors: torch.Tensor


class Radiators(NamedTuple):
    """Points or discs that radiate as an array, or as the bodies in front of mirrors, without images."""

    places: torch.Tensor | Discs  # points (n, 3) [m]
    amplitude: torch.Tensor  # (n, R) [Pa m] in R runs
    mirrors: tuple[int, ...] = ()  # numbers of those whose images they hold


def radiators_of_array(scene: Scene, drive: torch.Tensor) -> Radiators:
    """Return the transducers of a scene, for drives (R, M)."""
    return Radiators(apertures_of(scene.array).places, (complex_strengths_of(scene.array) * drive).mT)


def power_into_reflectors(scene: Scene, parts: Sequence[Radiators], runs: int) -> torch.Tensor:
    """Return the power (R, J) [W] that reflectors absorb in R runs, from all that radiates without images.

    With the field u of radiators and their images in all other planes, a plane of reflection R adds R times
    the image of u. It then absorbs (1 - R^2) times the power that u sends to its far side.

    Raises:
        ValueError: a reflector that absorbs has a complex reflection, or another that faces it.
    """
    mirrors = [reflector.mirror for reflector in scene.reflectors]
    power = torch.zeros((runs, len(mirrors)), **REAL)
    for number, mirror in enumerate(mirrors):
        if abs(mirror.reflection) >= 1:
            continue
        others = {index: other for index, other in enumerate(mirrors) if index != number}
        if mirror.reflection.imag or any(mirror.is_parallel(other) for other in others.values()):
            accepted = "absorbs a known power only if it is real and no other reflector faces it"
            raise invalid(f"reflectors[{number}].reflection", mirror.reflection, accepted)
        share = 1 - mirror.reflection.real**2
        power[:, number] = share * _power_behind(scene, mirror, others, parts)
    return power


def _power_behind(
    scene: Scene, mirror: Mirror, others: Mapping[int, Mirror], parts: Sequence[Radiators]
) -> torch.Tensor:
    """Return the power (R,) [W] that radiators and their images in other mirrors send behind a mirror."""
    everything: list[tuple[torch.Tensor | Discs, torch.Tensor]] = []
    for part in parts:
        missing = [other for number, other in others.items() if number not in part.mirrors]
        for image in images_of(missing, scene.complex_wavenumber, 1.0):
            everything.append((image_of(part.places, image), image.weight * part.amplitude.to(**COMPLEX)))
    centers = torch.cat([centers_of(each) for each, _ in everything])
    middle = (centers.amax(dim=0) + centers.amin(dim=0)) / 2
    radii = [float(each.radii.max()) for each, _ in everything if isinstance(each, Discs)]
    reach = float((centers - middle).norm(dim=1).max()) + max(radii, default=0.0)
    total = torch.zeros(everything[0][1].shape[1], **REAL)
    for directions, area in _half_sphere(math.ceil(scene.wavenumber * reach) + _MORE, mirror, len(centers)):
        parts_of = [
            _far_waves(directions, each, middle, scene.wavenumber) @ part for each, part in everything
        ]
        total += area @ torch.stack(parts_of).sum(dim=0).abs().square()
    return total / (2 * scene.medium.density * scene.medium.sound_speed)


def _far_waves(
    directions: torch.Tensor, places: torch.Tensor | Discs, middle: torch.Tensor, wavenumber: float
) -> torch.Tensor:
    """Return the far field (n, N) of points or discs in directions (n, 3); at the middle the phase is 0."""
    turn = -wavenumber * directions @ (centers_of(places) - middle).mT
    waves = torch.polar(torch.ones((), **REAL), turn)
    if not isinstance(places, Discs):
        return waves
    sine = (1 - (directions @ places.normals.mT) ** 2).clamp(min=0).sqrt()
    return waves * directivity(wavenumber * places.radii * sine)


def _half_sphere(degree: int, mirror: Mirror, count: int) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield directions (n, 3) behind a mirror and their solid angles (n,), a few at a time."""
    heights, weights = np.polynomial.legendre.leggauss(degree + 1)
    heights, weights = (heights + 1) / 2, weights / 2  # products of two waves, over half of the sphere
    turns = 2 * math.pi * torch.arange(2 * degree + 1, **REAL) / (2 * degree + 1)
    normal = torch.tensor(mirror.normal, **REAL)
    _, _, basis = torch.linalg.svd(normal[None])
    around = torch.cos(turns)[:, None] * basis[1] + torch.sin(turns)[:, None] * basis[2]
    rows = max(1, _AT_ONCE // (count * len(turns)))
    for first in range(0, len(heights), rows):
        height = torch.from_numpy(heights[first : first + rows])[:, None, None]
        directions = (1 - height**2).sqrt() * around - height * normal
        area = torch.from_numpy(weights[first : first + rows]).repeat_interleave(len(turns))
        yield directions.reshape(-1, 3), area * 2 * math.pi / len(turns)


def power_into_sphere(
    regular: torch.Tensor, outgoing: torch.Tensor, radius: float, scene: Scene
) -> torch.Tensor:
    """Return the power (R,) [W] that flows into a sphere, by the waves (N, R) [Pa] around its centre."""
    degree = math.isqrt(len(regular)) - 1
    size = torch.full((1, 1), scene.complex_wavenumber * radius, **COMPLEX)
    inner = [
        spherical_jn(np.arange(degree + 1), size[0].numpy(), derivative=slope) for slope in (False, True)
    ]
    rows = outgoing_radial(degree + 1, size)[..., 0]
    slope = torch.arange(degree + 1, device=size.device)[:, None] / size * rows[:-1] - rows[1:]
    every = degrees(degree)
    pressure, change = (
        torch.from_numpy(here)[every, None] * regular + there[every] * outgoing
        for here, there in zip(inner, (rows[:-1], slope), strict=True)
    )
    flow = (pressure.conj() * scene.complex_wavenumber * change).sum(dim=0).imag
    power: torch.Tensor = -(radius**2) * flow / (2 * scene.medium.density * scene.angular_frequency)
    return power


@dataclass(frozen=True)
class Absorption:
    """The power that obstacles absorb on a grid, a form of the pressure in its cells.

    Attributes:
        cells: flat indices (k,) of the cells whose phasors are needed, ascending.
        places: of these cells (k, 3) [m].
        obstacle: number of the obstacle that each lossy cell belongs to, or to its image (l,).
        around: places of the lossy cells and their neighbours among the cells (l, 27).
        mass: power [W/Pa^2] by the squared pressure of each lossy cell (l,).
        coupling: by squared differences of pressure from its neighbours (l, 27).
    """

    cells: Index
    places: torch.Tensor
    obstacle: Index
    around: Index
    mass: Array
    coupling: Array

    def power(self, phasors: torch.Tensor, count: int) -> torch.Tensor:
        """Return the power (count, R) [W] of so many obstacles, from phasors (k, R) [Pa]."""
        pressure = phasors.numpy()
        power = self.mass[:, None] * np.abs(pressure[self.around[:, 13]]) ** 2
        for column, neighbour in zip(self.coupling.T, self.around.T, strict=True):
            power += column[:, None] * np.abs(pressure[neighbour] - pressure[self.around[:, 13]]) ** 2
        total = torch.zeros((count, power.shape[1]), **REAL)
        return total.index_add(0, torch.from_numpy(self.obstacle), torch.from_numpy(power))


def absorption(
    assembly: Assembly, region: Region, mirrors: Sequence[object] = (), axes: Array | None = None
) -> Absorption | None:
    """Return the absorption of a region's bodies on a grid; images in some mirrors do not count.

    None where nothing absorbs. A cell belongs to one body, see `_owners`. `axes` are those of a turned grid,
    one a row (3, 3).
    """
    cells, grid, stencil = assembly.heterogeneous, assembly.grid, assembly.stencil
    if not len(cells.lossy):
        return None
    index = cells.index[cells.lossy]
    around = index[:, None] + flat_offsets(grid.shape)
    count = math.prod(grid.shape)
    used = distinct_cells(around, count)
    # on the grid the flow of a wave of unit pressure is less than in air by slope / 2 kappa
    watts = grid.spacing / (2 * 2 * np.pi * region.frequency * region.fluid.density.real)
    watts *= 2 * stencil.kappa / stencil.slope.real * 0.5 ** len(mirrors)
    turned = np.eye(3) if axes is None else axes
    places = torch.from_numpy(grid.centers_of(index) @ turned)
    body, nearest, distance = _owners(places, region, turned, grid.spacing)
    # of a fluid the mass also absorbs as air does, which its losses leave out; the air beside it is no part
    in_fluid = np.array([each.fluid is not None for each in region.bodies], bool)[nearest]
    air = (0.5 + distance / grid.spacing).clip(0, 1)
    of_fluid = (cells.mass[cells.lossy] - air).clip(min=0)
    mass = cells.loss[:, 27] + np.where(in_fluid, stencil.loss * of_fluid, 0)
    obstacle = np.array([each.number for each in region.bodies], np.int64)[body]
    everywhere = torch.from_numpy(grid.centers_of(used) @ turned)
    by_pairs = watts / 2 * cells.loss[:, :27]
    place = places_among(used, count)[around]
    return Absorption(used, everywhere, obstacle, place, watts * mass, by_pairs)


def _owners(places: torch.Tensor, region: Region, axes: Array, spacing: float) -> tuple[Index, Index, Array]:
    """Return the numbers of the bodies that absorb at places (n, 3) [m], and that are nearest to them (n,).

    Third is the signed distance [m] to the nearest.
    Later bodies replace earlier ones where they overlap. The nearest body absorbs, except in the cells that
    represent a surface with an impedance, which may be in a fluid: one layer, or two along the grid.
    """
    nearness = torch.full((len(region.bodies), len(places)), math.inf, **REAL)
    surface, later = nearness.clone(), torch.full((len(places),), math.inf, **REAL)
    for number in reversed(range(len(region.bodies))):
        body = region.bodies[number]
        distance = body.shape.signed_distance(places)
        if body.impedance is not None:
            layers = 2 if body.is_along(axes, spacing) else 1
            beside = torch.maximum(distance.abs(), -later)
            surface[number] = beside.where(beside < layers * spacing, math.inf)
        if body.impedance is not None or (body.fluid is not None and body.fluid.is_lossy):
            nearness[number] = torch.maximum(distance, -later)
        later = torch.minimum(later, distance)
    (distance, nearest), (least, beside) = nearness.min(dim=0), surface.min(dim=0)
    return torch.where(least < math.inf, beside, nearest).numpy(), nearest.numpy(), distance.numpy()
