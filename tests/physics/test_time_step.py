"""The time step against the stability limit of whole grids, from steps of the kernel."""

import functools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from scipy.sparse.linalg import LinearOperator, eigs
from small_scenes import CUBE, NO_RECEIVERS, NO_SOURCES, relative_error, small_scene

from autdtorch.fdtd.kernels.contract import uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.stability import fewest_steps
from autdtorch.fdtd.stepping import assemble, drive_dft, drive_signal
from autdtorch.propagators import make_propagator
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.obstacles import Box


def cube(density, sound_speed=340.0):
    return (Box(CUBE.center, CUBE.size, density=density, sound_speed=sound_speed),)


SCENES = {
    "air": ((), 1e-3),
    "paper": (cube(100.0), 1e-3),
    "paper, coarse": (cube(100.0), 2e-3),
    "paper, coarsest": (cube(100.0), 2.8e-3),
    "rigid": ((Box(CUBE.center, CUBE.size, rigid=True),), 1e-3),
    "heavy": (cube(1.293e4), 1e-3),
    "light": (cube(1.293e-3), 1e-3),
    "fast": (cube(100.0, 4 * 340.0), 1e-3),
    "slow": (cube(3.0, 0.3 * 340.0), 0.7e-3),
}


def scaled(c, ratio):
    names = ("face", "edge", "corner", "heterogeneous_weight")
    return replace(c, center=2 - ratio * (2 - c.center), **{name: ratio * getattr(c, name) for name in names})


def advance(c, state, steps):
    silence = torch.zeros((steps, 2), dtype=torch.float64)
    return CpuKernel().advance(state, c, NO_SOURCES, NO_RECEIVERS, silence)[0]


@functools.cache  # several tests take the same scene
def assembled(name):
    obstacles, spacing = SCENES[name]
    return assemble(region_of(small_scene(obstacles)), spacing, torch.float64)


@functools.cache
def true_eigenvalue(name):
    """Largest eigenvalue of a step on the whole grid without its layers, by Arnoldi."""
    assembly = assembled(name)
    c = assembly.coefficients
    open_ended = replace(c, layer_gain=torch.zeros_like(c.layer_gain))
    factor = assembly.stencil.time_factor(float(assembly.steps_per_period))

    def apply(pressure):
        state = uniform_state(assembly.grid.shape, c, 0.0)
        state.now[1:-1, 1:-1, 1:-1] = torch.from_numpy(pressure).reshape(inner)
        before = state.now.clone()
        new = advance(open_ended, state, 1).now
        return ((2 * before - new)[1:-1, 1:-1, 1:-1] / factor).numpy().ravel()

    inner = [cells - 2 for cells in assembly.grid.shape]
    operator = LinearOperator((math.prod(inner),) * 2, matvec=apply, dtype=np.float64)
    start = np.random.default_rng(1).standard_normal(math.prod(inner))
    (largest,) = eigs(operator, 1, which="LM", v0=start, tol=1e-4, return_eigenvectors=False)
    return float(largest.real)


@pytest.mark.parametrize("name", SCENES)
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
        inner = state.now[1:-1, 1:-1, 1:-1]
        inner.copy_(torch.randn(inner.shape, generator=torch.Generator().manual_seed(0), dtype=inner.dtype))
        state.before.copy_(state.now)
        start = float(state.now.norm())
        return float(advance(coefficients, state, steps).now.norm()) / start

    # the pressure alone is not the energy: it may rise by the root of the density ratio in a light body
    assert growth(c, 3000) < 10
    # C lambda = 4 x 1.1 grows by e^{2 acosh(sqrt(1.1))} a step at the mode's frequency: e^{0.6}
    assert growth(scaled(c, ratio), 300) > 1e30


def test_the_dft_of_a_block_is_exact():
    """Over blocks of one or several periods."""
    phasor = torch.tensor([0.3 - 2j, 1j], dtype=torch.complex128)
    for steps in (Fraction(12), Fraction(23, 2), Fraction(35, 3), Fraction(17, 4)):
        block = 100 * steps.numerator
        assert drive_signal(steps, block, 1).tolist() == [[1, 0]]
        after_each_step = drive_signal(steps, block + 1, steps.numerator)
        recorded = after_each_step @ torch.stack((phasor.real, phasor.imag))
        assert torch.allclose(drive_dft(recorded, steps.denominator), phasor, rtol=1e-12)


def test_a_given_time_step():
    scene = small_scene((CUBE,))
    finest = make_propagator(scene, "full", 2e-3, time_step=2e-6)
    chosen = make_propagator(scene, "full", 2e-3)
    assert 0.97 * 2e-6 <= finest.time_step <= 2e-6
    # the drive's frequency is exact at any time step: the tolerance remains, twice
    point = scene.control_points[:1]
    difference = relative_error(finest.transfer_matrix(point), chosen.transfer_matrix(point))
    assert difference < finest.tolerance + chosen.tolerance


def test_a_time_step_above_the_limit_is_refused():
    scene = small_scene((CUBE,))
    with pytest.raises(ValueError, match=r"time_step: 3e-06 s; must be at most 2\.3\d+e-06 s") as error:
        make_propagator(scene, "full", 1e-3, time_step=3e-6)
    limit = float(str(error.value).split("at most ")[1].split(" s")[0])
    assert make_propagator(scene, "full", 1e-3, time_step=limit).time_step <= limit
