"""Stability: the largest eigenvalue, the energy of random scenes, and short runs of them."""

import itertools
import logging
import math
from dataclasses import replace

import numpy as np
import pytest
from checks.stability import LONGER, run_trial
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse.linalg import splu
from shared.random_scenes import draw_trial

from autdtorch.fdtd import stability
from autdtorch.fdtd.assembly.element import stiffness_matrix
from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import heterogeneous_cells
from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.stability import fewest_steps, largest_eigenvalue, whole_steps
from autdtorch.fdtd.stencil import OFFSETS, tuned_stencil
from autdtorch.propagators.scene_region import region_of

STENCIL = tuned_stencil(2 * math.pi / 8.5)
SHAPE = (8, 8, 8)


def random_weights(seed, contrast, negative):
    """Heterogeneous cells in air: symmetric coupling, some of it negative, over random masses."""
    rng = np.random.default_rng(seed)
    inside = np.zeros(SHAPE, bool)
    inside[2:-2, 2:-2, 2:-2] = True
    index, strides = np.flatnonzero(inside), np.array((64, 8, 1))
    mass, weight = np.ones(math.prod(SHAPE)), np.tile(STENCIL.weights, (math.prod(SHAPE), 1))
    mass[index] = contrast ** rng.uniform(-1, 1, len(index))
    for column, offset in enumerate(OFFSETS[14:], start=14):
        for cell, other in zip(index, index + strides @ offset, strict=True):
            if inside.flat[other]:
                coupling = weight[cell, column] * rng.uniform(-negative, 1)
                coupling *= math.sqrt(mass[cell] * mass[other])
                weight[cell, column] = coupling / mass[cell]
                weight[other, 26 - column] = coupling / mass[other]
            else:
                weight[cell, column] /= mass[cell]
        for cell, other in zip(index, index - strides @ offset, strict=True):
            if not inside.flat[other]:
                weight[cell, 26 - column] /= mass[cell]
    return index, weight[index]


def dense(index, weight):
    """The operator on all cells but the outermost, which are held at zero."""
    inner = np.zeros(SHAPE, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    rows = np.flatnonzero(inner)
    full = np.tile(STENCIL.weights, (inner.size, 1))
    full[index] = weight
    matrix = np.zeros((inner.size, inner.size))
    for offset, column in zip(np.array(OFFSETS) @ (64, 8, 1), full.T, strict=True):
        matrix[rows, rows + offset] -= column[rows]
    matrix[rows, rows] += full[rows].sum(1)
    return matrix[np.ix_(rows, rows)]


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.floats(1, 1e4), st.sampled_from([0.0, 0.2]))
def test_largest_eigenvalue_is_never_below_the_truth_and_close_to_it(seed, contrast, negative):
    index, weight = random_weights(seed, contrast, negative)
    truth = max(np.abs(np.linalg.eigvals(dense(index, weight))).max(), STENCIL.largest_symbol)
    bound = largest_eigenvalue(index, weight, STENCIL, SHAPE)
    # above: the margin, or the width within which a bound is taken as it is
    assert truth * (1 - 1e-9) <= bound <= truth * max(stability.MARGIN, stability.CLOSE)


def test_eigenvalue_and_steps_of_uniform_air_are_those_of_the_shortest_wave_and_of_leapfrog():
    nothing = np.zeros(0, np.int64), np.zeros((0, 27))
    assert largest_eigenvalue(*nothing, STENCIL, SHAPE) == STENCIL.largest_symbol
    steps = fewest_steps(STENCIL, largest=9.0)
    assert STENCIL.time_factor(steps) * 9.0 == pytest.approx(4, rel=1e-12)
    assert all(a < b for a, b in itertools.pairwise(fewest_steps(STENCIL, value) for value in (7, 8, 9)))


