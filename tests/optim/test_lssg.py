import math

import pytest
import torch

from autdtorch.methods.functions import lss, lssg
from autdtorch.objectives.objective import weakest_focus
from autdtorch.scene.drive import drive_from_phases, focus_phases, normalise


def focus_drives(scene):
    return drive_from_phases(focus_phases(scene.array.positions, scene.control_points, scene.wavenumber))


def test_single_focus_in_free_space_gets_all_there_is(make_objective):
    scene = make_objective(torch.ones(1, 5, dtype=torch.complex128)).scene
    phases = focus_phases(scene.array.positions, scene.control_points, scene.wavenumber)
    solution = lssg(make_objective(drive_from_phases(-phases)))
    # Five terms of magnitude 1, all in phase.
    assert solution.pressure.item() == pytest.approx(5, rel=1e-12)


def test_drive_is_a_normalised_sum_of_focus_drives_with_offsets_on_the_grid(make_objective, random_matrix):
    levels = 8
    objective = make_objective(random_matrix(3, 6, 1))
    solution = lssg(objective, levels)
    drives = focus_drives(objective.scene)
    weights = torch.linalg.lstsq(drives.T, solution.drive[0]).solution
    offsets = torch.angle(weights / weights[0]) * levels / (2 * math.pi)
    # Six equations for three weights, solved to rounding.
    torch.testing.assert_close(normalise(weights @ drives), solution.drive[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(offsets, offsets.round(), rtol=0, atol=1e-9)
    assert solution.amplitudes.max().item() == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_never_worse_than_the_plain_sum_of_focus_drives(make_objective, random_matrix, seed):
    objective = make_objective(random_matrix(4, 6, seed))
    plain = lss(objective)
    assert torch.equal(plain.drive, normalise(focus_drives(objective.scene).sum(dim=0))[None])
    # The start is among the drives tried, but for the rounding of its sum.
    assert lssg(objective).score >= plain.score * (1 - 1e-12)


def turned(weights, focus, levels):
    """The weights with each offset of one focus (levels, P)."""
    moved = weights.repeat(levels, 1)
    moved[:, focus] = weights[focus] * drive_from_phases(2 * math.pi * torch.arange(levels).double() / levels)
    return moved


def test_further_passes_end_where_no_single_offset_can_improve(make_objective, random_matrix):
    levels = 6
    objective = make_objective(random_matrix(4, 6, 3))
    solution = lssg(objective, levels, passes=40)
    count = int(solution.evaluations)
    assert count == objective.evaluations < 40 * 4 * levels
    assert solution.history.shape == (1, 40 * 4 * levels)
    assert (solution.history[0, count - 1 :] == solution.score).all()
    assert torch.equal(solution.history[:, : 4 * levels], lssg(objective, levels).history)
    drives = focus_drives(objective.scene)
    weights = torch.linalg.lstsq(drives.T, solution.drive[0]).solution
    for focus in range(4):
        scores = weakest_focus(objective(normalise(turned(weights, focus, levels) @ drives)))
        assert (scores <= solution.score * (1 + 1e-9)).all()  # six equations for four weights, to rounding


def test_order_of_the_foci_is_the_one_asked_for(make_objective, random_matrix):
    levels = 4
    objective = make_objective(random_matrix(3, 6, 1))
    solution = lssg(objective, levels, order=[2, 0, 1])
    drives = focus_drives(objective.scene)
    weights = torch.ones(3, dtype=torch.complex128)
    seen = []
    for focus in (2, 0, 1):
        tried = turned(weights, focus, levels)
        scores = weakest_focus(objective(normalise(tried @ drives)))
        weights = tried[scores.argmax()]
        seen.append(scores.max().item())
    assert solution.history[0, levels - 1 :: levels].tolist() == pytest.approx(seen, rel=1e-12)
    assert not torch.equal(solution.history, lssg(objective, levels).history)
