"""Bodies as the assembly sees them: unions of consecutive bodies of one material, and the materials.

Elements measure bodies on a lattice of points a quarter of a cell apart, so that they would miss a rigid
sheet between these (`docs/numerics.md` has figures). Those oblique to the grid are thickened, and a
warning is logged: errors at such walls are larger than estimated.
"""

from __future__ import annotations

import cmath
import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from autdtorch.fdtd.assembly.losses import STEP
from autdtorch.fdtd.assembly.reference_element import FAR, MaterialLosses, Materials
from autdtorch.fdtd.assembly.thin_walls import receding, thickened
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.grid_axes import slender_faces, staircase_excess
from autdtorch.fdtd.region import Body, Fluid, Region
from autdtorch.fdtd.shapes import Shape, Solids, bounds, distance_from, remaining
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index, triple
from autdtorch.utils.spatial import doubled_normals, extents, places_on, spread_evenly

logger = logging.getLogger(__name__)

# Distance by which bodies are grown, so that touching bodies leave no film of air between them
_CONTACT_GAP = 1e-9

# Density with which rigid bodies are assembled; cells that remain almost uncoupled become rigid
_RIGID_DENSITY = 1e5

_PLACES, _DEPTHS = 200, 16  # Places of a surface where the thickness is measured, and depths below each
_LEAST_SHARE = 0.05  # Least share of a surface that is a thin wall; at sharp edges less is
_ROUNDING = 1e-3  # Distance above a surface [depths] that is rounding
_PARALLEL = 0.85  # Least cosine of the angle between the faces of a wall
_ALIKE = 2.0  # Ratio of densities up to which a thin wall of fluid causes only a small error

_STEP = 2e-5  # Distance [cells] from a cell's centre of the points that tell its nearest face
_UNDECIDED = 0.5  # Length of a gradient of the distance below which a cell is half-way between faces


@dataclass(frozen=True)
class Union:
    """Union of consecutive bodies of one material."""

    shapes: tuple[Shape, ...]
    material: int
    continued: bool  # whether they continue through the absorbing layers, unchanged from the interior
    # whether blocks represent it: its faces are flat and parallel to the grid, or it is slender
    aligned: bool
    rigid: bool
    finite: bool  # whether finite elements represent its surface, or the edges of a fluid

    def distance(self, cell: Array, grid: Grid) -> Array:
        """Return the signed distance [cells] of positions (..., 3) in cells."""
        places = np.array(grid.origin) + grid.spacing * (grid.clip(cell) if self.continued else cell)
        distance = distance_from(self.shapes, torch.from_numpy(places)).numpy() / grid.spacing - _CONTACT_GAP
        if self.continued:
            return np.asarray(distance)
        x, y, z = np.moveaxis(np.maximum(np.array(grid.first) - cell, cell - np.array(grid.last) + 1), -1, 0)
        return np.asarray(np.maximum(distance, np.maximum(np.maximum(x, y), z) + 0.5))

    def faces(self, grid: Grid) -> list[Array]:
        """Return the places [cells] of its faces along each axis, up to its end on a grid."""
        corners = [grid.to_cells(shape.surface()[0]) for shape in self.shapes]
        by_shape = [slender_faces(each) or list(each.T) for each in corners]
        faces = []
        for axis, places in enumerate(map(np.concatenate, zip(*by_shape, strict=True))):
            first, last = float(grid.first[axis]), grid.last[axis] - 1.0
            inside = places[(places > first) & (places < last)]
            faces.append(inside if self.continued else np.clip(places, first + 0.5, last - 0.5))
        return faces

    def parts(self) -> list[Union]:
        """Return unions of one shape each."""
        return [replace(self, shapes=(shape,)) for shape in self.shapes]

    def near(self, cells: Array, grid: Grid) -> tuple[slice, slice, slice]:
        """Return the part of positions (nx, ny, nz, 3) [cells] of a rectangular grid in the bounds of all."""
        positions = [np.moveaxis(cells[..., axis], axis, 0)[:, 0, 0] for axis in range(3)]
        if self.continued:
            limits = zip(positions, grid.first, grid.last, strict=True)
            positions = [along.clip(first, last - 1) for along, first, last in limits]
        return triple(map(slice, *self._reach(positions, grid).tolist()))

    def range(self, grid: Grid) -> Index:
        """Return the first element around it along each axis, and one past the last (2, 3)."""
        sides = zip(grid.shape, grid.first, grid.last, strict=True)
        middles = [(np.arange(cells - 1) + 0.5).clip(first, last - 1) for cells, first, last in sides]
        return self._reach(middles, grid)

    def _reach(self, positions: Sequence[Array], grid: Grid) -> Index:
        """Return the first of positions [cells] in its bounds along each axis, and one past the last."""
        ends = np.array(bounds(self.shapes)).T + grid.spacing * np.array([-1, 1])
        axes = zip(positions, grid.origin, ends, strict=True)
        ranges = [np.searchsorted(origin + grid.spacing * along, both) for along, origin, both in axes]
        return np.array(ranges, np.int64).T


