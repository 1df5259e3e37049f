"""Stability: eigenvalues, energy, time steps at the limit, and short runs of random scenes."""

import functools
import itertools
import logging
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from checks.stability import LONGER, run_trial
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigs, splu
from shared.random_scenes import draw_trial
from small_scenes import AIR, CUBE, NO_RECEIVERS, NO_SOURCES, relative_error, small_scene

from autdtorch.fdtd import stability
from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import heterogeneous_cells
from autdtorch.fdtd.assembly.losses import GROUND
from autdtorch.fdtd.assembly.reference_element import stiffness_matrix
from autdtorch.fdtd.grid import make_box, make_grid
from autdtorch.fdtd.kernels.contract import uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.stability import fewest_steps, largest_eigenvalue, whole_steps
from autdtorch.fdtd.stencil import OFFSETS, tuned_stencil
from autdtorch.fdtd.stepping import assemble, assemble_on, drive_dft, drive_signal
from autdtorch.propagators import make_propagator
from autdtorch.propagators.plan import region_of
from autdtorch.scene.obstacles import Box

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
    index, weight = random_weights(0, contrast=10.0, negative=0.2)
    iterated = largest_eigenvalue(index, weight, STENCIL, SHAPE)
    monkeypatch.setattr(stability, "MOST_CELLS", len(index) - 1)
    with caplog.at_level(logging.DEBUG):
        assert largest_eigenvalue(index, weight, STENCIL, SHAPE) > iterated
    assert f"{len(index)} heterogeneous cells" in caplog.text


@settings(max_examples=5)
@given(st.floats(0.01, 100.0), st.floats(0.4e-3, 3e-3))
def test_long_bodies_are_shortened_where_their_planes_repeat(density, thickness):
    """By at most a third of the margin, which the iteration needs little of."""
    plate = Box((30e-3, 30e-3, 30e-3), (45e-3, 42e-3, thickness), density=density * 1.2, sound_speed=500.0)
    region = region_of(small_scene((plate,), extent=60e-3))
    grid = make_grid(region, 1e-3)
    stencil = tuned_stencil(grid.kappa)
    cells = heterogeneous_cells(elements_of(region, grid, stencil), stencil)
    with pytest.MonkeyPatch.context() as patch:
        whole = largest_eigenvalue(cells.index, cells.weight, stencil, grid.shape)
        patch.setattr(stability, "_LARGE", 0)
        short = largest_eigenvalue(cells.index, cells.weight, stencil, grid.shape)
    assert short == pytest.approx(whole, rel=(stability.MARGIN - 1) / 3)


@given(st.floats(2.5, 1e3))
def test_steps_are_whole_in_the_shortest_block_that_is_long_enough(fewest):
    steps = whole_steps(fewest)
    assert stability.LONG_ENOUGH * steps <= fewest <= steps * (1 + 1e-9)
    for periods in range(1, steps.denominator):
        assert math.ceil(periods * fewest) * stability.LONG_ENOUGH > periods * fewest
    # a block of q periods loses less than 1 / (q fewest)
    assert steps.denominator <= 1 + stability.LONG_ENOUGH / (1 - stability.LONG_ENOUGH) / fewest


SCENES = [number for number in range(13) if number != 6]  # whose fits of slender bodies take half a minute


def operator_of(cells, shape):
    """M^-1/2 K M^-1/2 of the heterogeneous cells that are not rigid; all others are held at zero.

    K includes the stiffness of surfaces against silence.
    """
    place = np.full(math.prod(shape), -1)
    open_cells = np.flatnonzero(~np.isin(cells.index, cells.rigid))
    place[cells.index[open_cells]] = np.arange(len(open_cells))
    weight, root = cells.weight[open_cells], np.sqrt(cells.mass[open_cells])
    neighbour = place[cells.index[open_cells, None] + np.array(OFFSETS) @ (shape[1] * shape[2], shape[2], 1)]
    row, column = np.nonzero(neighbour >= 0)
    other = neighbour[row, column]
    coupling = weight[row, column] * root[row] / root[other]
    size = (len(open_cells),) * 2
    ground = cells.loss_rows[open_cells, 28] / cells.mass[open_cells]
    return sparse.diags_array(weight.sum(axis=1) + ground) - sparse.csc_array((coupling, (row, other)), size)


