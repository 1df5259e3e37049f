"""Elements at edges between two faces parallel to the grid.

The field at an edge is singular: in a plane across it, long waves are sums of r^v cos(v phi) and of
r^v sin(v phi) with exponents v that the densities decide (2/3 at a sound-hard edge). The coupling of the
element at the edge is fitted so that the scheme reproduces the first of them on the cells around it. Without
this, the error of a cuboid depends on where its faces fall, and is up to twenty times as large.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from autdtorch.fdtd.assembly.aligned_faces import constant_along, matched
from autdtorch.fdtd.assembly.coverage import distance_to_material
from autdtorch.fdtd.assembly.element import (
    LATTICE,
    PAIRS,
    SUBCELLS,
    VERTICES,
    Materials,
    coupling_by_edges,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

# Share of an element by which its materials may differ from quadrants. Shares are inexact near edges, by
# 0.125 where two touch.
_FITS = 0.15
_SAME = 1e-9  # Difference of depths [cells] up to which edges share their coupling
_RADIUS = 3  # Elements on each side of the edge in the plane of the fit
_SQUARES = 64  # Squares along each side of an element, for the areas beside an edge
_LONG = 1e-3  # Wavenumber of a long wave [rad/cell]
_ROUNDING = 1e-9  # Angle [rad], or value of a sine, up to which it is zero
# Weight of the coupling in series, for what the fields do not determine
_PRIOR = 1e-4
_EXACT = 1e-12  # Relative tolerance of the fit: symmetric scenes stay so
_CORNERS = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])  # Columns of an element, from the one at the edge
# Columns within the material of one edge, and of two that touch along it
_CORNER, _DIAGONAL = np.array((True, False, False, False)), np.array((True, False, False, True))
_COLUMN_PAIRS = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
_MIRRORED = [1, 0, 2, 3, 5, 4]  # The pairs after both axes are exchanged
_TURNED = [4, 5, 2, 3, 0, 1]  # The pairs after the first and the last column are exchanged, too
# Three orthogonal differences of the columns, and the places of a triangular matrix
_DIFFERENCES = np.array([(1, 0, 1), (-1, 0, 1), (0, 1, -1), (0, -1, -1)]) / np.sqrt((2, 2, 4))
_LOWER = np.tril_indices(3)
_SIDES = np.abs(_CORNERS[_COLUMN_PAIRS[:, 0]] - _CORNERS[_COLUMN_PAIRS[:, 1]]).sum(axis=1)


def edge_elements(
    distance: Array,
    material: Index,
    vertex: Index,
    volumes: Array,
    materials: Materials,
    stencil: Stencil,
) -> tuple[Index, Array, Array]:
    """Return the indices (k,) of elements at an edge parallel to the grid, their coupling and mass.

    Arguments are signed distances (K, n, 125) of bodies, their materials (K,), those at the vertices (n, 8),
    and shares in the sub-cells (n, 64, m). Coupling is (k, 28) and mass (k, 8).
    """
    found = [(np.zeros(0, np.int64), np.zeros((0, 28)), np.zeros((0, 8)))]
    for axis in range(3):
        along = constant_along(volumes, (axis,))
        for first, inside in itertools.product(_CORNERS, (_CORNER, _DIAGONAL)):
            columns = _columns(axis, first)
            held = vertex[:, columns]
            pair = held[:, :2, 0]
            edge = (held == np.where(inside[:, None], pair[:, None, :1], pair[:, None, 1:])).all(axis=(1, 2))
            # two edges that touch are those of the heavier material
            denser = materials.density[pair[:, 0]] > materials.density[pair[:, 1]]
            edge &= denser if inside is _DIAGONAL else pair[:, 0] != pair[:, 1]
            rows = np.flatnonzero(along & edge)
            level = distance_to_material(distance[:, rows], material, pair[rows, 0])
            share = np.take_along_axis(volumes[rows], pair[rows, :1, None], axis=2)[:, :, 0]
            depth, good = _depths(level, share, axis, first, inside)
            rows, depth = rows[good], depth[good]
            if len(rows):
                found.append((rows, *_assembled(depth, pair[rows], inside, columns, materials, stencil)))
    index, coupling, mass = (np.concatenate(part) for part in zip(*found, strict=True))
    # two edges that touch are found from either: with a gap between them, their mean keeps the symmetry
    index, place, count = np.unique(index, return_inverse=True, return_counts=True)
    totals = np.zeros((len(index), 28)), np.zeros((len(index), 8))
    for total, part in zip(totals, (coupling, mass), strict=True):
        np.add.at(total, place.ravel(), part)
        total /= count[:, None]
    return index, *totals


def _columns(axis: int, first: Array) -> Index:
    """Return the vertices (4, 2) of the columns along an axis, from the column at `first` (2,)."""
    places = np.delete(VERTICES, axis, axis=1)
    return np.stack([np.flatnonzero((places == np.abs(first - corner)).all(axis=1)) for corner in _CORNERS])


def _depths(
    level: Array, share: Array, axis: int, first: Array, inside: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the distance [cells] of the next columns (k, 2) from the faces between them and the first.

    Also return where the material fills the quadrants of the columns `inside` (4,). `level` (k, 125) is the
    signed distance to it, `share` (k, 64) its share of the sub-cells. A signed distance may be too small near
    other faces, inside or outside: of both sides of a face, those are taken that fit the shares best.
    """
    places = [
        np.abs(LATTICE[:, other] - begin)
        for other, begin in zip(np.delete(range(3), axis), first, strict=True)
    ]
    sides = []
    for number in (0, 1):
        on_line = np.flatnonzero((places[1 - number] == 0) & (LATTICE[:, axis] == 0))
        on_line = on_line[np.argsort(places[number][on_line])]
        line = level[:, on_line]
        end = np.maximum(1, (line > 0).argmax(axis=1))
        sides.append([end_of / SUBCELLS - line[range(len(line)), end_of] for end_of in (end, end - 1)])
    square = np.moveaxis(share.reshape(-1, *(SUBCELLS,) * 3), axis + 1, 3).mean(axis=3)
    square = square[:, :: 1 - 2 * first[0], :: 1 - 2 * first[1]]
    pairs = np.stack([np.stack(pair, axis=1) for pair in itertools.product(*sides)])
    missed = np.abs(_areas(pairs, inside, SUBCELLS) - square).mean(axis=(2, 3))
    best = missed.min(axis=0)
    # the mean of those that fit alike: mirrored surfaces have mirrored depths
    alike = (missed <= best + _SAME)[..., None]
    return 1 - (alike * pairs).sum(axis=0) / alike.sum(axis=0), best < _FITS


