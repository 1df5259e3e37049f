"""Thin rigid walls: finite elements in front of one and behind it share no vertices.

The air in an element that walls cross is in several parts, its sides. To a side belong the vertices in its
air, and those inside a wall whose nearest face does not look the opposite way. Sound would pass through
others. Vertices half-way between two faces belong to no side, as a mirror image would choose the other one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import generate_binary_structure, label

from autdtorch.fdtd.assembly.element import CORNERS, SUBCELLS, subcell_gradients, subcell_means
from autdtorch.utils.array_types import Array, Index

_OPPOSITE = -0.5  # Cosine of the angle between two faces below which they look opposite ways
_LEAST = 1 / len(CORNERS)  # Sum of the shares of sub-cells in which a side has one point of the lattice
_NEIGHBOURS = np.zeros((3,) * 4, bool)  # of points of the lattices of n elements: six, of the same element
_NEIGHBOURS[1] = generate_binary_structure(3, 1)


class Side(NamedTuple):
    """The air on one side of thin walls in n elements."""

    share: Array  # of the air in each sub-cell (n, 64)
    out: NDArray[np.bool_]  # vertices that do not belong to the side (n, 8)

    def chosen(self, some: Index | NDArray[np.bool_]) -> Side:
        """Return the side in some of the elements."""
        return Side(self.share[some], self.out[some])


def sides_of(level: Array, normal: Array, walls: NDArray[np.bool_]) -> tuple[Side, ...]:
    """Return the sides of walls in n elements; without walls, and in the mask `walls` (n,), there is one.

    Signed distances `level` (n, 125) are those from rigid bodies, and `normal` (n, 8, 3) their gradients at
    vertices inside. A side that an element does not have has no share there.
    """
    sides = [Side(np.ones((len(level), SUBCELLS**3)), np.zeros((len(level), 8), bool))]
    for number, side in enumerate(_sides(level[walls], normal[walls])):
        if number > 0:
            sides.append(Side(np.zeros_like(sides[0].share), np.zeros_like(sides[0].out)))
        sides[-1].share[walls], sides[-1].out[walls] = side
    return tuple(sides)


def _sides(level: Array, normal: Array) -> Iterator[Side]:
    """Yield the sides of walls in elements that all have walls; see `sides_of`."""
    outside, gradient = level > 0, subcell_gradients(level)
    inside, whole = ~outside[:, CORNERS], subcell_means(outside.astype(float))
    undecided = ~normal.any(axis=2)
    labels, count = label(outside.reshape(-1, *(SUBCELLS + 1,) * 3), _NEIGHBOURS)
    labels = labels.reshape(level.shape)
    while labels.any():
        first = np.where(labels > 0, labels, count + 1).min(axis=1, keepdims=True)
        here = labels == first
        labels[here] = 0
        part = subcell_means(here.astype(float))
        facing = (part[:, None] @ gradient)[:, 0] / np.maximum(part.sum(axis=1, keepdims=True), _LEAST)
        opposite = (normal * facing[:, None]).sum(axis=2) < _OPPOSITE
        share = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
        yield Side(share, np.where(inside, opposite | undecided, ~here[:, CORNERS]))