def measured(bodies: Sequence[Union], spacing: float) -> list[Union]:
    """Return unions with thin rigid sheets and walls thickened, for lattices on cells of a spacing [m]."""
    thick: list[Union] = []
    hard: list[Shape] = []
    for body in bodies:
        if body.rigid:
            shapes = tuple(thickened(shape, spacing) for shape in body.shapes)
            hard += [] if body.aligned else shapes
        else:
            shapes = tuple(receding(shape, hard, spacing) for shape in body.shapes)
        thick.append(replace(body, shapes=shapes))
    return thick


def rigid_level(bodies: Sequence[Union], distances: Iterable[Array]) -> Array:
    """Return the signed distance (...) [cells] from rigid bodies, from those of all (K, ...)."""
    return np.asarray(np.minimum(remaining(distances, [body.rigid for body in bodies]), FAR))


def rigid_distance(bodies: Sequence[Union], cells: Array, grid: Grid) -> Array:
    """Return the signed distance (...) [cells] of positions (..., 3) in cells from rigid bodies."""
    return rigid_level(bodies, (body.distance(cells, grid) for body in bodies))


def nearest_normals(bodies: Sequence[Union], cells: Array, grid: Grid) -> Array:
    """Return the normals (n, 3) of the rigid faces nearest to cell centres (n, 3), 0 half-way between two."""
    steps = _STEP * np.eye(3)[:, None]
    ahead, behind = (rigid_distance(bodies, cells + step, grid) for step in (steps, -steps))
    normal = np.asarray((ahead - behind).T / (2 * _STEP))
    normal[np.linalg.norm(normal, axis=1) < _UNDECIDED] = 0
    return normal


def unions_of(region: Region, grid: Grid, stencil: Stencil) -> tuple[list[Union], Materials]:
    """Return unions of consecutive bodies that share a material, and the materials."""
    air = region.fluid
    kinds = [Kind(air, None)]
    unions: list[Union] = []
    for number, body in enumerate(region.bodies):
        _require_continuable(number, body)
        kind = Kind(body.fluid, _impedance(body, grid))
        if kind not in kinds:
            kinds.append(kind)
        aligned = body.is_along(np.eye(3), grid.spacing)
        union = Union(
            (body.shape,),
            kinds.index(kind),
            body.continued,
            aligned,
            body.fluid is None,
            not aligned and (body.fluid is None or body.fluid.inertia > air.inertia),
        )
        if unions and union == replace(unions[-1], shapes=union.shapes):
            unions[-1] = replace(union, shapes=(*unions[-1].shapes, *union.shapes))
        else:
            unions.append(union)
    return unions, materials_of(kinds, air, stencil)


def _impedance(body: Body, grid: Grid) -> complex | None:
    """Return the impedance of a body's faces: the staircase of a slender cylinder has more area than it."""
    if body.impedance is None:
        return None
    return body.impedance * staircase_excess(grid.to_cells(body.shape.surface()[0]))


def _require_continuable(number: int, body: Body) -> None:
    """Refuse bodies through the absorbing layers that these do not absorb waves in.

    Layers stretch the coupling of cells, and not the damping of it by a complex density. Along a surface with
    an impedance waves grow in them.
    """
    if body.continued and body.impedance is not None:
        raise ValueError(
            f"obstacles[{number}]: a surface with an impedance ({body.impedance:.3g}) crosses the whole"
            " domain; must end inside it, or be a reflector"
        )
    if body.continued and body.fluid is not None and body.fluid.density.imag:
        raise ValueError(
            f"obstacles[{number}]: a fluid of complex density ({body.fluid.density:.3g} kg/m^3) crosses the"
            ' whole domain; must end inside it, or use method="box"'
        )


class Kind(NamedTuple):
    """A material."""

    fluid: Fluid | None  # None where no sound enters
    impedance: complex | None  # of the surface, as a ratio to air; None if it is rigid or a fluid's


def speed_factor(stencil: Stencil, speed_ratio: float) -> float:
    """Return the factor by which to divide masses, so that a wave in a material has the drive's frequency."""
    return stencil.symbol / stencil.isotropic_symbol(stencil.kappa / speed_ratio)


