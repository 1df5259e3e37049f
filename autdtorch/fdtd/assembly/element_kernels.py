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
    """Write the means of values over the materials in each sub-cell; see `element.shares`.

    Args:
        distance: signed distances of bodies at the lattices of elements (K, n, 125).
        grown: distances by which the bodies are grown (K, n).
        material: number of the material of each body (K,).
        values: of the materials (v, m); those of air, number 0, first.
        mixed: the means (v, n, 64), to be written.
    """
    rows, planes = np.empty((2, 4, 25)), np.empty((3, 4, 4, 5))
    level, nearest = np.empty(125), np.empty(125)
    covered, united, union = np.empty(64), np.empty(64), np.empty(64)
    for row in range(distance.shape[1]):
        nearest[:], union[:], mixed[:, row], bodies = _BEYOND, 0.0, 0.0, 0
        for body in range(len(distance)):
            if distance[body, row, 0] > _BEYOND:
                continue
            for point in range(125):
                level[point] = distance[body, row, point] - grown[body, row]
                nearest[point] = min(nearest[point], level[point])
            _cover(level, rows, planes, covered)
            bodies += 1
            if bodies > 1:
                _cover(nearest, rows, planes, united)
            for cell in range(64):
                both = max(united[cell], covered[cell], union[cell]) if bodies > 1 else covered[cell]
                left = (both - covered[cell]) / union[cell] if union[cell] > 0.0 else 0.0
                for number in range(len(values)):
                    mixed[number, row, cell] *= left
                    mixed[number, row, cell] += covered[cell] * values[number, material[body]]
                union[cell] = both
        for cell in range(64):
            for number in range(len(values)):
                mixed[number, row, cell] += (1 - union[cell]) * values[number, 0]


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


