"""Stiffness and mass of the elements that a surface intersects.

In an element of one material both are those of the tuned stencil. An interface element gets

- coupling in series: density averaged along the line between vertices, exact for a flow across the surface;
- for axis-aligned faces, a product of the direction across the faces and the two others;
- for other surfaces of fluids, the forces or the energies of local fields (`smooth_faces.py`);
- masses on their side of the surface, except for the share of a flow through it which reaches the other side;
- at other surfaces of rigid bodies, and tilted edges of dense fluids, finite elements; where fluids meet at a
  rigid body, these are softer across their surface than along it.

Finite elements have trilinear functions, integrated over the part that is no such body (a cut finite element
method, Burman et al. 2015, doi:10.1002/nme.4823). Vertices in the body have a pressure, which continues the
field beyond the surface. A pressure that varies linearly along the surface then causes no force at any
vertex, wherever the surface falls between the cells. In thin walls, vertices continue the field of one side
(`thin_walls.py`). The difference of the tuned stencil from finite elements
is added in proportion to the volume.

`docs/numerics.md` compares this treatment with others.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.layered_elements import Survey, flat_elements, mean_air_thickness
from autdtorch.fdtd.assembly.reference_element import (
    CORNERS,
    FAR,
    HATS,
    PAIRS,
    SLOPES,
    SUBCELLS,
    InterfaceElements,
    Materials,
    cut_coupling,
    distance_to_material,
    line_coverage,
    shares,
    subcell_means,
    tend_to_mean,
    tuning_of,
    uniform_coupling,
    volume_coverage,
    without_vertices,
)
from autdtorch.fdtd.assembly.smooth_faces import Surface, fields, smooth_stiffness, surfaces, unfolded
from autdtorch.fdtd.assembly.thin_walls import Side
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

# Distance by which the heavier fluid of a smooth surface is shrunk, relative to the thickness added to a
# rigid face, and the ratio of densities that halves it: the mean phase of tilted half-spaces is then exact
_SHRUNK, _SHRUNK_RATIO = 0.5, 12.0
_ABSENT_SHARE = 1e-4  # Share of an element's volume below which a material counts as absent
_TINY = 1e-12  # Least length of a normal


class Bodies(NamedTuple):
    """Bodies near n elements; later ones take precedence."""

    distance: Array  # signed distances of K bodies (K, n, 125) [cells]; `FAR` if not near
    material: Index  # number of the material of each body (K,)
    finite: NDArray[np.bool_]  # mask of the bodies that finite elements represent in an element (K, n)
    reductions: Array  # relative reduction of the stiffness near edges of such bodies (n, 3, 3)
    beside: NDArray[np.bool_]  # mask of elements beside edges, which are finite at flat faces too (n,)
    sides: tuple[Side, ...]  # of thin rigid walls

    def chosen(self, some: Index | NDArray[np.bool_]) -> Bodies:
        """Return the bodies near some of the elements."""
        return self._replace(
            distance=self.distance[:, some],
            finite=self.finite[:, some],
            reductions=self.reductions[some],
            beside=self.beside[some],
            sides=tuple(side.chosen(some) for side in self.sides),
        )


def interface_elements(bodies: Bodies, materials: Materials, stencil: Stencil) -> InterfaceElements:
    """Return the stiffness and mass of n elements that surfaces of K bodies intersect."""
    distance, material, survey = bodies.distance.copy(), bodies.material, Survey.of(bodies.distance)
    # bodies that do not intersect an element must not enter its shares
    uncut = ((survey.least > 0) | (survey.most < 0)) & ~survey.crossed(distance)
    distance[uncut] = np.copysign(FAR, survey.least[uncut])[:, None]
    bodies = bodies._replace(distance=distance)
    vertex, layered = _vertex_materials(distance, material), survey.axis(constant=uncut)
    near = is_near(left_by_fluids(distance, materials.rigid[material]))
    # a surface with an impedance needs pressures on both sides, and so does a face beside an edge
    allowed = bodies.finite & ((layered < 0) | bodies.beside | materials.reacting[material, None])
    finite = np.asarray((near & allowed).any(axis=0))
    coupling, mass = np.zeros((len(vertex), 28)), np.zeros(vertex.shape)
    if finite.any():
        coupling[finite], mass[finite] = _finite_elements(bodies.chosen(finite), materials, stencil)
    for axis in range(3):
        if len(flat := np.flatnonzero(~finite & (layered == axis))):
            coupling[flat], mass[flat] = flat_elements(axis, distance[:, flat], material, materials, stencil)
    if len(other := np.flatnonzero(~finite & (layered < 0))):
        coupling[other], mass[other] = _oblique_elements(bodies.chosen(other), materials, stencil)
    smooth, lossless = finite | (layered < 0), np.zeros((len(vertex), 0))
    return InterfaceElements(coupling, mass, vertex, finite, ~smooth, lossless)


def left_by_fluids(distance: Array, rigid: NDArray[np.bool_]) -> Array:
    """Return signed distances (K, n, L) of bodies; of `rigid` ones (K,), those of what later fluids leave."""
    if (np.diff(rigid.astype(np.int8)) >= 0).all():  # no fluid after a rigid body
        return distance
    left = distance.copy()
    for number in np.flatnonzero(rigid):
        for later in number + 1 + np.flatnonzero(~rigid[number + 1 :]):
            left[number] = np.maximum(left[number], -distance[later])
    return left


def is_near(distance: Array) -> NDArray[np.bool_]:
    """Return whether bodies with signed distances (K, n, L) are near elements (K, n)."""
    return np.asarray((distance.min(axis=2) < FAR) & (distance.max(axis=2) > -FAR))


def _oblique_elements(bodies: Bodies, materials: Materials, stencil: Stencil) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of elements that vary along several axes, not finite ones.

    In front of the seam of two fluids that are alike, they tend to the mean of elements of each of the two.
    """
    coupling, mass = _elements_in_series(bodies, materials, stencil)
    fluids = np.unique(bodies.material[~materials.rigid[bodies.material]]).tolist()
    for pair in itertools.combinations(fluids, 2):
        of_pair = np.isin(bodies.material, pair)
        both = np.stack([bodies.distance[bodies.material == number].min(axis=0) for number in pair])
        crossed = is_near(both).all(axis=0)
        if not len(some := np.flatnonzero(crossed & (both.min(axis=0) > 0).any(axis=1))):
            continue
        distance, joint = bodies.distance[:, some], unfolded(both[:, some].min(axis=0))
        volumes = shares(volume_coverage, distance, bodies.material, len(materials.density)).mean(axis=1)
        part = volumes[:, pair] / np.maximum(volumes[:, pair].sum(axis=1, keepdims=True), 1e-12)
        distance[of_pair] = FAR
        distance[of_pair.argmax()] = joint
        singles = []
        for number in pair:
            material = np.where(of_pair, number, bodies.material)
            single = bodies.chosen(some)._replace(distance=distance, material=material)
            singles.append(_elements_in_series(single, materials, stencil))
        tend_to_mean((coupling, mass), some, singles, part, materials.alike(*pair))
    return coupling, mass