def _areas(faces: Array, inside: NDArray[np.bool_], squares: int) -> Array:
    """Return the shares (..., s, s) of squares in the quadrants `inside` (4,) beside `faces` (..., 2)."""
    below = np.clip(squares * faces[..., None] - np.arange(squares), 0, 1)
    sides = np.stack((below, 1 - below), axis=-2)  # (..., axis, side, square)
    parts = [
        sides[..., 0, x, :, None] * sides[..., 1, y, None, :] for x, y in _CORNERS[np.flatnonzero(inside)]
    ]
    return np.asarray(sum(parts))


def _assembled(
    depth: Array,
    pair: Index,
    inside: NDArray[np.bool_],
    columns: Index,
    materials: Materials,
    stencil: Stencil,
) -> tuple[Array, Array]:
    """Return coupling (k, 28) and mass (k, 8) of elements by their depths and materials (k, 2)."""
    keys = np.column_stack((pair, (depth / _SAME).round())).astype(np.int64)
    keys, number = np.unique(keys, axis=0, return_inverse=True)
    coupling, mass = np.zeros((len(keys), 28)), np.zeros((len(keys), 8))
    for row, (inner, outer, *places) in enumerate(keys):
        faces, own = (places[0] * _SAME, places[1] * _SAME), [inner, outer]
        density, light = materials.density[own], materials.mass[own]
        flat = edge_coupling(faces, (float(density[0]), float(density[1])), stencil, bool(inside[3]))
        shares = _lumped(faces, density, inside)
        coupling[row] = _extruded(flat, (1 / density) @ shares, columns, stencil)
        mass[row, columns] = (light @ shares / 2)[:, None]
    return coupling[number.ravel()], mass[number.ravel()]


