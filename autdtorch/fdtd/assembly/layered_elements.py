"""Elements that vary along one axis: layers between two planes of vertices.

At normal incidence layers are a two-port: pressure and flow at one plane follow from those at the other. Any
two-port without loss is a coupling between the planes and a mass at each. The scheme is then exact, wherever
the faces are and however thin a layer is. A second angle of incidence decides the mobility along the planes.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.reference_element import (
    EDGES_BETWEEN,
    PAIRS,
    SUBCELLS,
    VERTICES,
    Materials,
    coupling_by_edges,
    uniform_coupling,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import distinct_rows

# Square s of the sine of the second angle of incidence. The second-order term of the exact mass is (1 - s)^2.
# The scheme has 1 - 1.25 s, which is nearest to it for s of 0 to 1: equal at 0 and 0.75.
_OBLIQUE = 0.75
# Density, relative to air, up to which a layer between heavier ones is a gap. Sound goes along it, which is
# exact without terms of second order; those for sound across it are several times as large in a slit.
_AS_AIR = 1.1
# Largest relative change by terms of second order: coarse grids of slow materials stay stable
_LARGEST_CHANGE = 0.5
_SMALL = 0.1  # Wavenumber, relative to the drive's, at which second derivatives by it are evaluated
_SHORT = 1e-8  # Phase across a layer up to which its sine is the phase [rad]
_PLACES = 40  # Places of a face between two cells


class TwoPort(NamedTuple):
    """n stacks of layers as two planes of vertices see them; in air 1, 1/2 and 1."""

    link: Array  # coupling across (n,)
    thickness: Array  # masses of the planes (n, 2), relative to a cell of the plane's material
    mobility: Array  # mobilities along the planes (n, 2)


def two_port(width: Array, density: Array, wavenumber: Array, air: float) -> TwoPort:
    """Return the two-ports of n stacks of L layers, exact to second order in the wavenumbers.

    Widths [cells], densities as assembled and wavenumbers [rad/cell] are (n, L), and `air` is the wavenumber
    of air. The first and the last layer are the materials of the planes; a width may be zero.
    """
    still = long_wave_port(width, density, wavenumber)
    near = _exact_port(width, density, _SMALL * wavenumber, _SMALL * air)
    largest = np.where(_has_gap(width, density), 0.0, _LARGEST_CHANGE)
    return TwoPort(*(_corrected(*pair, largest) for pair in zip(still, near, strict=True)))


def _has_gap(width: Array, density: Array) -> NDArray[np.bool_]:
    """Return which stacks (n,) have a layer as light as air between heavier materials."""
    heavy = (density[:, [0, -1]] > _AS_AIR).all(axis=1)
    return np.asarray(heavy & ((density < _AS_AIR) & (width > 0)).any(axis=1))


def _corrected(still: Array, near: Array, largest: Array) -> Array:
    """Return a value at the drive's wavenumber, from values for long waves and at `_SMALL` times it.

    Relative changes are at most the `largest` (n,).
    """
    most = (largest * still.T).T
    return np.asarray(still + np.clip((near - still) / _SMALL**2, -most, most))


def long_wave_port(width: Array, density: Array, wavenumber: Array) -> TwoPort:
    """Return the two-ports for long waves."""
    shares, ends = long_wave_shares(width, density), [0, -1]
    stiffness = (shares @ (wavenumber**2 / density)[:, :, None])[:, :, 0]
    thickness = stiffness * density[:, ends] / wavenumber[:, ends] ** 2
    mobility = 2 * (shares @ (1 / density)[:, :, None])[:, :, 0]
    return TwoPort(1 / (width * density).sum(axis=1), thickness, mobility)


def long_wave_shares(width: Array, density: Array) -> Array:
    """Return the widths (n, 2, L) of layers as a steady flow divides them between the planes."""
    resistance = width * density
    middle = (np.cumsum(resistance, axis=1) - resistance / 2) / resistance.sum(axis=1)[:, None]
    return np.stack((1 - middle, middle), axis=1) * width[:, None]


def _exact_port(width: Array, density: Array, wavenumber: Array, air: float) -> TwoPort:
    """Return the two-ports, exact at normal incidence; their mobility is exact at `_OBLIQUE` incidence."""
    resistance, flow = _flows(width, density, wavenumber, 0.0)
    _, oblique = _flows(width, density, wavenumber, _OBLIQUE * air**2)
    # a cell of each plane's material
    end_density, end_wavenumber = (part[:, [0, -1]].reshape(-1, 1) for part in (density, wavenumber))
    cell, cell_oblique = (
        _flows(np.ones_like(end_density), end_density, end_wavenumber, across)[1][:, 0].reshape(-1, 2)
        for across in (0.0, _OBLIQUE * air**2)
    )
    mobility = (flow - oblique) / (cell - cell_oblique) / density[:, [0, -1]]
    return TwoPort(1 / resistance, flow / (2 * cell), mobility)


def _flows(width: Array, density: Array, wavenumber: Array, across: float) -> tuple[Array, Array]:
    """Return the resistance between the planes (n,), and the flow into each at equal unit pressures (n, 2).

    `across` is the square of the wavenumber along the planes [rad^2/cell^2]. Assembled densities give the
    waves their exact flow on the grid (`materials.flow_factor`).
    """
    true = density * wavenumber / np.sin(wavenumber)
    square = wavenumber**2 - across
    phase = np.sqrt(square.astype(complex)) * width
    short = np.abs(phase) < _SHORT
    cosine = np.cos(phase).real
    sine = width * np.where(short, 1, np.sin(phase) / np.where(short, 1, phase)).real
    # from pressure and flow at the first plane to those at the second
    whole = np.broadcast_to(np.eye(2), (len(width), 2, 2))
    for layer in range(width.shape[1]):
        here, there, heavy = cosine[:, layer], sine[:, layer], true[:, layer]
        part = np.array([[here, heavy * there], [-square[:, layer] / heavy * there, here]])
        whole = np.moveaxis(part, -1, 0) @ whole
    resistance = whole[:, 0, 1]
    return resistance, (1 - whole[:, [0, 1], [0, 1]]) / resistance[:, None]


def layered_elements(
    axis: int, width: Array, layer: Index, density: Array, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of elements with layers across an axis.

    Layers have widths (n, L) [cells] and materials (n, L), and these densities (m,). The energy has a part g
    (p1 - p0)^T W (p1 - p0) of the pressures p0 and p1 in the planes, where W averages along a plane in air.
    Each plane adds its energy in air times a mobility. All parts are positive: waves would otherwise
    grow in an absorbing layer.
    """
    wavenumber = stencil.kappa * materials.slowness[layer]
    ports = two_port(width, density[layer], wavenumber, stencil.kappa)
    across, side = EDGES_BETWEEN[:, axis] == 1, VERTICES[:, axis]
    uniform = uniform_coupling(stencil)
    beside = np.where(across, 0, coupling_by_edges(stencil)[np.minimum(EDGES_BETWEEN.sum(axis=1) + 1, 3)])
    along = ports.mobility[:, side[PAIRS[:, 0]]]
    link = np.where(across, uniform, -beside) * ports.link[:, None]
    mass = (ports.thickness * materials.mass[layer[:, [0, -1]]] / 4)[:, side]
    return np.where(across, 0, along * (uniform + beside)) + link, mass