def _elements_in_series(bodies: Bodies, materials: Materials, stencil: Stencil) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of elements in series.

    Those of two materials, between which the surface has one normal, have local fields instead.
    """
    count, distance, material = len(materials.density), bodies.distance, bodies.material
    vertex = _vertex_materials(distance, material)
    grow = np.repeat(mean_air_thickness(materials, stencil)[material, None], len(vertex), axis=1)
    volumes = np.moveaxis(_mixed(bodies, grow, np.eye(count)), 0, -1)
    lines = shares(line_coverage, distance, material, count)
    along = (lines @ materials.density).reshape(-1, len(PAIRS), SUBCELLS).mean(axis=2)
    coupling, mass = uniform_coupling(stencil) / along, _lumped_mass(vertex, volumes, materials)
    used = (vertex[:, :, None] == np.arange(count)).any(axis=1)
    present = volumes.mean(axis=1) > _ABSENT_SHARE
    two = np.flatnonzero((used.sum(axis=1) == 2) & (present <= used).all(axis=1))
    sides = np.stack((used[two].argmax(axis=1), count - 1 - used[two, ::-1].argmax(axis=1)), axis=1)
    level = distance_to_material(distance[:, two], material, sides[:, 1])
    flat, surface = surfaces(level, materials.density[sides])
    cells, pair = two[flat], sides[flat]
    mobility = volumes[cells] @ (1 / materials.density) / SUBCELLS**3
    coupling[cells], weight = smooth_stiffness(surface, mobility, coupling[cells], uniform_coupling(stencil))
    some = weight > 0
    cells, pair, surface, weight = cells[some], pair[some], surface.chosen(some), weight[some, None]
    part = _moved_shares(surface, pair, _added_thickness(stencil.kappa), count)
    lumped = _lumped_mass(vertex[cells], part, materials)
    mass[cells] += weight * (_balanced_mass(surface, materials.mass[pair], lumped) - mass[cells])
    return coupling, mass


def _finite_elements(bodies: Bodies, materials: Materials, stencil: Stencil) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of finite elements, the bodies grown by the added thickness.

    A fluid that later cuts into a rigid body is shrunk by it.
    """
    contrast = np.where(materials.rigid, 1, (materials.density - 1) / (materials.density + 1))
    hard = bodies.finite & materials.rigid[bodies.material, None]
    cutting = ~bodies.finite & (np.cumsum(hard, axis=0) > 0)
    grown = np.where(cutting, -1, contrast[bodies.material, None] * bodies.finite)
    grown *= _added_thickness(stencil.kappa)
    fluid = ~materials.rigid
    several = (materials.density[fluid] > 1).any() and not fluid.all()
    values = [1 / materials.density, materials.mass]
    values += [np.ones(len(fluid)), materials.density] if several else []
    mobility, weight, *others = _mixed(bodies, grown, np.stack(values) * fluid / SUBCELLS**3)
    coupling, mass = np.zeros((len(weight), 28)), np.zeros((len(weight), 8))
    for side in bodies.sides:
        here = np.flatnonzero(side.share.any(axis=1))
        share, out = side.share[here], side.out[here]
        part, reductions = mobility[here] * share, bodies.reductions[here]
        if several:
            reductions = _across_fluids(reductions, part, *(other[here] * share for other in others))
        added = _cut_coupling(part, reductions, stencil)
        parted = np.flatnonzero(out.any(axis=1))
        added[parted], _ = without_vertices(added[parted], out[parted])
        coupling[here] += added
        mass[here] += _cut_mass(weight[here] * share, out)
    return coupling, mass


