"""The energy of random scenes: not negative, and below its bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu
from shared.random_scenes import draw_trial

from autdtorch.fdtd.assembly.element import stiffness_matrix
from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells, heterogeneous_cells
from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.stability import largest_eigenvalue
from autdtorch.fdtd.stencil import OFFSETS, tuned_stencil
from autdtorch.propagators.scene_region import region_of

SCENES = range(12)


def operator_of(cells: HeterogeneousCells, shape: tuple[int, int, int]) -> sparse.csc_array:
    """M^-1/2 K M^-1/2 of the heterogeneous cells that are not sound-hard; all others are held at zero."""
    place = np.full(math.prod(shape), -1)
    open_cells = np.flatnonzero(~np.isin(cells.index, cells.sound_hard))
    place[cells.index[open_cells]] = np.arange(len(open_cells))
    weight, root = cells.weight[open_cells], np.sqrt(cells.mass[open_cells])
    neighbour = place[cells.index[open_cells, None] + np.array(OFFSETS) @ (shape[1] * shape[2], shape[2], 1)]
    row, column = np.nonzero(neighbour >= 0)
    other = neighbour[row, column]
    coupling = weight[row, column] * root[row] / root[other]
    size = (len(open_cells),) * 2
    return sparse.diags_array(weight.sum(axis=1)) - sparse.csc_array((coupling, (row, other)), size)


def assert_not_negative(matrix: sparse.csc_array, largest: float) -> None:
    """No eigenvalue below 0 by more than rounding: elimination along the diagonal has positive pivots."""
    rounding = matrix.shape[0] * np.finfo(np.float64).eps * largest
    shifted = sparse.csc_array(matrix + rounding * sparse.eye_array(matrix.shape[0]))
    factors = splu(shifted, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    assert (factors.perm_r == factors.perm_c).all()  # never beside the diagonal
    assert factors.U.diagonal().min() > 0


@pytest.mark.parametrize("number", SCENES)
def test_energy_is_symmetric_positive_and_bounded(number: int) -> None:
    trial = draw_trial(0, number, long_share=1.0)
    grid = make_grid(region_of(trial.scene), trial.spacing)
    stencil = tuned_stencil(grid.kappa)
    elements = elements_of(region_of(trial.scene), grid, stencil)

    # each element by itself, which is sufficient; rounding
    own = np.linalg.eigvalsh(stiffness_matrix(elements.interface.coupling))
    assert (own[:, 0] >= -1e-13 * own[:, -1]).all()
    assert (elements.interface.mass >= 0).all()

    # the assembled operator
    cells = heterogeneous_cells(elements, stencil)
    assert (cells.mass > 0).all()
    matrix = operator_of(cells, grid.shape)
    largest = largest_eigenvalue(cells.index, cells.weight, stencil, grid.shape)
    assert np.abs(matrix - matrix.T).max() <= 1e-12 * largest
    assert_not_negative(matrix, largest)
    assert_not_negative(largest * sparse.eye_array(matrix.shape[0]) - matrix, largest)
