"""Elements with faces parallel to the grid.

Between the two planes of vertices beside a face, coupling and masses make both standing waves of the exact
problem, one with a pressure and one with a flow at the face, solutions of the scheme to second order in the
wavenumber. The error is then independent of where the face falls between the cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.element import (
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

_VARIATION = 1e-6  # Largest variation of a share or distance along an axis-aligned face: rounding
_WHOLE = 1e-9  # Share of an element up to which a third material is rounding
# Wavenumber, relative to the wave's, at which second derivatives by it are evaluated
_SMALL = 0.1
_PLACES, _STILL = 40, 1e-3  # Places of a face between two cells; long waves, relative to the drive's
# Ratio of the second-order terms of mobility and thickness. With s = sin^2 of the angle of incidence, the
# exact term is (1 - s)^2 = 1 - 2 s + s^2; the scheme has 1 - 1.25 s, nearest to it over s of 0 to 1.
_OBLIQUE = 1.25


def constant_along(volumes: Array, axes: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return whether shares in the sub-cells (n, 64, m) do not vary along axes (n,)."""
    cube = volumes.reshape(len(volumes), *(SUBCELLS,) * 3, volumes.shape[2])
    varied = np.ptp(cube, axis=tuple(axis + 1 for axis in axes), keepdims=True)
    return np.asarray(varied.max(axis=(1, 2, 3, 4), initial=0) < _VARIATION)


def layered_axis(vertex: Index, volumes: Array, distance: Array) -> Index:
    """Return an axis (n,) along which alone elements vary, or -1.

    Arguments are materials at the vertices (n, 8), shares in the sub-cells (n, 64, m), and signed distances
    (K, n, 125) of bodies with other faces. The signed distance of an aligned body is not needed: it also
    varies along a face, where another face is as near.
    """
    found = np.full(len(volumes), -1)
    corners, cube = vertex.reshape(-1, 2, 2, 2), distance.reshape(*distance.shape[:2], *(SUBCELLS + 1,) * 3)
    for axis in range(3):
        one, other = (each for each in range(3) if each != axis)
        even = np.flatnonzero(np.ptp(corners, axis=(one + 1, other + 1)).max(axis=1, initial=0) == 0)
        varied = np.ptp(cube[:, even], axis=(one + 2, other + 2)).max(axis=(0, 2), initial=0)
        even = even[varied < _VARIATION]
        found[even[constant_along(volumes[even], (one, other))]] = axis
    return found


