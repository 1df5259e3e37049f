"""Cells and their neighbours: masks around cells, and enclosed air."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation, label

from autdtorch.fdtd.assembly.neighbours import enclosed_cells, inner_cells, with_neighbours
from autdtorch.fdtd.stencil import OFFSETS

SHAPE = (9, 8, 7)
AROUND = np.ones((3, 3, 3), bool)
INNER = np.zeros(SHAPE, bool)
INNER[1:-1, 1:-1, 1:-1] = True
SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=20)
@given(SEEDS)
def test_neighbours_of_cells_are_those_at_all_27_offsets(seed):
    cells = INNER & (np.random.default_rng(seed).random(SHAPE) < 0.05)
    near, expected = with_neighbours(np.flatnonzero(cells), SHAPE), binary_dilation(cells, AROUND)
    assert (near == expected).all()
    assert (inner_cells(near) == np.flatnonzero(INNER & expected)).all()


@settings(max_examples=50)
@given(SEEDS, st.integers(2, 6))
def test_enclosed_air_is_that_which_no_path_of_coupled_cells_leaves(seed, wall):
    """Cells are coupled with all neighbours, but hardly through a plane."""
    free = INNER & (np.random.default_rng(seed).random(SHAPE) < 0.25)
    cells = inner_cells(np.ones(SHAPE, bool))
    x, step = cells // (SHAPE[1] * SHAPE[2]), np.array(OFFSETS)[:, 0]
    crossing = ((x == wall)[:, None] & (step == 1)) | ((x == wall + 1)[:, None] & (step == -1))
    coupling = np.where(crossing, 1e-5, 1.0)
    enclosed = enclosed_cells(coupling, coupling.sum(axis=1), cells, ~free.ravel(), SHAPE, 1.0)
    rim = INNER.copy()
    rim[2:-2, 2:-2, 2:-2] = False
    expected = np.zeros(SHAPE, bool)
    for half in (slice(wall + 1), slice(wall + 1, None)):
        part = label(free[half], AROUND)[0]
        expected[half] = (part > 0) & ~np.isin(part, part[rim[half]])
    assert (enclosed == np.flatnonzero(expected)).all()
