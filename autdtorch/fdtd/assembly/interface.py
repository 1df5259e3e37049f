"""Surfaces between the cell centres: what an obstacle's surface makes of the elements it cuts.

An element is the cube between eight cell centres, its vertices. The scheme is a sum over elements of an
energy of coupling between vertices and of a mass at each vertex; in an element of one material both are the
tuned stencil's. A cut element gets

- coupling in series: density averaged along the line between two vertices, right for a flow across the
  surface;
- if it is layered along an axis, by faces along the grid, coupling with which the scheme is a product of that
  direction and the two others;
- if not, a correction that gives two fields that vary along the surface their exact energy, and leaves that
  of a third, which crosses it continuous in pressure and in flow, with the kink that the densities ask for:
  for it coupling in series are right. Its matrix is
  C^T (A - N^T L N) C with L that of the coupling, N the fields at the vertices, A their exact energies, and
  C = (N^T L N)^-1 N^T L the projection on them: the consistency of virtual element methods (Beirao da Veiga
  et al. 2013) for the local solutions of immersed finite elements (Li 1998). The two along the surface follow
  its curvature;
- masses that stay on their side: a sliver of air gives its mass to the vertices in air, as its pressure is
  theirs, also where the cell it lies in has its centre in a heavy obstacle.

Lengths are in cells, density and mass relative to air. `docs/decisions/surfaces.md` compares it with others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.arrays import Array

SUBCELLS = 4
"""Sub-cells an edge of a cut element, on which volumes are summed."""

VERTICES = np.array(list(itertools.product((0, 1), repeat=3)))
"""The eight vertices of an element, as offsets in cells."""

PAIRS = np.array(list(itertools.combinations(range(8), 2)))
"""The 28 pairs of vertices that coupling join."""

_APART = np.abs(VERTICES[PAIRS[:, 0]] - VERTICES[PAIRS[:, 1]])
"""Of which axes the edges lead from one vertex of a pair to the other (28, 3)."""

FAR = 1e3
"""Distance [cells] that stands for an obstacle too far away to matter."""

_PRESENT = 1e-4
"""Share of an element's volume below which a material counts as absent."""

_FLAT = 0.5
"""Smallest mean gradient of a signed distance for which the element has one normal: two faces of a thin plate
cancel."""

_PLANE = 1e-6
"""Variation of a signed distance [cells] along a face that is rounding."""

_SPARE = 6.0
"""What an element full of the heavier material lends to diagonals across its face, in units of what it
needs for its own. A sixth is left over by the element behind, of which half is lent."""

_SHARPEST = 0.5
"""Largest curvature [1/cells] that the fields follow; edges have none."""

LATTICE = np.array(list(itertools.product(range(SUBCELLS + 1), repeat=3))) / SUBCELLS
"""Where the signed distances of an element are needed (125, 3), from its first vertex [cells]."""

_SUBCENTRES = (np.array(list(itertools.product(range(SUBCELLS), repeat=3))) + 0.5) / SUBCELLS
_HATS = np.prod(np.where(VERTICES == 1, _SUBCENTRES[:, None], 1 - _SUBCENTRES[:, None]), axis=2)
_LOW = np.arange(SUBCELLS)
_CORNERS = np.ravel_multi_index((VERTICES * SUBCELLS).T, (SUBCELLS + 1,) * 3)
_LINES = np.ravel_multi_index(
    np.moveaxis(
        SUBCELLS * VERTICES[PAIRS[:, 0], None]
        + np.arange(SUBCELLS + 1)[:, None] * (VERTICES[PAIRS[:, 1]] - VERTICES[PAIRS[:, 0]])[:, None],
        -1,
        0,
    ),
    (SUBCELLS + 1,) * 3,
)


def _quadratic(x: Array) -> Array:
    """Monomials up to degree two at points (n, 3), in the order value, gradient, second derivatives."""
    second = [x[:, a] * x[:, b] / (2 if a == b else 1) for a, b in _SECOND]
    return np.column_stack((np.ones(len(x)), x, *second))


_SECOND = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_FIT = np.linalg.pinv(_quadratic(LATTICE - 0.5))


