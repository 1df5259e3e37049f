"""Transducers whose sound has a phase of its own: the field of q is that of q e^{i phase} without phases."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import AIR, relative_error, small_scene

import autdtorch as at
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.propagators import differentiable_field, make_propagator
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.scene.arrays import complex_strengths_of, phase_offsets_of, strengths_of
from autdtorch.scene.changes import changed_array

WAVENUMBER = 2 * math.pi * 40e3 / 340.0
PHASES = torch.tensor([0.0, 0.4, -1.7, 4.0], dtype=torch.float64)
GAINS = torch.tensor([1.0, 0.8, 1.3, 0.8], dtype=torch.float64)
TURN = torch.polar(torch.ones(4, dtype=torch.float64), PHASES)
DRIVE = torch.tensor([1.0, 0.5j, -0.2, 0.1 + 0.7j], dtype=torch.complex128)
BALL = at.Sphere((12e-3, 12e-3, 12e-3), 3e-3, rigid=True)
ROUNDING = 1e-14  # of products in another order


def scene_of(array, obstacles=(), **more):
    base = small_scene(obstacles)
    return at.Scene(array, AIR, 40e3, base.control_points, obstacles, domain=base.domain, **more)


PLAIN = small_scene().array
POINTS = small_scene().control_points
TURNED = PLAIN.calibrated(phase=PHASES)
PHASE = st.floats(-10, 10)


@given(st.lists(PHASE, min_size=4, max_size=4) | PHASE, st.lists(st.floats(0.1, 3), min_size=4, max_size=4))
def test_the_free_field_has_the_phase_and_gain_of_each_transducer(phase, gain):
    array = PLAIN.calibrated(gain, phase)
    points = small_scene().control_points
    turn = torch.exp(1j * torch.as_tensor(phase, dtype=torch.float64))
    expected = free_space_matrix(points, PLAIN, WAVENUMBER) * torch.tensor(gain, dtype=torch.float64) * turn
    assert relative_error(free_space_matrix(points, array, WAVENUMBER), expected) < ROUNDING


@pytest.mark.parametrize("method", ["full", "box", "tmatrix"])
def test_a_simulated_field_has_the_phases_too(method):
    """Columns of the matrix and fields of drives, in a scene whose transducers are images of one another."""
    settings = {} if method == "tmatrix" else {"dtype": "float64", "cache": False, "spacing": 1.3e-3}
    plain, turned = (
        make_propagator(scene_of(array, (BALL,)), method, **settings) for array in (PLAIN, TURNED)
    )
    assert relative_error(turned.transfer_matrix(), plain.transfer_matrix() * TURN) < ROUNDING
    assert relative_error(turned.field(DRIVE, POINTS), plain.field(DRIVE * TURN, POINTS)) < 1e-12


@pytest.mark.parametrize("method", ["full", "box"])
def test_a_calibrated_array_takes_no_runs_of_its_own(method):
    """Control points, and points beside, whose pressure a box takes from what it radiates."""
    settings = {"dtype": "float64", "spacing": 1.3e-3}
    before = make_propagator(scene_of(PLAIN, (BALL,)), method, **settings)
    after = before.for_scene(scene_of(PLAIN.calibrated(GAINS, PHASES), (BALL,)))
    for points in (POINTS, torch.cat([POINTS + 1e-3, POINTS - 1e-3])):
        expected = before.transfer_matrix(points) * GAINS * TURN
        assert relative_error(after.transfer_matrix(points), expected) < ROUNDING
    assert len(after.runs) == 0


@pytest.mark.filterwarnings("ignore::autdtorch.SteadyStateWarning")
def test_gradients_of_the_differentiable_field_have_them():
    """Through time steps: rounding of some hundred."""
    step = {"spacing": 1.3e-3, "periods": 4, "dtype": "float64"}
    results = []
    for array, turn in ((TURNED, torch.ones_like(TURN)), (PLAIN, TURN)):
        drive = DRIVE.clone().requires_grad_()
        field = differentiable_field(scene_of(array), drive * turn, **step)
        (gradient,) = torch.autograd.grad(field.abs().square().sum(), drive)
        results.append((field.detach(), gradient))
    for found, expected in zip(*results, strict=True):
        assert relative_error(found, expected) < 1e-11


def test_the_absorbed_power_is_that_of_the_phased_sound():
    floor = at.Reflector((0.0, 0.0, -1e-3), (0, 0, 1), 0.5)
    power = [
        make_propagator(scene_of(array, reflectors=[floor]), "free_space").absorbed_power(drive).reflectors
        for array, drive in ((TURNED, DRIVE), (PLAIN, DRIVE * TURN), (PLAIN, DRIVE))
    ]
    torch.testing.assert_close(power[0], power[1], rtol=1e-12, atol=0)
    assert not torch.allclose(power[0], power[2], rtol=1e-3)


def test_focus_drives_make_up_for_the_phases():
    """All transducers reach a single focus in step, so that magnitudes add up."""
    base = scene_of(TURNED)
    scene = at.Scene(TURNED, AIR, 40e3, base.control_points[:1], domain=base.domain)
    propagator = make_propagator(scene, "free_space")
    solution = at.lss(SimulatedObjective(scene, propagator))
    most = propagator.transfer_matrix().abs().sum()
    assert float(solution.pressure) == pytest.approx(float(most), rel=1e-12)


def test_without_phases_strengths_stay_real():
    assert complex_strengths_of(PLAIN).dtype == torch.float64
    assert complex_strengths_of(PLAIN.calibrated(GAINS)).dtype == torch.float64
    assert torch.equal(complex_strengths_of(TURNED), strengths_of(PLAIN) * TURN)


def test_arrays_differ_by_their_phases_and_are_joined_with_them():
    assert not scene_of(TURNED).equals(scene_of(PLAIN))
    assert scene_of(TURNED).equals(scene_of(PLAIN.calibrated(phase=PHASES)))
    twice = PLAIN.calibrated(GAINS, 0.5).calibrated(1 / GAINS, PHASES - 0.5)
    torch.testing.assert_close(phase_offsets_of(twice), PHASES, rtol=0, atol=1e-15)
    torch.testing.assert_close(strengths_of(twice), strengths_of(PLAIN), rtol=1e-15, atol=0)
    other = at.TransducerArray([(0.1, 0, 0)], (-1, 0, 0), phase=0.3)
    assert phase_offsets_of(other + TURNED).tolist() == [0.3, *PHASES.tolist()]
    assert "phase -1.7 to 4 rad" in repr(TURNED)
    assert "phase -1.7 to 4 rad" in scene_of(TURNED)._repr_html_()
    assert "phase" not in repr(PLAIN)


def test_a_moved_array_and_one_of_other_discs_have_the_phases_too():
    moved = changed_array(TURNED.calibrated(GAINS), {"array.x": 1e-3, "radius": 2e-3})
    assert torch.equal(phase_offsets_of(moved), PHASES)
    assert torch.equal(strengths_of(moved), strengths_of(PLAIN) * GAINS)