def mean_air_thickness(materials: Materials, stencil: Stencil) -> Array:
    """Return the second-order thickness [cells] of air before each material (m,), averaged over places.

    A wave on the grid is reflected this far behind surfaces of fluids that are not parallel to the grid.
    Rigid materials have none.
    """
    depth = (np.arange(_PLACES) + 0.5) / _PLACES
    width, mean = np.stack((depth, 1 - depth), axis=1), np.zeros(len(materials.density))
    for number in np.flatnonzero(~materials.rigid)[1:]:
        density, slowness = (
            np.broadcast_to(part[[0, number]], width.shape)
            for part in (materials.density, materials.slowness)
        )
        wavenumber = stencil.kappa * slowness
        waves = two_port(width, density, wavenumber, stencil.kappa).thickness
        still = long_wave_port(width, density, wavenumber).thickness
        mean[number] = (waves - still)[:, 0].mean()
    return mean


_VARIATION = 1e-6  # Largest variation of a distance along a face [cells]: rounding
_STEP = 1 / SUBCELLS  # Distance of the points of a profile [cells]


class Survey(NamedTuple):
    """Signed distances of K bodies in n elements at a glance."""

    least: Array  # (K, n)
    most: Array  # (K, n)
    layered: NDArray[np.bool_]  # whether they vary along an axis alone (K, n, 3)

    @classmethod
    def of(cls, distance: Array) -> Survey:
        """Look at the distances at lattices (K, n, 125)."""
        from autdtorch.fdtd.assembly.element_kernels import survey_lattices  # loads numba

        size = distance.shape[:2]
        survey = cls(np.empty(size), np.empty(size), np.empty((*size, 3), bool))
        # numba compiles again for arrays with gaps
        survey_lattices(np.ascontiguousarray(distance), _VARIATION, *survey)
        return survey

    def crossed(self, distance: Array) -> NDArray[np.bool_]:
        """Return whether the bodies with these distances have faces across one axis in elements (K, n).

        A thin body, or a narrow gap, may lie between points that all have distances of one sign.
        """
        crossed, axes = np.zeros(self.least.shape, bool), _last(self.layered)
        for axis in range(3):
            here = np.nonzero(axes == axis)
            lines = _lines(axis, distance[here][None])[:, 0]
            crossed[here] = [len(_faces(line)) > 0 for line in lines]
        return crossed

    def axis(self, constant: NDArray[np.bool_]) -> Index:
        """Return the only axis (n,) along which all distances vary, or -1; some (K, n) count as constant."""
        return _last(np.asarray((self.layered | constant[:, :, None]).all(axis=0)))