def flow_factor(kappa: float, speed_ratio: float) -> float:
    """Return the factor on a material's coupling and mass with which the flow of waves is continuous.

    On a grid the discrete flow of a wave of unit pressure and flow is sin(k) / k, with the wavenumber k of
    the material. At oblique incidence the two normal k differ, but the ratio is unchanged to second order.
    """
    inner = kappa / speed_ratio
    return math.sin(kappa) / kappa / (math.sin(inner) / inner)


def materials_of(kinds: Sequence[Kind], air: Fluid, stencil: Stencil) -> Materials:
    """Return materials of these kinds, air first."""
    materials = _lossless(kinds, air, stencil, 0.0)
    lossy = [number for number, kind in enumerate(kinds) if kind.fluid is not None and kind.fluid.is_lossy]
    if not lossy and all(kind.impedance is None for kind in kinds):
        return materials
    admittance = np.array([0 if kind.impedance is None else 1 / kind.impedance for kind in kinds], complex)
    density, mass = materials.density.copy(), materials.mass.copy()
    coupling_loss, mass_loss, tangent = np.zeros(len(kinds)), np.zeros(len(kinds)), 0.0
    for number in lossy:
        fluid = kinds[number].fluid
        assert fluid is not None
        coupling, whole = _passive(*_complex(fluid, air, stencil), stencil)
        density[number], mass[number] = 1 / coupling.real, whole.real
        coupling_loss[number], mass_loss[number] = -coupling.imag, stencil.symbol * whole.imag
        tangent = max(tangent, -coupling.imag / coupling.real)
    steps = (0.0, STEP, -STEP) if lossy else (0.0,)
    nothing = MaterialLosses(np.zeros(len(kinds)), np.zeros(len(kinds)), 0.0, admittance, ())
    variants = tuple(replace(_lossless(kinds, air, stencil, step), losses=nothing) for step in steps)
    losses = MaterialLosses(coupling_loss, mass_loss, tangent, admittance, variants)
    return Materials(density, mass, materials.slowness, materials.rigid, losses)


def _relative(fluid: Fluid, air: Fluid, stencil: Stencil) -> tuple[complex, complex]:
    """Return density and compressibility over those of air, less the absorption that all cells have."""
    density, speed = fluid.density / air.density, fluid.sound_speed / air.sound_speed
    compressibility = 1 / (density * speed**2)
    return density, compressibility - 1j * stencil.loss / stencil.symbol * compressibility.real


def _lossless(kinds: Sequence[Kind], air: Fluid, stencil: Stencil, step: float) -> Materials:
    """Return materials of real density and compressibility: real parts plus `step` times imaginary parts."""
    density = np.full(len(kinds), _RIGID_DENSITY)
    factor, slowness = np.ones(len(kinds)), np.ones(len(kinds))
    for number, (fluid, _) in enumerate(kinds):
        if fluid is None:
            continue
        relative, ratio = fluid.inertia / air.inertia, fluid.phase_speed / air.phase_speed
        if fluid.is_lossy:
            parts = _relative(fluid, air, stencil)
            relative, compressibility = (part.real + step * part.imag for part in parts)
            ratio = 1 / math.sqrt(relative * compressibility)
        density[number] = relative / flow_factor(stencil.kappa, ratio)
        factor[number], slowness[number] = speed_factor(stencil, ratio), 1 / ratio
    rigid = np.array([fluid is None for fluid, _ in kinds])
    return Materials(density, 1 / (density * factor), slowness, rigid)


def _complex(fluid: Fluid, air: Fluid, stencil: Stencil) -> tuple[complex, complex]:
    """Return the coupling relative to air, and the mass of a cell, of a lossy fluid."""
    density, compressibility = _relative(fluid, air, stencil)
    kappa = stencil.kappa
    inner = kappa * cmath.sqrt(density * compressibility)
    coupling = math.sin(kappa) / kappa / (cmath.sin(inner) / inner) / density
    return coupling, coupling * stencil.mean_symbol(inner) / stencil.symbol


def _passive(coupling: complex, mass: complex, stencil: Stencil) -> tuple[complex, complex]:
    """Turn the phases of both, which leaves the wavenumber, until waves of every length are damped.

    Errors of the grid, of second order in the wavenumber, may give a fluid that absorbs by its density alone
    a mass that amplifies. A fluid that absorbs by its bulk modulus alone may amplify the shortest waves by
    its coupling.
    """
    for symbol in (0.0, stencil.largest_symbol):
        power = stencil.symbol * mass.imag + stencil.loss * mass.real - symbol * coupling.imag
        if power < 0:
            # to first order; the rest is rounding
            turn = cmath.exp(1j * power / (symbol * coupling.real - stencil.symbol * mass.real))
            coupling, mass = coupling * turn, mass * turn
    return coupling, mass


