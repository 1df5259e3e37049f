import math

import pytest
import torch

from autdtorch.methods.bayes.bayes import bayes_opt
from autdtorch.objectives.objective import weakest_focus
from autdtorch.scene.drive import drive_from_phases

SMALL = {"evaluations": 30, "initial": 6, "fixed_transducer": 2}


@pytest.fixture(scope="module")
def matrix(random_matrix):
    return random_matrix(2, 4, 11)


@pytest.fixture(scope="module")
def solution(make_objective, matrix):
    """Two trials of 30 evaluations on a small problem."""
    return bayes_opt(make_objective(matrix), trials=2, seed=5, **SMALL)


def test_beats_random_search(make_objective, matrix, solution):
    generator = torch.Generator().manual_seed(0)
    phases = 2 * math.pi * torch.rand(200, 30, 4, dtype=torch.float64, generator=generator)
    scores = weakest_focus(make_objective(matrix)(drive_from_phases(phases).flatten(0, 1)))
    searches = scores.unflatten(0, (200, 30)).max(dim=1).values
    assert (solution.score > searches.median()).all()


def test_fixed_transducer_stays_at_phase_zero_and_all_are_fully_on(solution):
    assert torch.equal(solution.drive[:, 2], torch.ones(2, dtype=torch.complex128))
    assert torch.equal(solution.phases[:, 2], torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(solution.amplitudes, torch.ones(2, 4).double(), rtol=1e-15, atol=0)


def test_score_that_never_changes_is_no_error(make_objective, matrix):
    objective = make_objective(matrix)
    solution = bayes_opt(
        objective, evaluations=6, initial=3, fixed_transducer=0, score=lambda p: torch.ones(p.shape[:-1])
    )
    assert solution.score.tolist() == [1.0]