def _last(axes: NDArray[np.bool_]) -> Index:
    """Return the last of the axes in masks (..., 3), or -1."""
    return np.where(axes.any(axis=-1), 2 - axes[..., ::-1].argmax(axis=-1), -1)


def _lines(axis: int, distance: Array) -> Array:
    """Return the distances (n, K, 5) along an axis, from distances (K, n, 125) that do not vary across it."""
    cube = distance.reshape(*distance.shape[:2], *(SUBCELLS + 1,) * 3)
    return np.moveaxis(cube, 2 + axis, 2)[:, :, :, 0, 0].transpose(1, 0, 2)


def flat_elements(
    axis: int, distance: Array, material: Index, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of elements with faces across an axis.

    Arguments are signed distances (K, n, 125) of bodies, and their materials (K,).
    """
    lines = _lines(axis, distance)
    # most have no face
    first, kind = distinct_rows(lines.reshape(len(lines), len(material) * (SUBCELLS + 1)))
    stacks = [_layers(line, material) for line in lines[first]]
    most = max((len(width) for width, _ in stacks), default=1)
    width, layer = np.zeros((len(stacks), most)), np.zeros((len(stacks), most), np.int64)
    for row, (widths, inside) in enumerate(stacks):
        width[row, : len(widths)], layer[row] = widths, inside[-1]
        layer[row, : len(widths)] = inside
    coupling, mass = layered_elements(axis, width, layer, materials.density, materials, stencil)
    return coupling[kind], mass[kind]


def _layers(line: Array, material: Index) -> tuple[Array, Index]:
    """Return widths and materials of the layers along a line, from signed distances (K, 5) of bodies."""
    faces = [_faces(distance) for distance in line]
    ends = np.unique(np.concatenate(([0.0, 1.0], *faces)))
    middle = (ends[1:] + ends[:-1]) / 2
    layer = np.zeros(len(middle), np.int64)
    for distance, places, number in zip(line, faces, material, strict=True):
        crossed = (np.array(places)[:, None] < middle).sum(axis=0)
        layer[(crossed % 2 == 1) != (distance[0] < 0)] = number
    return np.diff(ends), layer


def _faces(distance: Array) -> list[float]:
    """Return the places of a body's faces on a line, from its signed distances (5,).

    Distances change by the step from point to point while the nearest face is on one side. Two distances
    whose sum is below the step therefore have a thin body or a narrow gap between them.
    """
    places = []
    rising = np.diff(np.abs(distance)) > _STEP / 2  # from each point to the next
    for number, (low, high) in enumerate(itertools.pairwise(distance.tolist())):
        begin, end = _STEP * number, _STEP * (number + 1)
        ahead, back = begin + abs(low), end - abs(high)
        if (low < 0) == (high < 0):
            places += [ahead, back] if ahead < back else []
            continue
        # the nearest face of each point is the one between them if its distance rises on the other side
        from_low = number > 0 and np.sign(distance[number - 1]) == np.sign(low) and not rising[number - 1]
        from_high = (
            number < SUBCELLS - 1 and np.sign(distance[number + 2]) == np.sign(high) and rising[number + 1]
        )
        between = begin + _STEP * low / (low - high)
        places.append(between if from_low == from_high else ahead if from_low else back)
    return places
