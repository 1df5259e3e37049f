"""Repair of surfaces that enclose nothing as they are: scans with holes, turned triangles, crossing parts.

Local faults are mended first: vertices that nearly agree, doubled triangles, orientation, stray pieces and
holes. A surface that still crosses itself is replaced by a new one. Winding numbers tell its inside from its
outside (Jacobson et al. 2013, doi:10.1145/2461912.2461916), for any set of triangles.
"""

from __future__ import annotations

import contextlib
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from autdtorch.scene.obstacles.mesh_parts import place_of, winding_number, without_sheets
from autdtorch.scene.obstacles.mesh_solid import (
    Triangles,
    joined,
    open_edges,
    require_triangles,
    solid_of,
)
from autdtorch.scene.obstacles.polygons import Polygons, triangulated
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import areas_of, sides_of

_FARTHEST = 1.0001e-3  # distance between vertices that are taken as one, relative to the extent
_STRAY = 1e-3  # share of all area below which an open piece is no part of the body
_LARGEST_HOLE = 0.3  # largest area of a hole that is closed, relative to the surface
_CELLS = 160  # cells along the longest side of a new surface


class Repaired(NamedTuple):
    """A closed surface, and what was done to it."""

    vertices: Array  # (V, 3)
    faces: Index  # (F, 3)
    done: list[str]


def repaired(corners: Array, triangles: Index) -> Repaired:
    """Return the solid of triangles with faults, and what was mended, with numbers and places.

    Raises:
        ValueError: a sheet without an inside, a hole too large to guess, or what are no triangles of the
            vertices; the message names it.
    """
    require_triangles(corners, triangles)
    with contextlib.suppress(ValueError):
        return Repaired(*solid_of(corners, triangles), [])
    done: list[str] = []
    vertices, faces = joined(corners, triangles, _FARTHEST)
    faces = without_sheets(faces)
    if not len(faces):
        raise ValueError("no triangle has an area; must enclose a volume")
    faces = _without_doubles(faces, done)
    faces = _without_strays(vertices, faces, done)
    faces = _oriented(vertices, faces, done)
    vertices, faces = _closed(vertices, faces, done)
    try:
        return Repaired(
            *solid_of(vertices, faces), done or [f"joined vertices up to {_FARTHEST:.0e} of its extent apart"]
        )
    except ValueError as error:
        return Repaired(*_anew(vertices, faces, done, str(error)), done)


def _without_doubles(faces: Index, done: list[str]) -> Index:
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) < len(faces):
        done.append(f"left out {len(faces) - len(first)} triangles that were there twice")
    return faces[np.sort(first)]


def _without_strays(vertices: Array, faces: Index, done: list[str]) -> Index:
    import igl

    _, label = igl.facet_components(faces)
    area = np.bincount(label, weights=areas_of(vertices[faces]))
    is_open = np.zeros(len(area), bool)
    is_open[label[np.isin(faces, open_edges(faces)).any(axis=1)]] = True
    stray = is_open & (area < _STRAY * area.sum())
    if stray.all():
        parts = f"{len(area)} open pieces, each of less than {_STRAY:.1%} of all area"
        raise ValueError(f"{parts}; must be triangles with common edges")
    if stray.any():
        left_out = faces[stray[label]]
        place = place_of(vertices[left_out[0, 0]])
        done.append(f"left out {stray.sum()} stray pieces of {len(left_out)} triangles, the first at {place}")
    return np.asarray(faces[~stray[label]])


def _oriented(vertices: Array, faces: Index, done: list[str]) -> Index:
    """Turn triangles so that neighbours agree and most of each piece faces outwards."""
    import igl

    before, (faces, label) = faces, igl.bfs_orient(faces)
    corners = vertices[faces]
    center = [np.bincount(label, middle) for middle in corners.mean(axis=1).T] / np.bincount(label)
    volume = np.bincount(label, np.linalg.det(corners - center.T[label, None]))  # six times
    faces = np.where((volume < 0)[label, None], faces[:, ::-1], faces)
    turned = (faces != before).any(axis=1)
    if turned.any():
        place = place_of(vertices[faces[turned][0]].mean(axis=0))
        done.append(f"turned {turned.sum()} triangles over, the first at {place}")
    return faces