def _mixed(bodies: Bodies, grown: Array, values: Array) -> Array:
    """Return the means (v, n, 64) of values (v, m) over the materials in sub-cells; see `mix_materials`.

    Bodies are `grown` by distances (K, n).
    """
    from autdtorch.fdtd.assembly.element_kernels import mix_materials  # loads numba

    mixed = np.empty((len(values), bodies.distance.shape[1], SUBCELLS**3))
    # numba compiles again for arrays with gaps
    distance, grown = map(np.ascontiguousarray, (bodies.distance, grown))
    mix_materials(distance, grown, bodies.material, values, mixed)
    return mixed


def _vertex_materials(distance: Array, material: Index) -> Index:
    """Return the material at each vertex (n, 8), from distances at the lattice (K, n, 125)."""
    vertex = np.zeros((distance.shape[1], 8), np.int64)
    for far, number in zip(distance, material, strict=True):
        vertex[far[:, CORNERS] < 0] = number
    return vertex


def _moved_shares(surface: Surface, pair: Index, thickness: float, count: int) -> Array:
    """Return the shares (n, 64, count) of two materials (n, 2), with the heavier one shrunk.

    Otherwise a wave on the grid is reflected in front of the surface, at a part of `_added_thickness`.
    """
    outer, inner = surface.density.T
    ratio = np.maximum(outer, inner) / np.minimum(outer, inner)
    shrunk = _SHRUNK * thickness / (1 + ratio / _SHRUNK_RATIO) * (inner - outer) / np.maximum(outer, inner)
    part = volume_coverage(surface.level + shrunk[:, None])
    share = np.zeros((*part.shape, count))
    np.put_along_axis(share, pair[:, None, :1], (1 - part)[:, :, None], axis=2)
    np.put_along_axis(share, pair[:, None, 1:], part[:, :, None], axis=2)
    return share


def _across_fluids(reductions: Array, mobility: Array, share: Array, density: Array) -> Array:
    """Return reductions of the stiffness (n, 3, 3) with those across dense fluids' surfaces at rigid bodies.

    Mobilities average along the surface, and densities across it. Its normal is the sum of those of
    faces between sub-cells, times the change of mobility there. Mobilities, densities and the share of
    fluids (n, 64) are parts of an element.
    """
    filled, dense, mobile = (part.sum(axis=1) for part in (share, density, mobility))
    # without a rigid body it is the edge of a fluid, at which no normal serves; light fluids err more with it
    several = np.flatnonzero(
        (filled < 1 - _ABSENT_SHARE)
        & (dense > (1 + _ABSENT_SHARE) * filled)
        & (dense * mobile > (1 + _ABSENT_SHARE) * filled**2)
    )
    parts = [part[several].reshape(-1, *(SUBCELLS,) * 3) for part in (mobility, share)]
    normal = np.zeros((len(several), 3))
    for axis in range(3):
        (here, filled_here), (there, filled_there) = (
            [np.moveaxis(part, axis + 1, 1)[:, some] for part in parts]
            for some in (slice(-1), slice(1, None))
        )
        normal[:, axis] = (there * filled_here - here * filled_there).sum(axis=(1, 2, 3))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), _TINY)
    less = 1 - filled[several] / np.sqrt(dense[several] * mobile[several])
    left = np.eye(3) - less[:, None, None] * normal[:, :, None] * normal[:, None, :]  # root of what is left
    reductions = reductions.copy()
    reductions[several] = np.eye(3) - left @ (np.eye(3) - reductions[several]) @ left
    return reductions