def _lumped(depth: tuple[float, float], density: Array, inside: NDArray[np.bool_]) -> Array:
    """Return the volumes (2, 4) of both materials that count for each column.

    A column takes less from the other material, by the share of the flow from there that reaches it.
    """
    within = _areas(1 - np.array(depth), inside, _SQUARES)
    x, y = np.meshgrid(*((np.arange(_SQUARES) + 0.5) / _SQUARES,) * 2, indexing="ij")
    hats = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])
    across = np.minimum(1, density / density.mean())
    shares = []
    for own, area, columns in ((0, within, inside), (1, 1 - within, ~inside)):
        part = hats * np.where(columns, 1, across[own])[:, None, None]
        shares.append((area * part / part.sum(axis=0)).mean(axis=(1, 2)))
    return np.stack(shares)


def _extruded(flat: Array, mobility: Array, columns: Index, stencil: Stencil) -> Array:
    """Return coupling (28,) from that across the edge (6,) and the mobility of each column (4,) along it.

    The energy across the edge is averaged over both ends of the columns; each column adds its own along it.
    """
    by_edges, matrix = coupling_by_edges(stencil), np.zeros((8, 8))
    along = mobility.copy()
    for (one, other), sides, each in zip(_COLUMN_PAIRS, _SIDES, flat, strict=True):
        for end in (0, 1):
            matrix[columns[one, end], columns[other, end]] = by_edges[sides] * each
            matrix[columns[one, end], columns[other, 1 - end]] = by_edges[sides + 1] * each
        along[[one, other]] -= by_edges[sides + 1] * each
    matrix[columns[:, 0], columns[:, 1]] = along
    return np.asarray((matrix + matrix.T)[PAIRS[:, 0], PAIRS[:, 1]])


def edge_coupling(
    depth: tuple[float, float], density: tuple[float, float], stencil: Stencil, diagonal: bool = False
) -> Array:
    """Return the coupling (6,) of pairs of columns at an edge, relative to air.

    `depth` is the distance [cells] of the next columns from the faces of the first column's material,
    `density` holds the densities of this material and of the other. `diagonal`: two such edges touch. The
    mean over the images of an edge keeps symmetric scenes symmetric.
    """
    turned = (1 - depth[1], 1 - depth[0])  # each of two edges in the place of the other
    images = [(depth, [0, 1, 2, 3, 4, 5])] + ([(turned, _TURNED)] if diagonal else [])
    images += [(place[::-1], [order[one] for one in _MIRRORED]) for place, order in images]
    fits = [_edge_coupling(place, density, stencil, diagonal)[order] for place, order in images]
    return np.asarray(sum(fits) / len(fits))


