import math

import pytest
import torch

from autdtorch.methods.functions import random_search
from autdtorch.objectives.objective import weakest_focus
from autdtorch.scene.drive import drive_from_phases


def test_longer_search_begins_with_the_shorter(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 5, 0))
    long, short = (random_search(objective, evaluations=count, trials=3) for count in (200, 64))
    assert torch.equal(long.history[:, :64], short.history)


def test_scores_are_those_of_uniform_phases(make_objective, random_matrix):
    objective = make_objective(random_matrix(2, 4, 0))
    best = random_search(objective, evaluations=8, trials=400).score
    phases = 2 * math.pi * torch.rand(400, 8, 4, generator=torch.Generator().manual_seed(5)).double()
    scores = weakest_focus(objective(drive_from_phases(phases).flatten(0, 1))).reshape(400, 8)
    expected = scores.amax(dim=1)
    error = math.sqrt((best.var() + expected.var()).item() / 400)
    assert abs(best.mean() - expected.mean()).item() < 4 * error


@pytest.mark.parametrize("levels", [2, 5])
def test_phases_are_on_the_levels_and_all_of_them_occur(make_objective, random_matrix, levels):
    objective = make_objective(random_matrix(2, 4, 0))
    solution = random_search(objective, evaluations=3, levels=levels, trials=50)
    steps = solution.phases * levels / (2 * math.pi)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-12)
    assert set(steps.round().flatten().tolist()) == set(range(levels))
    torch.testing.assert_close(solution.amplitudes, torch.ones(50, 4).double(), rtol=1e-15, atol=0)
