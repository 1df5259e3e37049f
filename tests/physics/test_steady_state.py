"""Steady states of runs that are stepped together, against those of runs alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from emulated_gpu import gpu
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import CUBE, assembled_parts, relative_error, small_scene

from autdtorch import Box, Reflector, make_propagator
from autdtorch.fdtd.extrapolation import Extrapolation
from autdtorch.fdtd.kernels.contract import CPU, Layer, Memory, Sources, WaveState
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.short_runs import short_runs
from autdtorch.fdtd.steady_state import run_to_steady_state
from autdtorch.propagators.store import BODIES

MODES = 3


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.integers(MODES + 2, 12), st.integers(MODES + 2, 30))
def test_limits_of_sequences_of_few_modes_are_exact(seed, most, count):
    """x_(n+1) = A x_n + b with three modes, whose differences the mean removes."""
    random = torch.Generator().manual_seed(seed)

    def complex_numbers(*shape):
        return torch.randn(shape, generator=random, dtype=torch.complex128)

    limit, modes, turns = complex_numbers(4, 50), complex_numbers(4, MODES, 50), complex_numbers(4, MODES)
    factors = 0.9 * turns / turns.abs().clamp(min=1)
    together, rest = Extrapolation(most), torch.tensor([0, 2])
    for number in range(count):
        together.append(limit + torch.einsum("rmk,rm->rk", modes, factors**number))
    limits = together.limits(torch.arange(4))
    # the regularisation of squares, 1e-13, leaves its root; a mode that has almost decayed leaves less
    assert relative_error(limits.mT, limit) < 1e-4
    together.choose(rest)
    assert relative_error(together.limits(torch.arange(2)), limits[:, rest]) < 1e-9


class Kernel(CpuKernel):
    """Steps a number of runs together, and notes how many runs each call steps."""

    def __init__(self, runs):
        super().__init__()
        self.runs, self.stepped = runs, []

    def together(self, shape, receivers):
        return self.runs

    def at_once(self, shape):
        return 1

    def advance(self, state, *arguments):
        self.stepped.append(len(state.now))
        return super().advance(state, *arguments)


class KernelOfGpu(Kernel):
    """Its states and records are on the GPU, as those of the kernel for GPUs."""

    device = torch.device("cuda", 0)

    def advance(self, state, *arguments):
        state, recorded = super().advance(moved(state, CPU), *arguments)
        return moved(state, self.device), recorded.to(self.device)


def moved(state, device):
    memory = Memory(*(Layer(*(part.to(device) for part in layer)) for layer in state.memory))
    return WaveState(state.now.to(device), state.before.to(device), memory)


TOLERANCES = 1e-2, 1e-6, 1e-2, 1e-4, 1e-9


def states_of_five_runs(kernel, most_periods, loudness=1.0, tolerances=TOLERANCES):
    """Runs of different forces, the last one `loudness` times as loud, and of different tolerances."""
    assembly, sources, receivers = assembled_parts(small_scene((CUBE,)), 2.8e-3, torch.float64)
    cells = np.unique(receivers.index)
    random = torch.Generator().manual_seed(1)
    forces = sources.force * torch.randn((5, len(sources.index), 1), generator=random, dtype=torch.float64)
    forces[-1] *= loudness
    return run_to_steady_state(
        assembly, kernel, lambda runs: Sources(sources.index, forces[runs]), cells, tolerances,
        most_periods, lambda phasors, runs: [phasors], lambda periods: None, torch.zeros((1, 5)),
    )  # fmt: skip


@pytest.mark.parametrize("most_periods", [200, 10])
def test_runs_together_end_each_at_its_time(most_periods):
    together, alone = Kernel(5), Kernel(1)
    states, singles = (states_of_five_runs(kernel, most_periods) for kernel in (together, alone))
    for state, single in zip(states, singles, strict=True):
        assert (state.periods, state.converged) == (single.periods, single.converged)
        # rounding, which the extrapolation of small differences magnifies
        assert relative_error(state.pressure.cpu(), single.pressure) < 1e-10
        assert state.residual == pytest.approx(single.residual, rel=1e-2)
    assert set(alone.stepped) == {1}
    assert sum(together.stepped) <= 2 * sum(alone.stepped)  # at most half of those stepped have converged
    if most_periods == 200:
        assert together.stepped[-1] < 5


def test_residuals_are_about_the_distance_to_the_steady_state():
    """Required: a quarter of it to 20 times; 70 runs of other scenes had 0.5 to 10 times, once 40 usually."""
    tolerances = 1e-2, 3e-3, 1e-3, 3e-4, 1e-4
    runs, limits = (states_of_five_runs(Kernel(5), 200, 1.0, each) for each in (tolerances, [1e-7] * 5))
    for run, limit in zip(runs, limits, strict=True):
        assert 0.25 < run.residual / relative_error(run.pressure, limit.pressure) < 20


def test_short_runs_approach_the_steady_state():
    """Also where the last two periods are no whole number of steps."""
    assembly, sources, receivers = assembled_parts(small_scene((CUBE,)), 2e-3, torch.float64)
    assert (2 * assembly.steps_per_period).denominator > 1
    cells, kernel, stepped = np.unique(receivers.index), Kernel(1), []
    forces = torch.stack([sources.force[0], -2 * sources.force[0]])

    def drive(runs):
        return Sources(sources.index, forces[runs])

    (steady,) = run_to_steady_state(
        assembly, kernel, lambda _: drive([0]), cells, [1e-9], 200,
        lambda phasors, runs: [phasors], stepped.append, torch.zeros((1, 1)),
    )  # fmt: skip
    errors = []
    for periods in (1, 12, 100):
        one, other = short_runs(assembly, kernel, drive, cells, 2, periods, stepped.append)
        assert stepped[-2:] == [max(periods, 4)] * 2  # there is a switch-on, and a record
        assert relative_error(other.pressure, -2 * one.pressure) < 1e-12  # rounding, as a run is linear
        errors.append(relative_error(one.pressure, steady.pressure))
    # a cube of air's sound speed has no long resonances; the record leaves some of the switch-on
    assert errors[0] > 0.1 > errors[1] > errors[2]
    assert errors[2] < 1e-3


def test_a_faint_run_does_not_depend_on_loud_ones_beside_it():
    faint, alone = states_of_five_runs(Kernel(5), 30, 1e-17)[-1], states_of_five_runs(Kernel(1), 30)[-1]
    # rounding, as above
    assert relative_error(1e17 * faint.pressure, alone.pressure) < 1e-9


def test_phasors_stay_on_the_gpu_of_the_record():
    """Without a GPU on tensors that refuse to meet those of the CPU."""
    with gpu():
        states = states_of_five_runs(KernelOfGpu(5), 30)
    for state, single in zip(states, states_of_five_runs(Kernel(5), 30), strict=True):
        assert state.pressure.device.type == "cuda"
        assert (state.periods, state.converged) == (single.periods, single.converged)
        # rounding, as sums have other parts
        assert relative_error(state.pressure.cpu(), single.pressure) < 1e-10


PLATE = Box((12e-3, 12e-3, 12e-3), (4e-3, 9e-3, 3e-3), rigid=True, rotation=(0.3, 0.2, 0.1))
FAR = Box((30e-3, 60e-3, 150e-3), (4e-3, 7e-3, 3e-3), rigid=True)
FLOOR = Reflector((0.0, 0.0, -10e-3), (0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("method", "scene", "grids"),
    [
        ("full", small_scene((PLATE,)), 1),
        ("box", small_scene((PLATE,)), 1),
        ("box", replace(small_scene((PLATE,)), reflectors=(FLOOR,)), 1),
        ("box", replace(small_scene((PLATE,)), obstacles=(PLATE, FAR), domain=((0.0,) * 3, (0.16,) * 3)), 2),
        ("tmatrix", small_scene((PLATE,)), 1),
    ],
    ids=["full", "box", "echo", "boxes", "tmatrix"],
)
def test_matrices_of_runs_together_are_those_of_runs_alone(method, scene, grids, monkeypatch):
    """In single precision; with a reflector, what it sends back drives the runs."""
    matrices = []
    for runs in (1, 3):
        monkeypatch.setattr(CpuKernel, "together", lambda self, shape, receivers, runs=runs: runs)
        BODIES.forget()
        propagator = make_propagator(scene, method, 2e-3, tolerance=1e-3, cache=False)
        assert len(propagator.plan.grouping.grids) == grids
        matrices.append(propagator.transfer_matrix())
    # rounding of single precision, which the extrapolation of small differences magnifies
    assert all(relative_error(matrix, matrices[0]) < 1e-5 for matrix in matrices)