@dataclass(frozen=True)
class Materials:
    """The materials of a scene, relative to air, which is number 0.

    Attributes:
        density: (m,).
        mass: of a cell (m,).
    """

    density: Array
    mass: Array

    @property
    def speed(self) -> Array:
        """What the weights of a cell are times air's (m,), about the square of the speed ratio."""
        return 1 / (self.density * self.mass)


@dataclass(frozen=True)
class InterfaceElements:
    """What n cut elements add to the scheme.

    Attributes:
        coupling: between the `PAIRS` of vertices (n, 28).
        mass: at the vertices (n, 8).
        number: of the material that each vertex lies in (n, 8).
    """

    coupling: Array
    mass: Array
    number: NDArray[np.int64]


def interface_elements(
    distance: Array, material: NDArray[np.int64], materials: Materials, stencil: Stencil
) -> InterfaceElements:
    """Bonds and masses of elements that surfaces cut.

    Args:
        distance: signed distance of K obstacles, the later of which win, at the `LATTICE` of n elements
            (K, n, 125) [cells]; `FAR` where an obstacle is not near.
        material: number of the material of each obstacle (K,).
        materials: the materials.
        stencil: weights in air.
    """
    count = len(materials.density)
    # an obstacle that an element is wholly outside or inside of has no place in it
    distance = np.where((distance > 0).all(axis=2, keepdims=True), FAR, distance)
    distance = np.where((distance < 0).all(axis=2, keepdims=True), -FAR, distance)
    volumes = _shares(_volume_coverage, distance, material, count)
    lines = _shares(_line_coverage, distance, material, count)
    density = (lines @ materials.density).reshape(-1, len(PAIRS), SUBCELLS).mean(axis=2)
    coupling = uniform_coupling(stencil) / density
    number = np.zeros((distance.shape[1], 8), np.int64)
    for far, own in zip(distance, material, strict=True):
        number[far[:, _CORNERS] < 0] = own
    layered = _layered_axis(distance)
    for axis in range(3):
        own = layered == axis
        coupling[own] = _layered_coupling(axis, number[own], volumes[own], materials, stencil)
    held = (number[:, :, None] == np.arange(count)).any(axis=1)
    present = volumes.mean(axis=1) > _PRESENT
    two = (held.sum(axis=1) == 2) & (present <= held).all(axis=1)
    chosen = np.flatnonzero(two & (layered < 0))
    if len(chosen):
        inner = count - 1 - held[chosen, ::-1].argmax(axis=1)
        outer = held[chosen].argmax(axis=1)
        level = _level(distance[:, chosen], material, inner)
        sides = materials.density[np.stack((outer, inner), axis=1)]
        flat, correction = _correction(level, sides, volumes[chosen], materials, coupling[chosen])
        coupling[chosen[flat]] += correction
    return InterfaceElements(coupling, _masses(number, volumes, materials), number)


def _layered_axis(distance: Array) -> NDArray[np.int64]:
    """Axis (n,) along which alone the signed distances (K, n, 125) of elements vary; -1 where they do not."""
    cube = distance.reshape(*distance.shape[:2], *(SUBCELLS + 1,) * 3)
    found = np.full(distance.shape[1], -1)
    for axis in range(3):
        others = tuple(other + 2 for other in range(3) if other != axis)
        found[np.ptp(cube, axis=others).max(axis=(0, 2), initial=0) < _PLANE] = axis
    return found


