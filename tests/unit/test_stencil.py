import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autdtorch.fdtd.stencil import OFFSETS, tuned_stencil

KAPPAS = st.floats(0.1, 2 * math.pi / 3)


def directions(count):
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def symbol_at(stencil, kappa):
    """The symbol (...) of real or complex wave vectors times spacing (..., 3)."""
    return (stencil.weights * (1 - np.cos(kappa @ np.array(OFFSETS).T))).sum(-1)


@pytest.mark.parametrize(("cells", "bound"), [(17.0, 1e-8), (8.5, 1e-6), (4.25, 1e-4), (3.0, 1e-3)])
def test_symbol_is_the_same_in_every_direction(cells, bound):
    # relative error of the frequency, half the symbol's: 4e-7 at 8.5 and 3e-5 at 4.25 cells per wavelength
    stencil = tuned_stencil(2 * math.pi / cells)
    symbol = symbol_at(stencil, stencil.kappa * directions(2000))
    assert np.abs(symbol / stencil.symbol - 1).max() / 2 < bound


@given(KAPPAS, st.integers(4, 40))
def test_plane_wave_at_the_drive_frequency_turns_by_one_period_in_whole_steps(kappa, steps):
    stencil = tuned_stencil(kappa)
    # Exact up to the anisotropy that is left, 1e-3 at the coarsest.
    cosine = 1 - stencil.time_factor(steps) * symbol_at(stencil, kappa * directions(20)) / 2
    assert np.allclose(cosine, math.cos(2 * math.pi / steps), atol=2e-3)


@pytest.mark.parametrize(("cells", "bound"), [(17.0, 2e-3), (8.5, 1e-2), (4.25, 4e-2)])
def test_plane_wave_falls_by_its_attenuation(cells, bound):
    """The residual of e^{i (kappa + i eta) n - i w t} in the discrete equation, in all directions."""
    kappa, steps = 2 * math.pi / cells, 20
    eta = 5e-3 * kappa
    stencil = tuned_stencil(kappa, eta)
    damping, turn = stencil.damping(steps), 2 * math.pi / steps
    symbol = symbol_at(stencil, (kappa + 1j * eta) * directions(200))
    left = 2 * math.cos(turn) - 2j * damping * math.sin(turn) - 2 + stencil.time_factor(steps) * symbol
    # divided by the slope of the symbol it is an error of the wavenumber
    error = left / (stencil.time_factor(steps) * stencil.slope)
    assert np.abs(error).max() < bound * eta
    assert abs(np.mean(error)) < 0.1 * bound * eta


@given(KAPPAS)
def test_no_loss_no_damping(kappa):
    assert tuned_stencil(kappa).damping(12) == 0
    # The term D (p_new - p_old) lets a wave fall by D a step: eta / kappa of the turn.
    assert tuned_stencil(kappa, 1e-3 * kappa).damping(200) == pytest.approx(1e-3 * math.pi / 100, rel=0.5)


@given(KAPPAS)
def test_long_waves_see_the_laplacian(kappa):
    stencil = tuned_stencil(kappa)
    assert stencil.weights.sum() == pytest.approx(stencil.total)
    # the next term of the expansion is of relative size 1e-6
    assert np.allclose(symbol_at(stencil, 1e-3 * directions(20)), 1e-6, rtol=1e-5)


@given(KAPPAS)
def test_largest_symbol_bounds_every_wave_and_is_reached(kappa):
    stencil = tuned_stencil(kappa)
    axis = np.linspace(0, math.pi, 9)
    waves = np.stack(np.meshgrid(axis, axis, axis), axis=-1)
    assert symbol_at(stencil, waves).max() == pytest.approx(stencil.largest_symbol, rel=1e-12)


def test_source_factor_tends_to_that_of_the_continuum_on_fine_grids():
    # naive normalisation: 4 pi (c dt / h)^2; the grid's factor differs by kappa^2 / 6 or so
    stencil = tuned_stencil(0.05)
    courant = 2 * math.pi / 40 / 0.05
    assert stencil.source_factor(40) == pytest.approx(4 * math.pi * courant**2, rel=5e-3)