def layered_elements(
    axis: int, vertex: Index, share: Array, mass: Array, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of elements with faces across an axis.

    `vertex` (n, 8) holds the material at the vertices, `share` (n, m) the share of each material in the
    volume, and `mass` (n, 8) the mass of elements with several faces. With p0 and p1 the pressures in the
    two planes, the energy is g (p1 - p0)^T W (p1 - p0), W being the averages along a plane in air, and for
    each plane that of air times a mobility. Each part is positive: waves would grow in a boundary layer
    otherwise.
    """
    across = EDGES_BETWEEN[:, axis] == 1
    uniform = uniform_coupling(stencil)
    beside = np.where(across, 0, coupling_by_edges(stencil)[np.minimum(EDGES_BETWEEN.sum(axis=1) + 1, 3)])
    side = VERTICES[:, axis]
    link, mobility = 1 / (share @ materials.density), _mobility(side, vertex, share, materials)
    planes = np.stack([vertex[:, side == plane][:, 0] for plane in (0, 1)], axis=1)
    depth = np.take_along_axis(share, planes, axis=1)
    one = np.flatnonzero((planes[:, 0] != planes[:, 1]) & (depth.sum(axis=1) > 1 - _WHOLE))
    own, mass = planes[one], mass.copy()
    link[one], mobility[one], thickness = matched(
        depth[one], materials.density[own], stencil.kappa * materials.slowness[own]
    )
    mass[one] = (thickness * materials.mass[own] / 4)[:, side]
    along = mobility[:, side[PAIRS[:, 0]]]
    link = np.where(across, uniform, -beside) * link[:, None]
    return np.where(across, 0, along * (uniform + beside)) + link, mass


def _mobility(side: Index, vertex: Index, share: Array, materials: Materials) -> Array:
    """Return mobilities (n, 2) of both planes: a material counts for those that hold its vertices."""
    held = [(vertex[:, side == plane, None] == np.arange(share.shape[1])).any(axis=1) for plane in (0, 1)]
    part = np.stack((1.0 + held[0] - held[1], 1.0 + held[1] - held[0]), axis=1)
    return np.asarray((part * share[:, None]) @ (1 / materials.density))


def matched(depth: Array, density: Array, wavenumber: Array) -> tuple[Array, Array, Array]:
    """Return coupling (n,) across a face, mobility (n, 2) and thickness (n, 2) of the planes beside it.

    `depth` (n, 2) is the distance [cells] of the planes from the face, `density` (n, 2) as assembled, and
    `wavenumber` (n, 2) the materials' own [rad/cell].
    """
    ratio = (wavenumber[:, ::-1] / wavenumber) ** 2
    link = 1 / (density * depth).sum(axis=1)
    thickness = _least(depth, density, link, ratio)
    along = _least(depth, density, link, np.ones_like(ratio))
    near = _exact(depth, density, _SMALL * wavenumber)
    change = (near[1] - thickness) / _SMALL**2
    mobility = along + _bounded(_OBLIQUE * change, along)
    link = link + _bounded((near[0] - link) / _SMALL**2, link)
    return link, 2 * mobility / density, thickness + _bounded(change, thickness)


def _bounded(change: Array, value: Array) -> Array:
    """Return a change that leaves at least half of a value: coarse grids of slow materials stay stable."""
    return np.asarray(np.clip(change, -value / 2, value))


def mean_thickness(materials: Materials, stencil: Stencil) -> Array:
    """Return the second-order thickness [cells] of air before each material (m,), averaged over places.

    A wave on the grid is reflected so far behind other surfaces of fluids. Sound-hard ones need none.
    """
    depth = (np.arange(_PLACES) + 0.5) / _PLACES
    depths, found = np.stack((depth, 1 - depth), axis=1), np.zeros(len(materials.density))
    for number in np.flatnonzero(~materials.sound_hard)[1:]:
        density, slowness = materials.density[[0, number]], materials.slowness[[0, number]]
        own = np.broadcast_to(density, depths.shape), np.broadcast_to(slowness, depths.shape)
        waves, still = (matched(depths, own[0], scale * stencil.kappa * own[1])[2] for scale in (1, _STILL))
        found[number] = (waves - still)[:, 0].mean()
    return found


def _least(depth: Array, density: Array, link: Array, ratio: Array) -> Array:
    """Return the thickness (n, 2) for long waves, given the squared ratio (n, 2) of the wavenumbers."""
    return depth - density * link[:, None] / 2 * (depth**2 - depth[:, ::-1] ** 2 * ratio)


def _exact(depth: Array, density: Array, wavenumber: Array) -> tuple[Array, Array]:
    """Return the coupling (n,) and the thickness (n, 2) with which a wave across the face is exact.

    Assembled densities give the wave its exact flow on the grid (`elements.flow_factor`).
    """
    true = density * wavenumber / np.sin(wavenumber)
    here, half = np.cos(wavenumber * depth), wavenumber / 2
    slope = true / wavenumber * np.sin(wavenumber * depth)
    link = 1 / (here * slope[:, ::-1]).sum(axis=1)
    # differences of cosines without their rounding: 1 - cos(x) is 2 sin^2(x / 2)
    bend = 2 * np.sin(half * depth) ** 2
    force = density * link[:, None] * (bend - bend[:, ::-1])
    force -= 2 * np.sin(wavenumber * (depth + 0.5)) * np.sin(half)
    return link, -force / (4 * np.sin(half) ** 2) / here - 0.5
