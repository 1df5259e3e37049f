"""Loops over the lattices and sub-cells of elements, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

from autdtorch.utils.compiled import INNER, entry

_LEAST_WIDTH = 1e-12
_BEYOND = 3.01  # Distance [cells] from the first vertex of an element of a body that does not touch it


@njit(**INNER)
def _cover(level, rows, planes, covered):  # type: ignore[no-untyped-def]
    """Write the share of each sub-cell (64,) inside a body, from signed distances (125,); exact along axes.

    `rows` (2, 4, 25) and `planes` (3, 4, 4, 5) are for means and slopes.
    """
    for x in range(4):
        for point in range(25):
            low, high = level[25 * x + point], level[25 * x + 25 + point]
            rows[0, x, point], rows[1, x, point] = (low + high) / 2, high - low
    for x in range(4):
        for y in range(4):
            for z in range(5):
                low, high = rows[0, x, 5 * y + z], rows[0, x, 5 * y + 5 + z]
                planes[0, x, y, z], planes[1, x, y, z] = (low + high) / 2, high - low
                planes[2, x, y, z] = (rows[1, x, 5 * y + z] + rows[1, x, 5 * y + 5 + z]) / 2
    for x in range(4):
        for y in range(4):
            for z in range(4):
                low, high = planes[0, x, y, z], planes[0, x, y, z + 1]
                width = abs(planes[2, x, y, z] + planes[2, x, y, z + 1]) / 2
                width += abs(planes[1, x, y, z] + planes[1, x, y, z + 1]) / 2 + abs(high - low)
                share = 0.5 - (low + high) / 2 / max(width, _LEAST_WIDTH)
                covered[16 * x + 4 * y + z] = min(max(share, 0.0), 1.0)


@entry()
def cover_subcells(distance, covered):  # type: ignore[no-untyped-def]
    """Write the share of each sub-cell inside a body (n, 64), from distances at the lattices (n, 125)."""
    rows, planes = np.empty((2, 4, 25)), np.empty((3, 4, 4, 5))
    for row in range(len(distance)):
        _cover(distance[row], rows, planes, covered[row])


@entry()
def mix_materials(distance, grown, material, values, mixed):  # type: ignore[no-untyped-def]
    """Write the means of values over the materials in each sub-cell.

    Bodies that touch leave no air between them: the union of all decides the share of air, the last one the
    material.

    Args:
        distance: signed distances of bodies at the lattices of elements (K, n, 125).
        grown: distances by which the bodies are grown (K, n).
        material: number of the material of each body (K,).
        values: of the materials (v, m); those of air, number 0, first.
        mixed: the means (v, n, 64), to be written.
    """
    rows, planes = np.empty((2, 4, 25)), np.empty((3, 4, 4, 5))
    level, nearest, covered, solid = np.empty(125), np.empty(125), np.empty(64), np.empty(64)
    for row in range(distance.shape[1]):
        nearest[:], solid[:], mixed[:, row] = _BEYOND, 0.0, 0.0
        for body in range(len(distance)):
            if distance[body, row, 0] > _BEYOND:
                continue
            for point in range(125):
                level[point] = distance[body, row, point] - grown[body, row]
                nearest[point] = min(nearest[point], level[point])
            _cover(level, rows, planes, covered)
            for cell in range(64):
                solid[cell] += covered[cell] * (1 - solid[cell])
                for number in range(len(values)):
                    mixed[number, row, cell] *= 1 - covered[cell]
                    mixed[number, row, cell] += covered[cell] * values[number, material[body]]
        _cover(nearest, rows, planes, covered)
        for cell in range(64):
            union = covered[cell] / solid[cell] if solid[cell] > 0.0 else 0.0
            for number in range(len(values)):
                solids = mixed[number, row, cell] * union
                mixed[number, row, cell] = solids + (1 - covered[cell]) * values[number, 0]


@entry()
def survey_lattices(distance, most_variation, least, most, layered):  # type: ignore[no-untyped-def]
    """Write the least and most of distances at lattices (K, n, 125), and along which axes alone they vary.

    Args:
        distance: signed distances.
        most_variation: largest variation across an axis that counts as none.
        least: (K, n), to be written.
        most: (K, n), to be written.
        layered: (K, n, 3), to be written.
    """
    for body in range(distance.shape[0]):
        for row in range(distance.shape[1]):
            cube = distance[body, row]
            low = high = cube[0]
            for point in range(125):
                low, high = min(low, cube[point]), max(high, cube[point])
            least[body, row], most[body, row] = low, high
            for axis in range(3):
                along = 25 if axis == 0 else 5 if axis == 1 else 1
                one, other = 5 if axis == 0 else 25, 5 if axis == 2 else 1
                flat = True
                for place in range(5):
                    if not flat:
                        break
                    low = high = cube[along * place]
                    for point in range(25):
                        value = cube[along * place + one * (point // 5) + other * (point % 5)]
                        low, high = min(low, value), max(high, value)
                    flat = high - low < most_variation
                layered[body, row, axis] = flat
