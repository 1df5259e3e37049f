"""Stiffness and mass of finite elements: trilinear functions, integrated over the part that is not rigid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.element import HATS, PAIRS, SLOPES, SUBCELLS, tuning_of
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array

ABSENT_SHARE = 1e-4  # Share of an element's volume below which a material counts as absent
_TINY = 1e-12  # Least length of a normal
_PRODUCTS = np.einsum("qix,qjx->qij", SLOPES, SLOPES)[:, PAIRS[:, 0], PAIRS[:, 1]]


def across_fluids(reductions: Array, mobility: Array, share: Array, density: Array) -> Array:
    """Return reductions of the stiffness (n, 3, 3) with those across dense fluids' surfaces at rigid bodies.

    Mobilities average along the surface, and densities across it. Its normal is the sum of those of
    faces between sub-cells, times the change of mobility there. Mobilities, densities and the share of
    fluids (n, 64) are parts of an element.
    """
    filled, dense, mobile = (part.sum(axis=1) for part in (share, density, mobility))
    # without a rigid body it is the edge of a fluid, at which no normal serves; light fluids err more with it
    several = np.flatnonzero(
        (filled < 1 - ABSENT_SHARE)
        & (dense > (1 + ABSENT_SHARE) * filled)
        & (dense * mobile > (1 + ABSENT_SHARE) * filled**2)
    )
    parts = [part[several].reshape(-1, *(SUBCELLS,) * 3) for part in (mobility, share)]
    normal = np.zeros((len(several), 3))
    for axis in range(3):
        (here, filled_here), (there, filled_there) = (
            [np.moveaxis(part, axis + 1, 1)[:, some] for part in parts]
            for some in (slice(-1), slice(1, None))
        )
        normal[:, axis] = (there * filled_here - here * filled_there).sum(axis=(1, 2, 3))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), _TINY)
    less = 1 - filled[several] / np.sqrt(dense[several] * mobile[several])
    left = np.eye(3) - less[:, None, None] * normal[:, :, None] * normal[:, None, :]  # root of what is left
    reductions = reductions.copy()
    reductions[several] = np.eye(3) - left @ (np.eye(3) - reductions[several]) @ left
    return reductions


def cut_coupling(mobility: Array, reductions: Array, stencil: Stencil) -> Array:
    """Return the coupling (n, 28) of elements, from the mobility of sub-cells (n, 64).

    `reductions` (n, 3, 3) is the relative reduction of the stiffness near edges.
    """
    near = np.trace(reductions, axis1=1, axis2=2) / 2
    tuning = tuning_of(stencil)[PAIRS[:, 0], PAIRS[:, 1]]
    coupling = -(mobility @ _PRODUCTS) - np.outer((1 - near) * mobility.sum(axis=1), tuning)
    some = np.flatnonzero(near)
    across = SLOPES @ reductions[some, None]
    reduced = np.einsum("nq,nqix,qjx->nij", mobility[some], across, SLOPES, optimize=True)
    coupling[some] += reduced[:, PAIRS[:, 0], PAIRS[:, 1]]
    return np.asarray(coupling)


def cut_mass(cells: Array, out: NDArray[np.bool_]) -> Array:
    """Return the masses at the vertices (n, 8), from those of sub-cells (n, 64).

    Vertices `out` (n, 8) leave theirs to the others.
    """
    mass, parted = cells @ HATS, np.flatnonzero(out.any(axis=1))
    hats = HATS * ~out[parted, None]
    whole = hats.sum(axis=2, keepdims=True)
    hats = np.divide(hats, whole, out=np.zeros_like(hats), where=whole > 0)
    mass[parted] = (cells[parted, None] @ hats)[:, 0]
    return np.asarray(mass)