def _layered_coupling(
    axis: int, number: NDArray[np.int64], volumes: Array, materials: Materials, stencil: Stencil
) -> Array:
    """Bonds (n, 28) of elements with faces across an axis, with which the scheme is a product.

    With p0 and p1 the pressures in the two planes of vertices, the energy is g (p1 - p0)^T W (p1 - p0), g
    being the series mobility, and in each plane that of air times a mobility t: of each material that plane's
    where its vertices alone lie in it, else half. In a boundary layer that the faces run into, the energy of
    each direction for itself must be positive, else it grows: what W has off its diagonal takes from it, and
    is kept only as far as t of the heavier side allows; the rest goes to the diagonal.
    """
    across = _APART[:, axis] == 1
    straight = across & (_APART.sum(axis=1) == 1)
    uniform = uniform_coupling(stencil)
    beside = np.where(across, 0, _by_steps(stencil)[np.minimum(_APART.sum(axis=1) + 1, 3)])
    share = volumes.mean(axis=1)
    density = share @ materials.density
    side = VERTICES[:, axis]
    held = [(number[:, side == plane, None] == np.arange(share.shape[1])).any(axis=1) for plane in (0, 1)]
    part = np.stack((1.0 + held[0] - held[1], 1.0 + held[1] - held[0]))
    mobility = (part * share) @ (1 / materials.density)
    along = mobility[side[PAIRS[:, 0]]].T
    sides = materials.density[number]
    lightest, heaviest = sides.min(axis=1), sides.max(axis=1)
    heavy = np.where(materials.density >= heaviest[:, None], share, 0).sum(axis=1)
    allowed = (lightest / heaviest + 1) / 2 + _SPARE * heavy
    kept = np.minimum(1, allowed * density / heaviest)[:, None]
    even = np.where(straight, uniform[across].sum() / 4, 0)
    link = np.where(across, kept * uniform + (1 - kept) * even, -kept * beside) / density[:, None]
    return np.asarray(np.where(across, 0, along * (uniform + beside)) + link)


def uniform_coupling(stencil: Stencil) -> Array:
    """Bonds (28,) of an element of air; face coupling are shared by four elements, edge coupling by two."""
    return np.asarray(_by_steps(stencil)[_APART.sum(axis=1)])


def _by_steps(stencil: Stencil) -> Array:
    """Bonds of an element of air between vertices that are 0 to 3 of its edges apart."""
    return np.array((0.0, stencil.face / 4, stencil.edge / 2, stencil.corner))


def _volume_coverage(distance: Array) -> Array:
    """Share of each sub-cell (..., 64) with a distance below zero: exact for faces along the grid."""
    cube = distance.reshape(*distance.shape[:-1], *(SUBCELLS + 1,) * 3)
    mean, *slopes = (_over_subcells(cube, along) for along in (None, -3, -2, -1))
    width = np.abs(slopes).sum(axis=0)
    share = np.clip(0.5 - mean / np.maximum(width, 1e-12), 0, 1)
    return np.asarray(share.reshape(*distance.shape[:-1], SUBCELLS**3))


def _over_subcells(cube: Array, along: int | None) -> Array:
    """Mean over the corners of each sub-cell, of the values or of their differences along an axis."""
    for axis in (-3, -2, -1):
        low, high = np.take(cube, _LOW, axis), np.take(cube, _LOW + 1, axis)
        cube = high - low if axis == along else (low + high) / 2
    return cube


def _line_coverage(distance: Array) -> Array:
    """Share of each quarter of the lines between vertices (..., 112) with a distance below zero."""
    ends = distance[..., _LINES]
    low = np.minimum(ends[..., :-1], ends[..., 1:])
    high = np.maximum(ends[..., :-1], ends[..., 1:])
    share = np.clip(-low / np.maximum(high - low, 1e-12), 0, 1)
    return np.asarray(share.reshape(*distance.shape[:-1], -1))


def _shares(
    coverage: Callable[[Array], Array], distance: Array, material: NDArray[np.int64], count: int
) -> Array:
    """Share of each material (n, q, m) in the q parts that `coverage` divides an element into.

    Obstacles that touch leave no air between them: what is not air is what their union covers.
    """
    covered = coverage(distance)
    share = np.zeros((*covered.shape[1:], count))
    for cover, number in zip(covered, material, strict=True):
        share *= 1 - cover[..., None]
        share[..., number] += cover
    solid = share.sum(axis=2)
    union = coverage(distance.min(axis=0))
    share *= np.divide(union, solid, out=np.zeros_like(solid), where=solid > 0)[..., None]
    share[..., 0] += 1 - union
    return share


def _level(distance: Array, material: NDArray[np.int64], inner: NDArray[np.int64]) -> Array:
    """Signed distance (n, 125) to the region of material `inner` (n,), cut by later obstacles."""
    level = np.full(distance.shape[1:], FAR)
    for far, number in zip(distance, material, strict=True):
        same = (inner == number)[:, None]
        level = np.where(same, np.minimum(level, far), np.maximum(level, -far))
    return level