def assert_not_negative(matrix, largest):
    """No eigenvalue below 0 by more than rounding: elimination along the diagonal has positive pivots."""
    rounding = matrix.shape[0] * np.finfo(np.float64).eps * largest
    shifted = sparse.csc_array(matrix + rounding * sparse.eye_array(matrix.shape[0]))
    factors = splu(shifted, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    assert (factors.perm_r == factors.perm_c).all()  # never beside the diagonal
    assert factors.U.diagonal().min() > 0


@pytest.mark.parametrize("number", SCENES[::2])
def test_energy_is_symmetric_positive_and_bounded(number):
    trial = draw_trial(0, number, long_share=1.0)
    region = region_of(trial.scene).whole
    grid = make_grid(region, trial.spacing)
    stencil = tuned_stencil(grid.kappa)
    elements = elements_of(region, grid, stencil)

    # each element by itself, which is sufficient; rounding
    stiffness = stiffness_matrix(elements.interface.coupling)
    if elements.materials.losses is not None:
        # finite elements also have the masses of impedances, as stiffness against silence
        ground = np.where(elements.interface.finite[:, None], elements.interface.loss[:, GROUND], 0)
        stiffness[:, range(8), range(8)] += ground
    eigenvalues = np.linalg.eigvalsh(stiffness)
    assert (eigenvalues[:, 0] >= -1e-13 * eigenvalues[:, -1]).all()
    assert (elements.interface.mass >= 0).all()

    # the assembled operator
    cells = heterogeneous_cells(elements, stencil)
    assert (cells.mass > 0).all()
    matrix = operator_of(cells, grid.shape)
    rows = cells.weight.copy()
    rows[:, 13] = cells.loss_rows[:, 28] / cells.mass
    if not rows[:, 13].any():
        assert_not_negative(cells.largest * sparse.eye_array(matrix.shape[0]) - matrix, cells.largest)
    largest = largest_eigenvalue(cells.index, rows, stencil, grid.shape)
    assert np.abs(matrix - matrix.T).max() <= 1e-12 * largest
    assert_not_negative(matrix, largest)
    assert_not_negative(largest * sparse.eye_array(matrix.shape[0]) - matrix, largest)


@pytest.mark.parametrize("number", SCENES[::3])
def test_random_scenes_are_stable(number, caplog, monkeypatch):
    trial = replace(draw_trial(0, number, long_share=1.0), steps=500)
    caplog.set_level(logging.ERROR)
    monkeypatch.setattr("checks.stability.SAMPLES", 4)  # of windows of 31 steps; calls for two steps are slow
    outcome = run_trial(trial)
    if outcome.failed and outcome.finite:  # a resonance may still swing in a short run
        outcome = run_trial(replace(trial, steps=LONGER * trial.steps))
    assert not outcome.failed, str(outcome)


def cube(**material):
    return (Box((7.5e-3,) * 3, (6e-3, 8e-3, 4e-3), **material),)


CASES = {
    "air": ((), 1e-3),
    "paper": (cube(density=100.0, sound_speed=340.0), 1e-3),
    "paper, coarsest": (cube(density=100.0, sound_speed=340.0), 2.8e-3),
    "rigid": (cube(rigid=True), 1e-3),
    "light": (cube(density=1.293e-3, sound_speed=340.0), 1e-3),
    "fast": (cube(density=100.0, sound_speed=4 * 340.0), 1e-3),
    "slow": (cube(density=3.0, sound_speed=0.3 * 340.0), 0.7e-3),
}


def scaled(c, ratio):
    names = ("face", "edge", "corner", "heterogeneous_weight")
    return replace(c, center=2 - ratio * (2 - c.center), **{name: ratio * getattr(c, name) for name in names})


def advance(c, state, steps):
    silence = torch.zeros((steps, 2), dtype=torch.float64)
    return CpuKernel().advance(state, c, NO_SOURCES, NO_RECEIVERS, silence)[0]


@functools.cache  # several tests take the same scene
def assembled(name):
    obstacles, spacing = CASES[name]
    return assemble(region_of(small_scene(obstacles, extent=15e-3)), spacing, torch.float64)


@functools.cache
def true_eigenvalue(name):
    """Largest eigenvalue of a step on the whole grid without its layers, by Arnoldi, to 1e-3."""
    assembly = assembled(name)
    c = assembly.coefficients
    open_ended = replace(c, layer_gain=torch.zeros_like(c.layer_gain))
    factor = assembly.stencil.time_factor(float(assembly.steps_per_period))

    def apply(pressure):
        state = uniform_state(assembly.grid.shape, c, 0.0)
        state.now[0, 1:-1, 1:-1, 1:-1] = torch.from_numpy(pressure).reshape(inner)
        before = state.now.clone()
        new = advance(open_ended, state, 1).now
        return ((2 * before - new)[0, 1:-1, 1:-1, 1:-1] / factor).numpy().ravel()

    inner = [cells - 2 for cells in assembly.grid.shape]
    operator = LinearOperator((math.prod(inner),) * 2, matvec=apply, dtype=np.float64)
    start = np.random.default_rng(1).standard_normal(math.prod(inner))
    (largest,) = eigs(operator, 1, which="LM", v0=start, tol=1e-3, return_eigenvectors=False)
    return float(largest.real)


@pytest.mark.parametrize("name", CASES)
def test_time_step_is_just_below_the_limit(name):
    assembly = assembled(name)
    limit = fewest_steps(assembly.stencil, true_eigenvalue(name))
    assert 0.95 <= limit / float(assembly.steps_per_period) <= 1


@pytest.mark.parametrize("name", ["paper", "light"])
def test_a_run_is_bounded_at_the_chosen_time_step_and_blows_up_above_the_limit(name):
    assembly = assembled(name)
    stencil, c = assembly.stencil, assembly.coefficients
    limit = fewest_steps(stencil, true_eigenvalue(name))
    ratio = stencil.time_factor(limit / 1.05) / stencil.time_factor(float(assembly.steps_per_period))

    def growth(coefficients, steps):
        state = uniform_state(assembly.grid.shape, c, 0.0)
        inner = state.now[0, 1:-1, 1:-1, 1:-1]
        inner.copy_(torch.randn(inner.shape, generator=torch.Generator().manual_seed(0), dtype=inner.dtype))
        state.before.copy_(state.now)
        start = float(state.now.norm())
        return float(advance(coefficients, state, steps).now.norm()) / start

    # the pressure alone is not the energy: it may rise by the root of the density ratio in a light body
    assert growth(c, 3000) < 10
    # C lambda = 4 x 1.1 grows by e^{2 acosh(sqrt(1.1))} a step at the mode's frequency: e^{0.6}
    assert growth(scaled(c, ratio), 300) > 1e30


def test_a_light_body_that_pulsates_in_a_box_does_not_grow():
    """Radiation damps its breathing mode, at 900 Hz, by 4e-3 in a period of the drive.

    The layer is a 30th of its wavelength thick, and damps it by 8e-4. With one frequency shift from end to
    end the mode grows by 3e-4.
    """
    body = Box((12e-3, 12e-3, 12e-3), (7e-3, 6e-3, 5e-3), density=1e-3 * AIR.density, sound_speed=340.0)
    region = region_of(small_scene((body,)))
    assembly = assemble_on(make_box(region, 1.9e-3), region, torch.float64, None)
    state = uniform_state(assembly.grid.shape, assembly.coefficients, 0.0)
    state.now.view(-1)[assembly.heterogeneous.index] = 1
    state.before.copy_(state.now)
    swing, period = [], round(45 * float(assembly.steps_per_period))  # of the mode
    for _ in range(24):
        peak = 0.0
        for _ in range(4):
            state = advance(assembly.coefficients, state, period // 4)
            peak = max(peak, float(state.now.abs().max()))
        swing.append(peak)
    # 16 of its periods are 720 of the drive's
    assert swing[-1] < 0.8 * swing[7]


def test_the_dft_of_a_block_is_exact():
    """Over blocks of one or several periods."""
    phasor = torch.tensor([0.3 - 2j, 1j], dtype=torch.complex128)
    for steps in (Fraction(12), Fraction(23, 2), Fraction(35, 3), Fraction(17, 4)):
        block = 100 * steps.numerator
        assert drive_signal(steps, block, 1).tolist() == [[1, 0]]
        after_each_step = drive_signal(steps, block + 1, steps.numerator)
        recorded = after_each_step @ torch.stack((phasor.real, phasor.imag))
        assert torch.allclose(drive_dft(recorded, steps.denominator), phasor, rtol=1e-12)


def test_a_given_time_step_is_kept_below_the_limit():
    scene = small_scene((CUBE,))
    finest = make_propagator(scene, "full", 2e-3, time_step=2e-6)
    chosen = make_propagator(scene, "full", 2e-3)
    assert 0.97 * 2e-6 <= finest.time_step <= 2e-6
    # the drive's frequency is exact at any time step: the tolerance remains, twice
    point = scene.control_points[:1]
    difference = relative_error(finest.transfer_matrix(point), chosen.transfer_matrix(point))
    assert difference < finest.tolerance + chosen.tolerance
    scene = small_scene((CUBE,))
    with pytest.raises(ValueError, match=r"time_step: 3e-06 s; must be at most 2\.3\d+e-06 s") as error:
        make_propagator(scene, "full", 1e-3, time_step=3e-6)
    limit = float(str(error.value).split("at most ")[1].split(" s")[0])
    assert make_propagator(scene, "full", 1e-3, time_step=limit).time_step <= limit


def test_many_steps_in_a_period_take_double_precision():
    """In single precision free air grows by 4e2 in 20 periods of 6000 steps, and does not in double."""
    region = region_of(small_scene(())).whole
    dtypes = [
        assemble(region, 2e-3, torch.float32, 1 / (count * region.frequency)).dtype for count in (100, 6000)
    ]
    assert dtypes == [torch.float32, torch.float64]