@lru_cache(maxsize=4096)
def _edge_coupling(
    depth: tuple[float, float], density: tuple[float, float], stencil: Stencil, diagonal: bool
) -> Array:
    """Fit the element at the edge in a plane across it, among elements of one material or with one face."""
    by_edges, side = coupling_by_edges(stencil), np.arange(-_RADIUS, _RADIUS + 2)
    uniform = 2 * by_edges[_SIDES] + 2 * by_edges[_SIDES + 1]
    places = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    out = np.abs(places - 0.5).max(axis=1)
    given, judged = out > _RADIUS, out > 1
    fields = (_diagonal_fields if diagonal else _corner_fields)(places - 1 + np.array(depth), density)
    fields /= np.abs(fields[given]).max(axis=0)
    matrix = np.zeros((len(places),) * 2)
    for x, y in itertools.product(side[:-1], side[:-1]):
        if x or y:
            _add(matrix, (x, y), _beside((x, y), depth, density, uniform, diagonal))
    inner, outer = density
    # share of the lines within the edge
    own = np.array((1 - depth[0], 1 - depth[1], 1 - max(depth), 0, 0, 0))
    series = uniform / (own * inner + (1 - own) * outer)

    parts = np.zeros((6, *matrix.shape))
    for part, unit in zip(parts, np.eye(6), strict=True):
        _add(part, (0, 0), unit)
    free, chosen = ~given, judged[~given]
    solution = fields.copy()

    def solved(coupling: Array) -> Array:
        """Return the inverse for the cells between; their pressures are left in `solution`."""
        whole = (matrix + np.tensordot(coupling, parts, axes=1))[free]
        inverse = np.linalg.inv(whole[:, free])
        solution[free] = -inverse @ whole[:, given] @ fields[given]
        return np.asarray(inverse)

    def missed(root: Array) -> Array:
        coupling = _coupling_of(root, root)
        solved(coupling)
        wrong = (solution - fields)[free][chosen]
        return np.concatenate((wrong.ravel(), _PRIOR * (coupling / series - 1)))

    def slopes(root: Array) -> Array:
        moved = -solved(_coupling_of(root, root)) @ (parts @ solution)[:, free]
        by_coupling = np.concatenate((moved[:, chosen].reshape(6, -1).T, _PRIOR * np.diag(1 / series)))
        return 2 * by_coupling @ np.stack([_coupling_of(root, unit) for unit in np.eye(6)], axis=1)

    root = least_squares(missed, _root_of(series), slopes, xtol=_EXACT, ftol=_EXACT, gtol=_EXACT).x
    return np.asarray(_coupling_of(root, root) / uniform)


def _coupling_of(root: Array, other: Array) -> Array:
    """Return the coupling (6,) of the symmetric part of B R S^T B^T, with R and S triangular from (6,) each.

    B spans the differences of the columns. With R = S no energy is negative.
    """
    first, second = np.zeros((2, 3, 3))
    first[_LOWER], second[_LOWER] = root, other
    half = _DIFFERENCES @ first @ (_DIFFERENCES @ second).T
    return np.asarray(-(half + half.T)[tuple(_COLUMN_PAIRS.T)] / 2)


def _root_of(coupling: Array) -> Array:
    """Return the triangular matrix (6,) that has a coupling (6,) of positive energy."""
    matrix = np.zeros((4, 4))
    matrix[tuple(_COLUMN_PAIRS.T)] = -coupling
    matrix += matrix.T
    matrix[range(4), range(4)] = -matrix.sum(axis=1)
    return np.asarray(np.linalg.cholesky(_DIFFERENCES.T @ matrix @ _DIFFERENCES)[_LOWER])


def _add(matrix: Array, first: tuple[int, int], coupling: Array) -> None:
    """Add the coupling (6,) of an element, given its first column, to the stiffness matrix of the plane."""
    width = 2 * _RADIUS + 2
    number = (_CORNERS + first + _RADIUS) @ (width, 1)
    for (one, other), value in zip(number[_COLUMN_PAIRS], coupling, strict=True):
        matrix[[one, other], [other, one]] -= value
        matrix[[one, other], [one, other]] += value


