"""Goals of force: forms of the drive, their bounds, and whether a trap exists."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.objectives.hermitian import ascended, forms_bound

BEAD = at.Particle.of("EPS", 0.5e-3)
POINT = (0.001, 0.002, 0.03)


@pytest.fixture(scope="module")
def propagator():
    array = at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0), (0, 0, 1), source_strength=1.0)
    return at.make_propagator(at.Scene(array, at.Medium.air(), 40e3, [(0, 0, 0.1)]), "free_space")


def drives(count, transducers, seed=0):
    generator = torch.Generator().manual_seed(seed)
    size, turn = torch.rand(2, count, transducers, generator=generator, dtype=torch.float64)
    return torch.polar(size.sqrt(), 2 * torch.pi * turn)


def test_scores_are_those_of_stiffness_and_force(propagator):
    goal, lift = at.Trap([POINT], BEAD), at.Levitate([POINT], BEAD)
    drive = drives(20, 16)
    field = at.gorkov(propagator, goal.points, drive, BEAD)
    n = torch.tensor(goal.directions, dtype=torch.float64)
    stiffness, force = torch.einsum("di,...ij,dj->...d", n, field.stiffness, n), field.force @ n.mT
    expected = (stiffness - force.abs() / goal.displacement).amin(dim=(-1, -2))
    score = goal(at.ForceObjective(propagator, goal)(drive))
    assert torch.allclose(score, expected, rtol=1e-5)  # readings are differences of squares
    sideways = (field.force[..., :2] @ n[:, :2].mT).abs() / lift.displacement
    restoring = lift.reach * (stiffness - sideways).amin(dim=-1)
    expected = torch.minimum(field.force[..., 2], restoring)[:, 0] / BEAD.weight
    assert torch.allclose(lift(at.ForceObjective(propagator, lift)(drive)), expected, rtol=1e-5)


def test_methods_maximise_the_goal_of_the_objective(propagator):
    objective = at.ForceObjective(propagator, at.Trap([POINT], BEAD))
    climbed, searched = at.gradient_ascent(objective, starts=4), at.gabs(objective)
    bound = objective.goal.bound(objective.transfer_matrix)
    assert 0.8 * bound < climbed.score.item() <= bound
    assert searched.score.item() < climbed.score.item()
    held = at.gorkov(propagator, [POINT], climbed.drive[0], BEAD)
    assert held.principal_stiffness.min() > 0
    assert held.displacement.norm() < 2 * objective.goal.displacement  # of one direction; here of all three
    with pytest.raises(ValueError, match="must be the readings of the 1 control points"):
        at.lssg(objective)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    transducers=st.integers(1, 8),
    forms=st.integers(1, 6),
    rows=st.integers(1, 12),
)
def test_no_drive_exceeds_the_bound_on_forms(seed, transducers, forms, rows):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, transducers)) + 1j * rng.normal(size=(rows, transducers))
    weights = rng.normal(size=(forms, rows)) + rng.uniform(-1, 1)
    bound = forms_bound(matrix, weights)
    several = drives(200, transducers, seed).numpy()
    best = ascended(matrix, weights, several[0])
    scores = (weights @ np.abs(matrix @ np.vstack([several, best]).T) ** 2).min(axis=0)
    assert np.abs(best).max() <= 1 + 1e-12
    assert max(scores.max(), 0) <= bound


def test_a_single_form_of_the_least_size_is_bounded_from_both_sides():
    # |q_1 + q_2|^2 - |q_1 - q_2|^2 = 4 Re q_1 q_2^*, from -4 to 4
    rows, weights = np.array([[1, 1], [1, -1]], dtype=complex), np.array([[1.0, -1.0]])
    assert forms_bound(rows, weights) == pytest.approx(4, rel=1e-6)
    assert -forms_bound(rows, -weights) == pytest.approx(-4, rel=1e-6)


def test_whether_a_trap_exists_is_decided(propagator):
    exists = at.attainable(at.ForceObjective(propagator, at.Trap([POINT], BEAD)))
    assert exists.answer is True
    two = at.TransducerArray([(-0.01, 0, 0), (0.01, 0, 0)], normals=(0, 0, 1), source_strength=1.0)
    scene = at.Scene(two, at.Medium.air(), 40e3, [(0, 0, 0.1)])
    none = at.attainable(at.ForceObjective(at.make_propagator(scene, "free_space"), at.Trap([POINT], BEAD)))
    assert none.answer is False  # two plane waves hold nothing along y
    assert none.bound == 0
    drop = at.Levitate([POINT], at.Particle.of("water", 0.5e-3))
    heavy = at.attainable(at.ForceObjective(propagator, drop), 1.0)
    assert heavy.answer is False
