"""Phase stepping: the matrix by two steps of each phase, and the drive that follows."""

import pytest
import torch

import autdtorch as at
from autdtorch.methods.gradient import random_drives
from autdtorch.methods.phase_stepping import PhaseStepping, _matrix, _stepped


def seeded(seed):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("levels", [None, 3, 32])
@pytest.mark.parametrize("transducers", [1, 2, 9, 40])
def test_steps_determine_the_rows_up_to_a_phase(make_objective, random_matrix, transducers, levels):
    for seed in range(10):
        matrix = random_matrix(4, transducers, seed)
        objective = make_objective(matrix)
        if levels is not None:
            objective = at.Quantised(objective, levels)
        drives = _stepped(at.Problem.of(objective), random_drives(3, transducers, seeded(seed)))
        rows = torch.stack([_matrix(each, objective(each)) for each in drives])
        added = matrix * drives[:, :1]
        reference = added.sum(dim=-1, keepdim=True)
        exact = added * reference.conj().sgn() / drives[:, :1]
        clear = (added.abs() < 0.99 * (reference - added).abs()).all(dim=-1)  # two cannot be, nor one
        # not a dark reference, which has a floor
        clear &= reference[..., 0].abs() > 1e-2 * matrix.norm(dim=-1)
        # differences of intensities are solved for: 1e-16 over the least reference squared, 1e-4
        torch.testing.assert_close(rows[clear], exact[clear], rtol=1e-9, atol=1e-9)
        assert clear.any() or transducers <= 2


def test_twice_as_many_evaluations_as_transducers_reach_the_best_drive(make_objective, random_matrix):
    """Nothing but the reference's darkest focus limits the first round; the second steps around loud foci."""
    objective = make_objective(random_matrix(4, 60, 0))
    best = at.gradient_ascent(objective).score
    share = [at.phase_stepping(objective, rounds, trials=5).score / best for rounds in (1, 2)]
    assert share[0].median() > 0.95  # a climb of 16 starts is within 1 % of 32 starts
    assert share[1].min() > 0.97
    assert objective.evaluations == 1 + 5 * (2 * 60 + 2 + 4 * 60 + 3)


def test_further_rounds_help_under_noise(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 40, 0))
    shares = []
    for rounds in (1, 4):
        drive = at.phase_stepping(at.Noise(objective, 15.0), rounds, trials=5).drive
        shares.append(at.true_pressure(objective, drive).amin(dim=1).median())
    assert shares[1] > 1.1 * shares[0]


def test_dark_foci_and_failed_transducers_leave_the_matrix_finite(make_objective, random_matrix):
    matrix = random_matrix(3, 6, 0)
    matrix[:, 2], matrix[1] = 0, 0
    objective = make_objective(matrix)
    drives = _stepped(at.Problem.of(objective), random_drives(2, 6, seeded(0)))
    rows = torch.stack([_matrix(each, objective(each)) for each in drives])
    assert rows.isfinite().all()
    assert rows[:, 1].abs().max() < 1e-300  # the floor of the reference
    # a difference of equal intensities
    assert rows[:, :, 2].abs().max() < 1e-12
    assert at.phase_stepping(objective, goal=at.MeanPressure()).score > 0


def test_the_first_round_steps_around_the_drive_to_start_from(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 6, 0))
    start = at.gradient_ascent(objective).drive[0]
    state = PhaseStepping().start(at.Problem.of(objective, start=start))
    asked = PhaseStepping().ask(state)
    torch.testing.assert_close(asked[0], start.sgn())
    # 5 of 6 entries are those of the reference, and all are fully on
    assert ((asked[1:] - asked[0]).abs() > 1e-9).sum(dim=1).tolist() == [1] * 12
    assert asked.abs() == pytest.approx(1, abs=1e-12)


def test_two_phase_levels_are_too_few(make_objective, random_matrix):
    with pytest.raises(ValueError, match=r"phase levels of the objective: 2; must be 3 or more"):
        at.phase_stepping(at.Quantised(make_objective(random_matrix(2, 4, 0)), 2))