def _correction(
    level: Array, sides: Array, volumes: Array, materials: Materials, coupling: Array
) -> tuple[NDArray[np.bool_], Array]:
    """Bonds that give the local solutions of two-material elements their exact energy.

    Args:
        level: signed distance to the surface (n, 125), negative in the inner material.
        sides: density of the outer and the inner material (n, 2).
        volumes: shares of the materials in the sub-cells (n, 64, m).
        materials: the materials.
        coupling: in series (n, 28).

    Returns:
        Which elements have one normal (n,), and the coupling to add in those.
    """
    fit = level @ _FIT.T
    steep = np.linalg.norm(fit[:, 1:4], axis=1)
    flat = steep > _FLAT
    level, sides, volumes, coupling, fit, steep = (
        part[flat] for part in (level, sides, volumes, coupling, fit, steep)
    )
    normal = fit[:, 1:4] / steep[:, None]
    tangents = _tangents(normal)
    bend = _curvature(fit, tangents)

    # The fields at the vertices: surface coordinates of the foot of the vertex, and the kinked one.
    depth = level[:, _CORNERS]
    along = (VERTICES - 0.5) @ tangents.transpose(0, 2, 1)
    along = along - depth[:, :, None] * (along @ bend)
    kinked = np.where(depth < 0, sides[:, 1:], sides[:, :1]) * depth
    fields = np.concatenate((along, kinked[:, :, None]), axis=2)

    # The energies of the first two, summed over the sub-cells.
    depth = level.reshape(-1, *(SUBCELLS + 1,) * 3)
    for axis in (1, 2, 3):
        depth = (np.take(depth, _LOW, axis) + np.take(depth, _LOW + 1, axis)) / 2
    depth = depth.reshape(len(depth), SUBCELLS**3)
    stretch = np.eye(2) - depth[:, :, None, None] * bend[:, None]
    mobility = (volumes @ (1 / materials.density)) / SUBCELLS**3
    energy = np.zeros((len(level), 3, 3))
    energy[:, :2, :2] = np.einsum("nq,nqab,nqcb->nac", mobility, stretch, stretch)

    matrix = stiffness_matrix(coupling)
    flow = matrix @ fields
    own = fields.transpose(0, 2, 1) @ flow
    energy[:, 2, 2] = own[:, 2, 2]
    projection = np.linalg.solve(own, flow.transpose(0, 2, 1))
    added = projection.transpose(0, 2, 1) @ (energy - own) @ projection
    return flat, -added[:, PAIRS[:, 0], PAIRS[:, 1]]


def _tangents(normal: Array) -> Array:
    """Two unit vectors (n, 2, 3) across unit vectors (n, 3)."""
    helper = np.where(np.abs(normal[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(normal, first)), axis=1)


def _curvature(fit: Array, tangents: Array) -> Array:
    """Curvature (n, 2, 2) [1/cells] along the surface, none where it is too sharp to follow."""
    hessian = np.zeros((len(fit), 3, 3))
    for column, (a, b) in enumerate(_SECOND, start=4):
        hessian[:, a, b] = hessian[:, b, a] = fit[:, column]
    bend = tangents @ hessian @ tangents.transpose(0, 2, 1)
    sharp = np.abs(np.linalg.eigvalsh(bend)).max(axis=1) > _SHARPEST
    bend[sharp] = 0
    return bend


def stiffness_matrix(coupling: Array) -> Array:
    """Energy matrix (n, 8, 8) of coupling (n, 28)."""
    matrix = np.zeros((len(coupling), 8, 8))
    matrix[:, PAIRS[:, 0], PAIRS[:, 1]] = -coupling
    matrix += matrix.transpose(0, 2, 1)
    matrix[:, range(8), range(8)] = -matrix.sum(axis=2)
    return matrix


def _masses(number: NDArray[np.int64], volumes: Array, materials: Materials) -> Array:
    """Masses at the vertices (n, 8): each material's goes to the vertices in it, if there are any."""
    total = np.zeros(number.shape)
    for own, mass in enumerate(materials.mass):
        lumped = volumes[:, :, own] @ _HATS / SUBCELLS**3
        kept = lumped * (number == own)
        whole, held = lumped.sum(axis=1, keepdims=True), kept.sum(axis=1, keepdims=True)
        has = held > _PRESENT * whole
        total += mass * np.where(has, kept * whole / np.where(has, held, 1), lumped)
    return total
