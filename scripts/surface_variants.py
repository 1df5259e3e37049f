"""Other treatments of the elements that surfaces cut, to compare the solver's own with.

Each has the signature of `autdtorch.fdtd.surface.cut_elements`; `treatment` puts one in its place.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd import medium, surface
from autdtorch.fdtd.stencil import Stencil
from autdtorch.fdtd.surface import (
    LATTICE,
    PAIRS,
    SUBCELLS,
    Array,
    CutElements,
    Materials,
    cut_elements,
    uniform_bonds,
)

Numbers = NDArray[np.int64]

_CORNERS = np.flatnonzero(np.isin(LATTICE, (0, 1)).all(axis=1))


class Treatment(Protocol):
    """Bonds and masses of elements that surfaces cut, as `cut_elements`."""

    def __call__(
        self, distance: Array, material: Numbers, materials: Materials, stencil: Stencil
    ) -> CutElements:
        """See `cut_elements`."""


def staircase(distance: Array, material: Numbers, materials: Materials, stencil: Stencil) -> CutElements:
    """A cell is of the material of its centre, bonds are 2 / (rho_i + rho_j)."""
    number = _vertex_numbers(distance, material)
    density = materials.density[number][:, PAIRS].mean(axis=2)
    return CutElements(uniform_bonds(stencil) / density, materials.mass[number] / 8, number)


def series_bonds(distance: Array, material: Numbers, materials: Materials, stencil: Stencil) -> CutElements:
    """Density is averaged along each bond and mass over the volume, by the default's own sums."""
    count = len(materials.density)
    lines = surface._shares(surface._line_coverage, distance, material, count)
    volumes = surface._shares(surface._volume_coverage, distance, material, count)
    density = (lines @ materials.density).reshape(-1, len(PAIRS), SUBCELLS).mean(axis=2)
    mass = (volumes @ materials.mass) @ surface._HATS / SUBCELLS**3
    return CutElements(uniform_bonds(stencil) / density, mass, _vertex_numbers(distance, material))


TREATMENTS: dict[str, Treatment] = {
    "staircase": staircase,
    "series bonds": series_bonds,
    "default": cut_elements,
}


@contextmanager
def treatment(name: str) -> Iterator[None]:
    """A context in which scenes are assembled with that treatment."""
    with patch.object(medium, "cut_elements", TREATMENTS[name]):
        yield


def _vertex_numbers(distance: Array, material: Numbers) -> Numbers:
    """Material that each vertex lies in (n, 8)."""
    number = np.zeros((distance.shape[1], 8), np.int64)
    for far, own in zip(distance, material, strict=True):
        number[far[:, _CORNERS] < 0] = own
    return number
