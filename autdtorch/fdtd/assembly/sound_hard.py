"""Elements that a tilted or curved surface of a sound-hard body cuts, or a tilted edge of a dense fluid.

Their stiffness and mass are those of finite elements with trilinear functions, integrated over the part that
is no such body (a cut finite element method, Burman et al. 2015, doi:10.1002/nme.4823). Vertices in the body
keep a pressure, which continues the field beyond the surface. A pressure that varies linearly along the
surface then causes no force at any vertex, wherever the surface falls between the cells. What the tuned
stencil has beyond finite elements is added in proportion to the volume.
"""

from __future__ import annotations

import math

import numpy as np

from autdtorch.fdtd.assembly.element import (
    PAIRS,
    SUBCELLS,
    VERTICES,
    Materials,
    stiffness_matrix,
    uniform_coupling,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array

_SUBCENTRES = (np.array(list(np.ndindex((SUBCELLS,) * 3))) + 0.5) / SUBCELLS
# Linear factors of the trilinear functions of the vertices at the centres of the sub-cells (64, 8, 3)
_FACTORS = np.where(VERTICES == 1, _SUBCENTRES[:, None], 1 - _SUBCENTRES[:, None])
HATS = _FACTORS.prod(axis=2)  # Trilinear functions of the vertices at the centres of the sub-cells (64, 8)
# Their gradients (64, 8, 3)
_SLOPES = np.stack(
    [(2 * VERTICES[:, axis] - 1) * np.delete(_FACTORS, axis, axis=2).prod(axis=2) for axis in range(3)],
    axis=2,
)
_PRODUCTS = np.einsum("qix,qjx->qij", _SLOPES, _SLOPES)


def cut_coupling(volumes: Array, materials: Materials, reductions: Array, stencil: Stencil) -> Array:
    """Return the coupling (n, 28) of elements, from the share of each material in sub-cells (n, 64, m).

    `reductions` (n, 3, 3) is the share of the stiffness that is taken away near edges.
    """
    mobility = volumes @ np.where(materials.sound_hard, 0, 1 / materials.density) / SUBCELLS**3
    tuning = stiffness_matrix(uniform_coupling(stencil)[None])[0] - _PRODUCTS.mean(axis=0)
    near = np.trace(reductions, axis1=1, axis2=2) / 2
    matrix = np.tensordot(mobility, _PRODUCTS, axes=1)
    matrix += ((1 - near) * mobility.sum(axis=1))[:, None, None] * tuning
    some = np.flatnonzero(near)
    across = _SLOPES @ reductions[some, None]
    matrix[some] -= np.einsum("nq,nqix,qjx->nij", mobility[some], across, _SLOPES, optimize=True)
    return np.asarray(-matrix[:, PAIRS[:, 0], PAIRS[:, 1]])


def cut_mass(volumes: Array, materials: Materials) -> Array:
    """Return the masses at the vertices (n, 8), from the share of each material in sub-cells (n, 64, m)."""
    return np.asarray(volumes @ np.where(materials.sound_hard, 0, materials.mass) @ HATS / SUBCELLS**3)


def added_thickness(kappa: float) -> float:
    """Return the thickness [cells] by which sound-hard bodies are grown, about kappa^2 / 24.

    A wave on the grid is otherwise reflected so far behind the surface, at any tilt and incidence. It is the
    mean of kappa^2 (d^3 / 3 - d / 12) over all places d of a face between the cells, and higher terms;
    `layers.mean_thickness` serves fluids.
    """
    return (math.tan(kappa / 2) / (kappa / 2) - 1) / 2
