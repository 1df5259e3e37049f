"""Placement of the grid: axis-aligned faces lie about half-way between cell centres where possible.

Elements at faces and edges are accurate to second order wherever these fall (`assembly/prisms.py`). The
remaining error is least for a face half-way, as rigid faces there are mirrors of the stencil. At 8.5 cells
per wavelength, a rigid strip with faces half-way errs by 0.02 %. With faces 0.3 cells behind the last centre
it errs by 0.5 %, at 0.9 by 6 % (measured once). A slit narrower than a cell is more exact if it contains a
layer of centres. Among similar placements the grid takes a symmetric one: a symmetric scene needs fewer runs
(`symmetry.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from autdtorch.fdtd.grid_axes import ALIGNED, slender_faces
from autdtorch.fdtd.region import Fluid, Region
from autdtorch.fdtd.shapes import Shape
from autdtorch.utils.array_types import Array, Index, triple
from autdtorch.utils.spatial import doubled_normals
from autdtorch.utils.validation import LENGTH_TOLERANCE

# Distance of a face from a cell centre [cells] up to which the centre lies on it, and so in the obstacle
_TOUCHING = 1e-6
_ROUNDING = 1e-6  # Excess over whole cells [cells] that needs no further cell
# Candidate placements within a cell, in addition to those with a face half-way between centres. They start
# from a symmetric one, so that mirrored faces have mirrored candidates.
_STEPS = 20
_SYMMETRIC = 0, _STEPS // 2  # Symmetric candidates: a cell or a face between cells in the middle
_WORTHWHILE = 0.9  # Error of an asymmetric placement, relative to the symmetric one, below which it is taken
# Additional distance from the best place [cells, rms] allowed to a symmetric grid if the faces are symmetric:
# a fifth of the largest. With 0.14, errors of the paper's two cubes at 0.4 to 2 mm were 0.55 to 1.75 times
# those of the best placement, 0.85 in the mean (measured once).
_ALLOWANCE = 0.1
_NARROWER = 0.2  # Distance of the faces that represent a slender cylinder from its surface [cells]
_BEST = 0.48  # Best distance of a face behind the last centre [cells]
_STEEPER = 1.7  # Weight of larger distances: edges at 0.74 cells miss 1.5 to 2.5 times as much as at 0.24
_CLOSED = 1.0  # Square error of the faces of a slit without a centre in it
_SAMPLES = 16  # Places along each side of a face at which bodies beside it are looked up
_ROOM = 0.08  # Most by which a spacing is changed for the faces, relative to it
# Square error of the faces [cells^2] below which spacings are equally good: waves err by more than 0.05 cells
_WELL = 0.05**2
_TRIED, _MOST_TRIED = 8, 256  # Spacings tried for each cell by which the longest body changes; most in all


def grid_offset(
    region: Region, spacing: float, lower: Sequence[float], upper: Sequence[float]
) -> tuple[float, float, float]:
    """Return the offset of a grid's first cell below a lower corner (3,) [m], per axis [cells], in [0, 1)."""
    surfaces = [_flat_surface(shape, spacing) for shape in region.shapes]
    return triple(
        _axis_offset(_faces(region, surfaces, axis, low), region.sources[:, axis] - low, high - low, spacing)
        for axis, (low, high) in enumerate(zip(lower, upper, strict=True))
    )


def fitting_spacing(regions: Sequence[Region], spacing: float, coarsest: float = math.inf) -> float:
    """Return the spacing [m] near one, not above a limit, with which the faces of regions fall best.

    Each region has a grid. Without flat faces it is the spacing itself, and of several where they fall well
    the nearest. Behind large bodies, where little arrives past their edges, errors at equal spacings differ
    up to tenfold with the place of the faces.
    """
    faces = []
    for region in regions:
        surfaces = [_flat_surface(shape, spacing) for shape in region.shapes]
        faces += [_faces(region, surfaces, axis, 0.0) for axis in range(3)]
    faces = [each for each in faces if each.shape[1]]
    if not faces:
        return spacing
    longest = max(float(np.ptp(place)) for place, _, _ in faces)
    count = min(_TRIED * (1 + math.ceil(2 * _ROOM * longest / spacing)), _MOST_TRIED)
    tried = np.linspace((1 + _ROOM) * spacing, (1 - _ROOM) * spacing, count).clip(max=coarsest)
    tried = tried[np.abs(tried - spacing).argsort(kind="stable")]
    missed = [
        sum(_placements(place / choice, first, area, 0.0)[1].min() for place, first, area in faces)
        for choice in tried
    ]
    return float(tried[int(np.maximum(missed, _WELL).argmin())])