def _beside(
    place: tuple[int, int],
    depth: tuple[float, float],
    density: tuple[float, float],
    uniform: Array,
    diagonal: bool,
) -> Array:
    """Return the coupling (6,) of an element that is not at the edge."""
    x, y = place
    if x and y:
        return uniform / density[0 if max(place) < 0 or (diagonal and min(place) > 0) else 1]
    if max(place) > 0 and not diagonal:
        return uniform / density[1]
    axis = place.index(0)  # across the face
    order = [0, 1] if max(place) == 0 else [1, 0]
    planes = np.array([[1 - depth[axis], depth[axis]]])
    link, mobility, _ = matched(planes, np.array(density)[None, order], np.full((1, 2), _LONG))
    one, other = _CORNERS[_COLUMN_PAIRS.T, axis]
    along = mobility[0, one] * (uniform[0] + uniform[2]) - link[0] * uniform[2]
    return np.asarray(np.where(one != other, uniform * link[0], along))


def _diagonal_fields(places: Array, density: tuple[float, float]) -> Array:
    """Return six fields (n, 6) of long waves at places (n, 2) [cells] around two edges that touch.

    They are even or odd about both planes that bisect the edges. If odd about one of them, tan^2(pi v / 4)
    is the ratio of the densities; otherwise v is 2.
    """
    steep = 4 / np.pi * np.arctan(np.sqrt(density[0] / density[1]))
    radius = np.hypot(*places.T)
    turn = np.arctan2(places[:, 1], places[:, 0]) + 3 * np.pi / 4  # from the middle of the first quadrant
    quarter = np.round(turn / (np.pi / 2))
    angle, filled = turn - quarter * np.pi / 2, quarter % 2 == 0
    half = np.where(quarter % 4 < 2, 1, -1)  # of the first of two opposite quadrants
    columns = []
    for v in (steep, 4 - steep):  # even about the first plane
        ratio = -np.cos(v * np.pi / 4) / np.sin(v * np.pi / 4)
        columns.append(
            np.where(filled, half * np.cos(v * angle), ratio * half * np.sin(v * angle)) * radius**v
        )
    for v in (2 - steep, 2 + steep):  # odd about it
        ratio = np.sin(v * np.pi / 4) / np.cos(v * np.pi / 4)
        columns.append(
            np.where(filled, half * np.sin(v * angle), ratio * half * np.cos(v * angle)) * radius**v
        )
    even = np.where(filled, 1, -density[1] / density[0]) * np.cos(2 * angle)
    odd = np.where(filled, 1, -1) * np.sin(2 * angle)
    return np.column_stack((*columns, radius**2 * even, radius**2 * odd))


def _corner_fields(places: Array, density: tuple[float, float]) -> Array:
    """Return six fields (n, 6) of long waves at places (n, 2) [cells] around an edge.

    They are even or odd about the plane that bisects the edge. The densities i within the edge and o around
    it give q = (i - o) / 2 (i + o). Then cos(pi v / 2) is q for odd and -q for even fields; or v is 2.
    """
    inner, outer = density
    lowest = 2 / np.pi * np.arccos((inner - outer) / (2 * (inner + outer)))
    radius = np.hypot(*places.T)
    # zero in the middle of the material within the edge; `back` is zero in the middle of the other
    angle = (np.arctan2(places[:, 1], places[:, 0]) + 7 * np.pi / 4) % (2 * np.pi) - np.pi
    inside, back = np.abs(angle) <= np.pi / 4 + _ROUNDING, np.pi - np.abs(angle)
    columns = []
    for v, odd in ((lowest, 1), (2 - lowest, 0), (2.0, 0), (2.0, 1), (2 + lowest, 0), (4 - lowest, 1)):
        value, slope = (np.sin, np.cos) if odd else (np.cos, lambda phase: -np.sin(phase))
        here, there = v * np.pi / 4, v * 3 * np.pi / 4
        if abs(value(there)) > _ROUNDING:
            ratio = value(here) / value(there)
        else:  # zero at the faces, where the flow is continuous
            ratio = -outer / inner * slope(here) / slope(there)
        field = np.where(inside, value(v * np.abs(angle)), ratio * value(v * back))
        columns.append(radius**v * np.where(odd & (angle < 0), -1, 1) * field)
    return np.stack(columns, axis=1)