_MOST_TAKEN = 0.8  # Largest share of a vertex's mass that is taken away


def _lumped_mass(vertex: Index, volumes: Array, materials: Materials) -> Array:
    """Return masses at the vertices (n, 8).

    Vertices in a material take its mass, except for the share of a flow through the surface which reaches
    other fluids. With one face across the line between two vertices, both standing waves are then exact.
    """
    total = np.zeros(vertex.shape)
    mean = volumes.mean(axis=1) @ materials.density
    for number, mass in enumerate(materials.mass):
        inside = vertex == number
        beside = ~inside & ~materials.rigid[vertex]
        beside[~inside.any(axis=1)] = True
        near, far = inside @ HATS.T, beside @ HATS.T
        passed = np.minimum(1, (materials.density[number] / mean)[:, None] * far)
        passed[~inside.any(axis=1)] = 1
        volume = volumes[:, :, number] / SUBCELLS**3
        here = (volume * np.divide(1 - passed, near, out=np.zeros_like(near), where=near > 0)) @ HATS
        there = (volume * np.divide(passed, far, out=np.zeros_like(far), where=far > 0)) @ HATS
        total += mass * (np.where(inside, here, 0) + np.where(beside, there, 0))
    return total


def _balanced_mass(surface: Surface, whole_cell: Array, mass: Array) -> Array:
    """Return masses (n, 8) with equal sums, and the exact first moment with the kinked local field.

    `whole_cell` (n, 2) are the masses of cells of the outer and the inner material. A wave across the surface
    then causes no moment of the masses, as it causes no force.
    """
    middle, inside = subcell_means(surface.level), volume_coverage(surface.level)
    cut = (inside > 0) & (inside < 1)
    half = np.abs(surface.normal).sum(axis=1)[:, None] / SUBCELLS / 2
    moment, density = np.zeros(len(mass)), surface.density * whole_cell / SUBCELLS**3
    for side, part in enumerate((1 - inside, inside)):
        end = middle + half if side == 0 else middle - half
        depth = np.where(cut, end / 2, middle)
        moment += density[:, side] * (part * depth).sum(axis=1)
    kinked, whole = fields(surface)[:, :, 2], mass.sum(axis=1)
    mean = np.divide((mass * kinked).sum(axis=1), whole, out=np.zeros_like(whole), where=whole > 0)
    rise = kinked - mean[:, None]
    square = (mass * rise**2).sum(axis=1)
    scale = np.divide(moment - whole * mean, square, out=np.zeros_like(square), where=square > 0)
    change = rise * scale[:, None]
    least = change.min(axis=1, keepdims=True)
    return np.asarray(mass * (1 + change * np.minimum(1, _MOST_TAKEN / np.maximum(-least, 1e-12))))


def _cut_coupling(mobility: Array, reductions: Array, stencil: Stencil) -> Array:
    """Return the coupling (n, 28) of elements, less `reductions` (n, 3, 3) of the stiffness near edges."""
    near, coupling = np.trace(reductions, axis1=1, axis2=2) / 2, cut_coupling(mobility, stencil)
    some = np.flatnonzero(near)
    across = SLOPES @ reductions[some, None]
    reduced = np.einsum("nq,nqix,qjx->nij", mobility[some], across, SLOPES, optimize=True)
    reduced += (near[some] * mobility[some].sum(axis=1))[:, None, None] * tuning_of(stencil)
    coupling[some] += reduced[:, PAIRS[:, 0], PAIRS[:, 1]]
    return np.asarray(coupling)


def _cut_mass(cells: Array, out: NDArray[np.bool_]) -> Array:
    """Return the masses at the vertices (n, 8), from those of sub-cells (n, 64).

    Vertices `out` (n, 8) leave theirs to the others.
    """
    mass, parted = cells @ HATS, np.flatnonzero(out.any(axis=1))
    hats = HATS * ~out[parted, None]
    whole = hats.sum(axis=2, keepdims=True)
    hats = np.divide(hats, whole, out=np.zeros_like(hats), where=whole > 0)
    mass[parted] = (cells[parted, None] @ hats)[:, 0]
    return np.asarray(mass)


def _added_thickness(kappa: float) -> float:
    """Return the thickness [cells] by which rigid bodies are grown, about kappa^2 / 24.

    Otherwise a wave on the grid is reflected this far behind the surface, at any tilt and incidence: the mean
    of kappa^2 (d^3 / 3 - d / 12) over all places d of a face between the cells, and higher terms. Fluids have
    `layered_elements.mean_air_thickness`.
    """
    return (math.tan(kappa / 2) / (kappa / 2) - 1) / 2