def warn_of_thin_walls(region: Region, spacing: float, grids: Iterable[tuple[Iterable[int], Array]]) -> None:
    """Log which bodies have walls thinner than a cell [m], oblique to their grid.

    `grids` are the numbers of the bodies on each, and its axes, one a row (3, 3).
    """
    for numbers, axes in grids:
        for number in numbers:
            body = region.bodies[number]
            if region.is_as_heavy(body, _ALIKE) or body.is_along(axes, spacing):
                continue
            fluids = [later.shape for later in region.bodies[number + 1 :] if later.fluid is not None]
            if (wall := thin_wall(body.shape, spacing, fluids)) is not None:
                thickness, place = wall
                logger.warning(
                    "obstacle %d has a wall of %.2g mm at %s mm, oblique to the grid and thinner than a cell"
                    " of %.3g mm: the error may be larger than estimated",
                    number, 1e3 * thickness, tuple((1e3 * place).round(2).tolist()), 1e3 * spacing,
                )  # fmt: skip


def thin_wall(shape: Shape, spacing: float, fluids: Sequence[Shape] = ()) -> tuple[float, Array] | None:
    """Return the median thickness [m] of the walls of a shape thinner than a cell, and its place (3,) [m].

    Thickness is measured along the inward normal, at places that share the area evenly, up to a face that is
    nearly parallel: of the shape, or of later `fluids` inside it. Places that these cover do not count.
    """
    return _thin_part(shape, spacing, Solids((shape, *fluids), (True, *[False] * len(fluids))))


def warn_of_narrow_gaps(region: Region, spacing: float, grids: Iterable[tuple[Iterable[int], Array]]) -> None:
    """Log one gap beside a rigid body that is narrower than a cell [m], and that cells close or narrow.

    Those between faces along a grid are exact, unless these have an impedance; `grids` as for thin walls.
    """
    for numbers, axes in grids:
        for number in numbers:
            body = region.bodies[number]
            if body.fluid is not None or (body.impedance is None and body.is_along(axes, spacing)):
                continue
            if (gap := narrow_gap(region, number, spacing)) is not None:
                width, place = gap
                logger.warning(
                    "a gap of %.2g mm beside obstacle %d at %s mm is narrower than a cell of %.3g mm, which"
                    " may close it: the error may be larger than estimated",
                    1e3 * width, number, tuple((1e3 * place).round(2).tolist()), 1e3 * spacing,
                )  # fmt: skip
                return


def narrow_gap(region: Region, number: int, spacing: float) -> tuple[float, Array] | None:
    """Return the median width [m] of gaps narrower than a cell before a body, and a place (3,) [m] there."""
    body = region.bodies[number]
    lower, upper = np.array(body.shape.lower) - spacing, np.array(body.shape.upper) + spacing
    near = [
        other
        for other in region.bodies
        if other is not body and (lower < other.shape.upper).all() and (upper > other.shape.lower).all()
    ]
    walls = Solids([other.shape for other in near], [other.fluid is None for other in near])
    return _thin_part(body.shape, spacing, walls, side=-1) if walls else None


def _thin_part(shape: Shape, spacing: float, solids: Solids, side: int = 1) -> tuple[float, Array] | None:
    """Return the median thickness [m] and its place (3,) [m] of what is thinner than a cell at a surface.

    On side 1 it is the part of solids below the surface, and on side -1 the air between it and solids.
    """
    vertices, triangles = (part.numpy() for part in shape.surface())
    if extents(vertices)[1] < spacing:
        return None
    corners = vertices[triangles]
    normals = doubled_normals(corners)
    area = np.linalg.norm(normals, axis=1)
    some = spread_evenly(area, _PLACES)
    places, across = places_on(corners, _PLACES), -side * normals[some] / area[some, None]
    step = spacing / _DEPTHS
    depths = step * np.arange(_DEPTHS + 2)  # one beyond a cell, for the slope there
    distance = side * solids.distance(places[:, None] + depths[:, None] * across[:, None])
    covered = distance[:, 0] > side * _ROUNDING * step
    first = 1 + (distance[:, 1:-1] > 0).argmax(axis=1)  # depth behind the opposite face
    behind, farther = (distance[np.arange(_PLACES), first + more] for more in (0, 1))
    thin = (behind > 0) & (farther - behind > _PARALLEL * step) & ~covered
    if thin.mean() < _LEAST_SHARE:
        return None
    thickness = depths[first[thin]] - behind[thin]
    median = int(np.argsort(thickness)[len(thickness) // 2])
    return float(thickness[median]), np.asarray(places[thin][median])