@entry()
def sum_edges(element, way, normals, part, near, sums):  # type: ignore[no-untyped-def]
    """Write sums over the edges beside each element, as each edge sees them.

    Args:
        element: number of the element (k,), ascending.
        way: from its centre to the edge, relative to the distance of edges that see each other (k, 3).
        normals: of the edge's faces (k, 2, 3).
        part: of the element's length that the edge is beside (k,).
        near: how near the edge is (k,).
        sums: lengths of the edges, as far as their faces agree; of others times how near these are (2, k), to
            be written.
    """
    first, cosines = 0, np.empty(4)
    for one in range(len(element)):
        if element[one] != element[first]:
            first = one
        sums[0, one] = sums[1, one] = 0.0
        other = first
        while other < len(element) and element[other] == element[one]:
            together = 1.0
            for space in range(3):
                together -= (way[one, space] - way[other, space]) ** 2
            if together > 0.0:
                cosines[:] = 0.0
                for pair in range(4):
                    for space in range(3):
                        cosines[pair] += normals[one, pair // 2, space] * normals[other, pair % 2, space]
                    cosines[pair] = max(cosines[pair], 0.0)
                agree = max(cosines[0] * cosines[3], cosines[1] * cosines[2])
                sums[0, one] += agree * together * part[other]
                sums[1, one] += (1 - agree) * together * part[other] * near[other]
            other += 1


@njit(**INNER)
def _cut(depth, outer, inner):  # type: ignore[no-untyped-def]
    """Write the centres (3,) of the parts of a triangle outside a body and inside, and return their shares.

    Centres are barycentric, and arbitrary for a part of no area. `depth` (3,) are the signed distances of its
    corners.
    """
    count = 0
    for corner in range(3):
        outer[corner] = inner[corner] = 1 / 3
        count += 1 if depth[corner] < 0.0 else 0
    if count == 0 or count == 3:
        return 1.0 - count // 3, float(count // 3)
    tip, rest = (inner, outer) if count == 1 else (outer, inner)
    area, alone = 1.0, 0
    for corner in range(3):
        alone = corner if (depth[corner] < 0.0) == (count == 1) else alone
    tip[alone] = 1.0
    for corner in range(3):
        if corner != alone:
            share = depth[alone] / (depth[alone] - depth[corner])
            area *= share
            tip[corner] = share / 3
            tip[alone] -= share / 3
    for corner in range(3):
        rest[corner] = (1 / 3 - area * tip[corner]) / max(1 - area, _LEAST_WIDTH)
    return (1 - area, area) if count == 1 else (area, 1 - area)


@njit(**INNER)
def _set_fields(place, depth, side, axis, normal, tangents, bend, density, local, flow):  # type: ignore[no-untyped-def]
    """Write the local fields (3,) at a place, and their flow along an axis; see `smooth_faces.fields`."""
    along = (0.0, 0.0)
    for space in range(3):
        along = (along[0] + place[space] * tangents[0, space], along[1] + place[space] * tangents[1, space])
    flow[2], local[2] = normal[axis], density[side] * depth
    for field in range(2):
        turn = along[0] * bend[0, field] + along[1] * bend[1, field]  # of the normal
        bent = bend[field, 0] * tangents[0, axis] + bend[field, 1] * tangents[1, axis]
        local[field] = along[field] - depth * turn
        flow[field] = (tangents[field, axis] - depth * bent - turn * normal[axis]) / density[side]
        flow[2] += turn * tangents[field, axis]


@njit(**INNER)
def _set_hats(place, axis, ends, inner, side, beside, hats):  # type: ignore[no-untyped-def]
    """Write the weights (4,) of the vertices of a face for the flow at a place; their sum is one."""
    total = 0.0
    for vertex in range(4):
        hats[vertex] = beside if inner[vertex] != (side == 1) else 1.0
        for space in range(3):
            if space != axis:
                hats[vertex] *= 0.5 + place[space] if ends[vertex, space] == 1 else 0.5 - place[space]
        total += hats[vertex]
    for vertex in range(4):
        hats[vertex] /= total


@entry()
def face_flows(face, surface, middle, inner, beside, near, moments, share):  # type: ignore[no-untyped-def]
    """Write sums over the flow of the local fields through a face of elements.

    Args:
        face: axis, direction, vertices (4, 3), corners (t, 3) of its triangles among the places (p, 3) of the
            lattice, and these places from the element's centre.
        surface: level (n, p), normal (n, 3), tangents (n, 2, 3), bend (n, 2, 2) and density (n, 2).
        middle: mean of the local fields at the vertices (n, 3).
        inner: whether the vertices are in the inner material (n, 4).
        beside: weights of vertices on the other side (n,).
        near: parts of the flow for the vertices (n, 4, 3), to be written.
        moments: of the flow of each field with each field (n, 3, 3), to be written.
        share: of the face in the inner material (n,), to be written.
    """
    axis, outward, ends, triangles, places = face
    level, normal, tangents, bend, density = surface
    depth, centers, place = np.empty(3), np.empty((2, 3)), np.empty(3)
    local, flow, hats = np.empty(3), np.empty(3), np.empty(4)
    for row in range(len(level)):
        near[row], moments[row], share[row] = 0.0, 0.0, 0.0
        for triangle in triangles:
            for corner in range(3):
                depth[corner] = level[row, triangle[corner]]
            areas = _cut(depth, centers[0], centers[1])
            for side in range(2):
                area = areas[side] / len(triangles)
                if area <= 0.0:
                    continue
                place[:], deep = 0.0, 0.0
                for corner in range(3):
                    deep += centers[side, corner] * depth[corner]
                    for space in range(3):
                        place[space] += centers[side, corner] * places[triangle[corner], space]
                _set_fields(
                    place, deep, side, axis, normal[row], tangents[row], bend[row], density[row], local, flow
                )
                _set_hats(place, axis, ends, inner[row], side, beside[row], hats)
                share[row] += area if side == 1 else 0.0
                for field in range(3):
                    passed = outward * area * flow[field]
                    for vertex in range(4):
                        near[row, vertex, field] += hats[vertex] * passed
                    for other in range(3):
                        moments[row, other, field] += (local[other] - middle[row, other]) * passed