def _flat_surface(shape: Shape, spacing: float) -> tuple[Array, Array]:
    """Return the first corners (n, 3) [m] of triangles, and their outward normals of twice their area.

    A slender cylinder has the faces of a narrower cuboid in it: half a cell thick, it has no centre in it
    yet.
    """
    vertices, triangles = (part.numpy() for part in shape.surface())
    if slender_faces(vertices / spacing) is None:
        corners = vertices[triangles]
        return corners[:, 0], doubled_normals(corners)
    ends = np.stack((vertices.min(axis=0), vertices.max(axis=0)))
    across = np.delete(np.arange(3), int(np.ptp(ends, axis=0).argmax()))
    ends[:, across] += np.array([[1], [-1]]) * np.minimum(
        _NARROWER * spacing, 0.49 * np.ptp(ends, axis=0)[across]
    )
    size = ends[1] - ends[0]
    areas = 2 * np.prod(size) / size
    return np.repeat(ends, 3, axis=0), np.concatenate((-np.diag(areas), np.diag(areas)))


def _faces(region: Region, surfaces: list[tuple[Array, Array]], axis: int, origin: float) -> Array:
    """Return the faces across an axis within the domain (3, F): distance from `origin` [m], side, area [m^2].

    The side is 1 where the lighter material comes first, and -1 where the heavier does.
    """
    low, high = (corner[axis] for corner in region.domain)
    boxes = np.array([(body.shape.lower, body.shape.upper) for body in region.bodies]).reshape(-1, 2, 3)
    parts = [np.zeros((3, 0))]
    for number, (corner, normal) in enumerate(surfaces):
        double = np.linalg.norm(normal, axis=1)
        aligned = np.abs(normal[:, axis]) > ALIGNED * double
        faces = _joined(corner[aligned, axis], np.sign(normal[aligned, axis]), double[aligned] / 2)
        for place, outward, area in faces[:, (faces[0] > low) & (faces[0] < high)].T.tolist():
            heavier, lighter = _weights(region, boxes, number, axis, place, outward)
            both = [[place - origin] * 2, [-outward, outward], [heavier * area, lighter * area]]
            parts.append(np.array(both))
    place, first, area = np.concatenate(parts, axis=1)
    return _joined(place[area > 0], first[area > 0], area[area > 0])


def _joined(place: Array, side: Array, area: Array) -> Array:
    """Return distinct places and sides of faces, and the sums of their areas (3, F)."""
    faces, number = np.unique(np.stack((place.round(9), side)), axis=1, return_inverse=True)
    return np.vstack((faces, np.bincount(number.ravel(), area, faces.shape[1])))


def _weights(
    region: Region, boxes: Array, number: int, axis: int, place: float, outward: float
) -> tuple[float, float]:
    """Return the weights of a body's face where the body is heavier than what is in front, and lighter.

    The `place` [m] is along an axis; `boxes` (n, 2, 3) [m] are the bounds of all bodies. In front of air the
    weight is 1, inside a later body 0. In front of another body it is the contrast of both: the seam of two
    bodies of one material has none.
    """
    body = region.bodies[number]
    lower, upper = boxes[number].copy()
    lower[axis] = upper[axis] = place
    beside = ((lower < boxes[:, 1] + LENGTH_TOLERANCE) & (upper > boxes[:, 0] - LENGTH_TOLERANCE)).all(axis=1)
    others = [(index, region.bodies[index]) for index in np.flatnonzero(beside).tolist() if index != number]
    if not others:
        return (1.0, 0.0) if _inertia(body.fluid) >= region.fluid.inertia else (0.0, 1.0)
    along = [(np.arange(_SAMPLES) + 0.5) / _SAMPLES] * 3
    along[axis] = np.zeros(1)
    share = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 3)
    places = torch.from_numpy(lower + share * (upper - lower))
    step = torch.from_numpy(outward * LENGTH_TOLERANCE * np.eye(3)[axis])
    of_body, beyond = (body.shape.signed_distance(places + side * step) < 0 for side in (-1, 1))
    if (of_body & ~beyond).any():  # else a face smaller than the distance of the places
        of_body &= ~beyond
    shown, front = of_body.clone(), torch.full(of_body.shape, -1, dtype=torch.int64, device="cpu")
    for index, other in others:
        front[other.shape.signed_distance(places + step) < 0] = index
        if index > number:
            shown &= other.shape.signed_distance(places - step) >= 0
    weights = [0.0, 0.0]
    for index in set(front[shown].tolist()):
        fluid = region.fluid if index < 0 else region.bodies[index].fluid
        contrast = 1.0 if index < 0 else _contrast(body.fluid, fluid)
        covered = float((shown & (front == index)).sum() / of_body.sum())
        weights[_inertia(body.fluid) < _inertia(fluid)] += contrast * covered
    return weights[0], weights[1]


