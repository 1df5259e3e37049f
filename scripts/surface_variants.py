"""Other treatments of the elements that surfaces cut, to compare the solver's own with.

Each has the signature of `interface_elements` in `autdtorch.fdtd.assembly`; `treatment` substitutes one.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly import elements, interface
from autdtorch.fdtd.assembly.interface import (
    LATTICE,
    PAIRS,
    SUBCELLS,
    Array,
    InterfaceElements,
    Materials,
    interface_elements,
    uniform_coupling,
)
from autdtorch.fdtd.stencil import Stencil

Numbers = NDArray[np.int64]

_CORNERS = np.flatnonzero(np.isin(LATTICE, (0, 1)).all(axis=1))


class Treatment(Protocol):
    """Bonds and masses of elements that surfaces cut, as `interface_elements`."""

    def __call__(
        self, distance: Array, material: Numbers, materials: Materials, stencil: Stencil
    ) -> InterfaceElements:
        """See `interface_elements`."""


def staircase(
    distance: Array, material: Numbers, materials: Materials, stencil: Stencil
) -> InterfaceElements:
    """A cell is of the material of its centre, bonds are 2 / (rho_i + rho_j)."""
    number = _vertex_numbers(distance, material)
    density = materials.density[number][:, PAIRS].mean(axis=2)
    return InterfaceElements(uniform_coupling(stencil) / density, materials.mass[number] / 8, number)


def series_bonds(
    distance: Array, material: Numbers, materials: Materials, stencil: Stencil
) -> InterfaceElements:
    """Density is averaged along each bond and mass over the volume, by the default's own sums."""
    count = len(materials.density)
    lines = interface._shares(interface._line_coverage, distance, material, count)
    volumes = interface._shares(interface._volume_coverage, distance, material, count)
    density = (lines @ materials.density).reshape(-1, len(PAIRS), SUBCELLS).mean(axis=2)
    mass = (volumes @ materials.mass) @ interface._HATS / SUBCELLS**3
    return InterfaceElements(uniform_coupling(stencil) / density, mass, _vertex_numbers(distance, material))


TREATMENTS: dict[str, Treatment] = {
    "staircase": staircase,
    "series bonds": series_bonds,
    "default": interface_elements,
}


@contextmanager
def treatment(name: str) -> Iterator[None]:
    """A context in which scenes are assembled with that treatment."""
    with patch.object(elements, "interface_elements", TREATMENTS[name]):
        yield


def _vertex_numbers(distance: Array, material: Numbers) -> Numbers:
    """Material that each vertex lies in (n, 8)."""
    number = np.zeros((distance.shape[1], 8), np.int64)
    for far, own in zip(distance, material, strict=True):
        number[far[:, _CORNERS] < 0] = own
    return number
