"""Elements at faces parallel to the grid of bodies that have others, such as the ends of a cylinder."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.element import SUBCELLS, Materials
from autdtorch.fdtd.assembly.layers import layered_elements, two_port
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

_VARIATION = 1e-6  # Largest variation of a distance along a face [cells]: rounding
_STEP = 1 / SUBCELLS  # Distance of the points of a profile [cells]


def layered_axis(distance: Array) -> Index:
    """Return the axis (n,) along which alone signed distances (K, n, 125) of bodies vary, or -1."""
    found = np.full(distance.shape[1], -1)
    cube = distance.reshape(*distance.shape[:2], *(SUBCELLS + 1,) * 3)
    for axis in range(3):
        across = tuple(2 + other for other in range(3) if other != axis)
        found[np.ptp(cube, axis=across).max(axis=(0, 2), initial=0) < _VARIATION] = axis
    return found


def crossed_by_layers(distance: Array) -> NDArray[np.bool_]:
    """Return whether bodies with signed distances (K, n, 125) have faces across one axis in elements (K, n).

    A thin body, or a narrow gap, may lie between points that all have distances of one sign.
    """
    found = np.zeros(distance.shape[:2], bool)
    for number, own in enumerate(distance):
        axes = layered_axis(own[None])
        for axis in range(3):
            rows = np.flatnonzero(axes == axis)
            found[number, rows] = [len(_faces(line)) > 0 for line in _lines(axis, own[None, rows])[:, 0]]
    return found


def _lines(axis: int, distance: Array) -> Array:
    """Return the distances (n, K, 5) along an axis of those (K, n, 125) that do not vary across it."""
    cube = distance.reshape(*distance.shape[:2], *(SUBCELLS + 1,) * 3)
    return np.moveaxis(cube, 2 + axis, 2)[:, :, :, 0, 0].transpose(1, 0, 2)


def flat_elements(
    axis: int, distance: Array, material: Index, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of elements with faces across an axis.

    Arguments are signed distances (K, n, 125) of bodies, and their materials (K,).
    """
    stacks = [_layers(line, material) for line in _lines(axis, distance)]
    most = max((len(width) for width, _ in stacks), default=1)
    width, layer = np.zeros((len(stacks), most)), np.zeros((len(stacks), most), np.int64)
    for row, (own, inside) in enumerate(stacks):
        width[row, : len(own)], layer[row] = own, inside[-1]
        layer[row, : len(own)] = inside
    wavenumber = stencil.kappa * materials.slowness[layer]
    ports = two_port(width, materials.density[layer], wavenumber, stencil.kappa)
    return layered_elements(axis, ports, layer[:, [0, -1]], materials, stencil)


def _layers(line: Array, material: Index) -> tuple[Array, Index]:
    """Return widths and materials of the layers along a line, from signed distances (K, 5) of bodies."""
    faces = [_faces(own) for own in line]
    ends = np.unique(np.concatenate(([0.0, 1.0], *faces)))
    middle = (ends[1:] + ends[:-1]) / 2
    layer = np.zeros(len(middle), np.int64)
    for own, found, number in zip(line, faces, material, strict=True):
        crossed = (np.array(found)[:, None] < middle).sum(axis=0)
        layer[(crossed % 2 == 1) != (own[0] < 0)] = number
    return np.diff(ends), layer


def _faces(distance: Array) -> list[float]:
    """Return the places of a body's faces on a line, from its signed distances (5,).

    They change by one from point to point where the nearest face stays on one side, so that two distances
    whose sum is below the step have a thin body or a narrow gap between them.
    """
    found = []
    rising = np.diff(np.abs(distance)) > _STEP / 2  # from each point to the next
    for number, (low, high) in enumerate(itertools.pairwise(distance.tolist())):
        begin, end = _STEP * number, _STEP * (number + 1)
        ahead, back = begin + abs(low), end - abs(high)
        if (low < 0) == (high < 0):
            found += [ahead, back] if ahead < back else []
            continue
        # the nearest face of each point is the one between them if its distance rises on the other side
        from_low = number > 0 and np.sign(distance[number - 1]) == np.sign(low) and not rising[number - 1]
        from_high = (
            number < SUBCELLS - 1 and np.sign(distance[number + 2]) == np.sign(high) and rising[number + 1]
        )
        between = begin + _STEP * low / (low - high)
        found.append(between if from_low == from_high else ahead if from_low else back)
    return found
