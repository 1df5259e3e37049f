"""Runs that start at a drive that was good before, alone and along a sequence of objectives."""

import pytest
import torch

import autdtorch as at

PHASES = torch.arange(5).double()
DRIVE = torch.polar(torch.ones(5).double(), PHASES)
WARM = [
    at.GABS(levels=8),
    at.GABS(levels=8, order="strength", passes=2),
    at.BayesOpt(evaluations=9, initial=5, fixed_transducer=1),
    at.GradientAscent(starts=1, steps=40),
]


@pytest.fixture
def objectives(make_objective, random_matrix):
    """A matrix that changes a little from one pose to the next."""
    first, other = random_matrix(3, 5, 0), random_matrix(3, 5, 1)
    return [make_objective(first + 0.03 * step * other) for step in range(3)]


@pytest.mark.parametrize("method", WARM, ids=repr)
def test_the_drive_to_start_from_is_not_lost(objectives, method):
    """The solution is at least as good, up to the grid of 8 phases: |1 - e^(i pi / 8)| = 0.39 at most."""
    objective = objectives[0]
    good = at.gradient_ascent(objective, seed=3)
    cold = float(good.score[0])
    solution = at.run(method, objective, start=good.drive[0])
    assert float(solution.score[0]) >= (0.6 if isinstance(method, at.GABS) else 0.999) * cold


def test_gabs_goes_through_all_transducers_from_the_drive(objectives):
    drive = torch.polar(torch.ones(5).double(), -2 * torch.pi * torch.tensor([0, 3, 1, 2, 0]).double() / 4)
    method = at.GABS(levels=4, order="given")
    state = method.start(at.Problem.of(objectives[0], start=drive))
    torch.testing.assert_close(method.ask(state), drive[None])
    solution = at.run(method, objectives[0], start=drive)
    assert int(solution.evaluations[0]) == 1 + 5 * 4
    assert float(solution.history[0, 0]) == pytest.approx(float(objectives[0](drive).amin()))


def test_a_sequence_starts_each_pose_at_the_drives_of_the_one_before(objectives):
    method = at.GABS(levels=8)
    poses = at.run(method, objectives, trials=3, seed=1)
    assert [len(solution.score) for solution in poses] == [3, 3, 3]
    first = at.run(method, objectives[0], trials=3, seed=1)
    second = at.run(method, objectives[1], trials=3, seed=1, start=first.drive)
    for solution, alone in zip(poses, (first, second), strict=False):
        assert torch.equal(solution.drive, alone.drive)
        assert torch.equal(solution.history, alone.history)


def test_starts_that_do_not_fit_are_named(objectives):
    with pytest.raises(ValueError, match=r"start: 2 drives; must be one for each of 3 trials"):
        at.run(WARM[0], objectives[0], trials=3, start=DRIVE.expand(2, 5))
    with pytest.raises(ValueError, match=r"start: shape \(1, 2, 5\); must be \(5,\) or \(T, 5\)"):
        at.run(WARM[0], objectives[0], start=DRIVE.expand(1, 2, 5))
    with pytest.raises(ValueError, match=r"start: shape \(4,\)"):
        at.run(WARM[0], objectives[0], start=DRIVE[:4])
    with pytest.raises(ValueError, match=r"objective\[1\]: objective: 'x'; must be"):
        at.run(WARM[0], [objectives[0], "x"])
    with pytest.raises(ValueError, match=r"state_file: .* must be None for a sequence"):
        at.run(WARM[0], objectives, state_file="state.npz")