def _closed(vertices: Array, faces: Index, done: list[str]) -> Triangles:
    """Close holes by their flat outlines, or by a fan around their middle."""
    area, closed = areas_of(vertices[faces]).sum(), []
    for loop in _outlines(faces):
        rim = vertices[loop]
        try:
            patch = loop[triangulated(Polygons(rim, np.array([len(loop)]), np.arange(len(loop))))]
        except ValueError:  # its outline crosses itself when flat
            vertices = np.concatenate([vertices, rim.mean(axis=0)[None]])
            patch = np.stack([loop, np.roll(loop, -1), np.full(len(loop), len(vertices) - 1)], axis=1)
        share = areas_of(vertices[patch]).sum() / area
        size = f"{len(loop)} edges and {float(np.ptp(rim, axis=0).max()):.3g}"
        hole = f"a hole of {size} at {place_of(rim.mean(axis=0))}"
        if share > _LARGEST_HOLE:
            most = f"must be at most {_LARGEST_HOLE:.0%} of that of a body"
            raise ValueError(f"{hole}, {share:.0%} of all area; {most}")
        faces = np.concatenate([faces, patch])
        closed.append((share, hole))
    if closed:
        largest = max(closed)[1]
        many = f"{len(closed)} holes, the largest {largest.removeprefix('a hole ')}"
        done.append(f"closed {largest if len(closed) == 1 else many}")
    return vertices, faces


def _outlines(faces: Index) -> list[Index]:
    """Return the holes as runs of vertices, in the direction of the faces that close them."""
    ends = sides_of(faces)
    here = {tuple(end) for end in ends.tolist()}
    follow: dict[int, list[int]] = {}
    for begin, end in sorted(here):
        if (end, begin) not in here:
            follow.setdefault(end, []).append(begin)
    loops = []
    while follow:
        loop = [next(iter(follow))]
        while loop[-1] in follow:
            place = follow[loop[-1]].pop()
            if not follow[loop[-1]]:
                del follow[loop[-1]]
            if place in loop:  # closed, perhaps at a vertex where two holes meet
                begin = loop.index(place)
                loops += [np.array(loop[begin:])] if len(loop) - begin >= 3 else []
                loop = loop[: begin + 1]
            else:
                loop.append(place)
    return loops


def _anew(vertices: Array, faces: Index, done: list[str], reason: str) -> Triangles:
    """Return a new surface around the points that the triangles wind around at least half."""
    import igl

    lower, upper = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
    cell = float((upper - lower).max()) / _CELLS
    counts = np.ceil((upper - lower) / cell).astype(int) + 5
    axes = [low + cell * (np.arange(count) - 2) for low, count in zip(lower, counts, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).transpose(2, 1, 0, 3).reshape(-1, 3)
    inside = np.abs(winding_number(vertices, faces, places)) > 0.5
    # Winding numbers jump at the surface: their level set would have steps. Distances do not.
    grown, shrunk = (
        each(inside.reshape(counts[::-1]), iterations=2).ravel() for each in (binary_dilation, binary_erosion)
    )
    near = grown & ~shrunk
    distance = np.full(len(places), 4 * cell)
    distance[near] = np.sqrt(igl.point_mesh_squared_distance(places[near], vertices, faces)[0])
    corners, triangles, _ = igl.marching_cubes(np.where(inside, -distance, distance), places, *counts, 0.0)
    if not len(triangles):
        raise ValueError(
            f"{reason}; it has no inside that winding numbers would tell; must be a body, not a sheet"
        )
    done.append(f"made the surface anew on cells of {cell:.3g}, as {reason.split(';')[0]}")
    return solid_of(corners, triangles)