def _inertia(fluid: Fluid | None) -> float:
    """Return the inertia of a material [kg/m^3], infinite where no sound enters."""
    return math.inf if fluid is None else fluid.inertia


def _contrast(one: Fluid | None, other: Fluid | None) -> float:
    """Return the difference of two materials, from 0 to 1: of their densities or bulk moduli."""
    if one is None or other is None:
        return float(one != other)
    ratio = one.inertia / other.inertia
    ratios = ratio, ratio * (one.phase_speed / other.phase_speed) ** 2
    return max(abs(each - 1) / (each + 1) for each in ratios)


def _axis_offset(faces: Array, transducers: Array, length: float, spacing: float) -> float:
    """Return the offset [cells] with a small mean square error of the faces, if possible a symmetric one."""
    place, first, area = faces
    cells, whole = place / spacing, length / spacing
    middle = (math.ceil(whole - _ROUNDING) - whole) / 2
    if len(place) == 0:
        return middle
    offsets, missed = _placements(cells, first, area, middle)
    best, symmetric = int(missed.argmin()), min(_SYMMETRIC, key=lambda number: missed[number])
    allowed = missed[best] / _WORTHWHILE
    pointlike = np.stack((transducers, np.zeros_like(transducers), np.zeros_like(transducers)))
    if _mirrored(np.concatenate((faces, pointlike), axis=1), length):
        allowed = max(allowed, (math.sqrt(missed[best]) + _ALLOWANCE) ** 2)
    return float(offsets[symmetric if missed[symmetric] <= allowed else best])


def _placements(cells: Array, first: Array, area: Array, middle: float) -> tuple[Array, Array]:
    """Return offsets [cells], those around `middle` first, and the mean square errors of the faces."""
    slits = _slits(cells, first)
    between = np.unique(np.round(-cells % 1, 9))[:_STEPS]
    opened = np.unique(np.round((0.5 - cells[slits].mean(axis=1)) % 1, 9))[:_STEPS]
    offsets = np.concatenate((middle + np.arange(_STEPS) / _STEPS, between, opened))
    offsets -= np.floor(offsets + _ROUNDING)
    place = cells + offsets[:, None] - 0.5  # centres are whole numbers
    distance = (first * place - _TOUCHING) % 1 + _TOUCHING
    closed = np.diff(np.floor(place[:, slits]), axis=2)[:, :, 0] == 0
    beyond = np.where(distance > _BEST, _STEEPER, 1) * (distance - _BEST)
    missed = beyond**2 @ area + _CLOSED * closed @ area[slits].sum(axis=1)
    return offsets, missed / area.sum()


def _slits(cells: Array, first: Array) -> Index:
    """Return the pairs (s, 2) of faces, by places [cells] and sides, around slits narrower than a cell."""
    order = np.argsort(cells, kind="stable")
    before, behind = order[:-1], order[1:]
    width = cells[behind] - cells[before]
    narrow = (first[before] < 0) & (first[behind] > 0) & (width < 1) & (width > _TOUCHING)
    return np.stack((before[narrow], behind[narrow]), axis=1)


def _mirrored(things: Array, length: float) -> bool:
    """Return whether things (3, n) are mirror-symmetric: distance from one end [m], direction and area."""
    images = np.stack((length - things[0], -things[1], things[2]))
    here, there = (each[:, np.lexsort((each[1], each[0].round(9)))] for each in (things, images))
    return np.allclose(here, there, rtol=0, atol=2 * LENGTH_TOLERANCE)
