"""The energy of random assembled scenes: never negative, and never above its bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
from shared.random_scenes import draw_trial

from autdtorch.fdtd.assembly.element import stiffness_matrix
from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells, heterogeneous_cells
from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.stability import largest_eigenvalue
from autdtorch.fdtd.stencil import OFFSETS, Stencil, tuned_stencil
from autdtorch.propagators.scene_region import region_of

SCENES = range(12)


def dense_operator(cells: HeterogeneousCells, stencil: Stencil, shape: tuple[int, int, int]) -> np.ndarray:
    """M^-1/2 K M^-1/2 of the heterogeneous cells that are not sound-hard; all others are held at zero."""
    place = np.full(math.prod(shape), -1)
    open_cells = np.flatnonzero(~np.isin(cells.index, cells.sound_hard))
    place[cells.index[open_cells]] = np.arange(len(open_cells))
    weight, root = cells.weight[open_cells], np.sqrt(cells.mass[open_cells])
    matrix = np.diag(weight.sum(axis=1))
    neighbour = place[cells.index[open_cells, None] + np.array(OFFSETS) @ (shape[1] * shape[2], shape[2], 1)]
    row, column = np.nonzero(neighbour >= 0)
    other = neighbour[row, column]
    matrix[row, other] -= weight[row, column] * root[row] / root[other]
    return matrix


def assert_not_negative(matrix: np.ndarray, largest: float) -> None:
    """No eigenvalue below 0, but for rounding: Cholesky's factors exist. Eigenvalues would take longer."""
    rounding = len(matrix) * np.finfo(np.float64).eps * largest
    np.linalg.cholesky(matrix + rounding * np.eye(len(matrix)))


@pytest.mark.parametrize("number", SCENES)
def test_energy_is_symmetric_positive_and_bounded(number: int) -> None:
    trial = draw_trial(0, number, long_share=1.0)
    grid = make_grid(region_of(trial.scene), trial.spacing)
    stencil = tuned_stencil(grid.kappa)
    elements = elements_of(region_of(trial.scene), grid, stencil)

    # of every element by itself, which is more than it takes; what is left is rounding
    own = np.linalg.eigvalsh(stiffness_matrix(elements.interface.coupling))
    assert (own[:, 0] >= -1e-13 * own[:, -1]).all()
    assert (elements.interface.mass >= 0).all()

    # and of what is assembled, after rigid cells were closed and masses shared
    cells = heterogeneous_cells(elements, stencil)
    assert (cells.mass > 0).all()
    matrix = dense_operator(cells, stencil, grid.shape)
    largest = largest_eigenvalue(cells.index, cells.weight, stencil, grid.shape)
    assert np.abs(matrix - matrix.T).max() <= 1e-12 * largest
    assert_not_negative(matrix, largest)
    assert_not_negative(largest * np.eye(len(matrix)) - matrix, largest)