def test_many_cells_get_the_bound(monkeypatch, caplog):
    index, weight = random_weights(0, contrast=100.0, negative=0.2)
    iterated = largest_eigenvalue(index, weight, STENCIL, SHAPE)
    monkeypatch.setattr(stability, "MOST_CELLS", len(index) - 1)
    with caplog.at_level(logging.DEBUG):
        assert largest_eigenvalue(index, weight, STENCIL, SHAPE) > iterated
    assert f"{len(index)} heterogeneous cells" in caplog.text


@given(st.floats(2.5, 1e3))
def test_steps_are_whole_in_the_shortest_block_that_is_long_enough(fewest):
    steps = whole_steps(fewest)
    assert stability.LONG_ENOUGH * steps <= fewest <= steps * (1 + 1e-9)
    for periods in range(1, steps.denominator):
        assert math.ceil(periods * fewest) * stability.LONG_ENOUGH > periods * fewest
    # a block of q periods loses less than 1 / (q fewest)
    assert steps.denominator <= 1 + stability.LONG_ENOUGH / (1 - stability.LONG_ENOUGH) / fewest


SCENES = range(12)


def operator_of(cells, shape):
    """M^-1/2 K M^-1/2 of the heterogeneous cells that are not rigid; all others are held at zero."""
    place = np.full(math.prod(shape), -1)
    open_cells = np.flatnonzero(~np.isin(cells.index, cells.rigid))
    place[cells.index[open_cells]] = np.arange(len(open_cells))
    weight, root = cells.weight[open_cells], np.sqrt(cells.mass[open_cells])
    neighbour = place[cells.index[open_cells, None] + np.array(OFFSETS) @ (shape[1] * shape[2], shape[2], 1)]
    row, column = np.nonzero(neighbour >= 0)
    other = neighbour[row, column]
    coupling = weight[row, column] * root[row] / root[other]
    size = (len(open_cells),) * 2
    return sparse.diags_array(weight.sum(axis=1)) - sparse.csc_array((coupling, (row, other)), size)


def assert_not_negative(matrix, largest):
    """No eigenvalue below 0 by more than rounding: elimination along the diagonal has positive pivots."""
    rounding = matrix.shape[0] * np.finfo(np.float64).eps * largest
    shifted = sparse.csc_array(matrix + rounding * sparse.eye_array(matrix.shape[0]))
    factors = splu(shifted, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    assert (factors.perm_r == factors.perm_c).all()  # never beside the diagonal
    assert factors.U.diagonal().min() > 0


@pytest.mark.parametrize("number", SCENES)
def test_energy_is_symmetric_positive_and_bounded(number):
    trial = draw_trial(0, number, long_share=1.0)
    grid = make_grid(region_of(trial.scene), trial.spacing)
    stencil = tuned_stencil(grid.kappa)
    elements = elements_of(region_of(trial.scene), grid, stencil)

    # each element by itself, which is sufficient; rounding
    eigenvalues = np.linalg.eigvalsh(stiffness_matrix(elements.interface.coupling))
    assert (eigenvalues[:, 0] >= -1e-13 * eigenvalues[:, -1]).all()
    assert (elements.interface.mass >= 0).all()

    # the assembled operator
    cells = heterogeneous_cells(elements, stencil)
    assert (cells.mass > 0).all()
    matrix = operator_of(cells, grid.shape)
    largest = largest_eigenvalue(cells.index, cells.weight, stencil, grid.shape)
    assert np.abs(matrix - matrix.T).max() <= 1e-12 * largest
    assert_not_negative(matrix, largest)
    assert_not_negative(largest * sparse.eye_array(matrix.shape[0]) - matrix, largest)


@pytest.mark.parametrize("number", range(14))
def test_random_scenes_are_stable(number, caplog, monkeypatch):
    trial = replace(draw_trial(0, number, long_share=1.0), steps=1_000)
    caplog.set_level(logging.ERROR)
    monkeypatch.setattr("checks.stability.SAMPLES", 4)  # of windows of 31 steps; calls for two steps are slow
    outcome = run_trial(trial)
    if outcome.failed and outcome.finite:  # a resonance may still swing in a short run
        outcome = run_trial(replace(trial, steps=LONGER * trial.steps))
    assert not outcome.failed, str(outcome)
