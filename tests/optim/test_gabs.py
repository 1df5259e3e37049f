import cmath
import math

import pytest
import torch

from autdtorch.optim.base import trial_seed
from autdtorch.optim.gabs import gabs
from autdtorch.optim.lssg import lssg


def greedy_search(matrix, order, levels):
    """Algorithm 2 in plain Python: the final drive, and the best weakest focus seen on the way."""
    drive = [0j] * matrix.shape[1]

    def weakest(drive):
        rows = matrix.tolist()
        return min(abs(sum(g * q for g, q in zip(row, drive, strict=True))) for row in rows)

    drive[order[0]] = 1 + 0j
    seen = [weakest(drive)]
    for transducer in order[1:]:
        tried = []
        for level in range(levels):
            drive[transducer] = cmath.exp(-2j * math.pi * level / levels)
            tried.append((weakest(drive), drive[transducer]))
        best = max(tried, key=lambda pair: pair[0])
        drive[transducer] = best[1]
        seen.append(best[0])
    return drive, seen


@pytest.mark.parametrize("seed", range(10))
def test_same_as_a_plain_loop(make_objective, random_matrix, seed):
    matrix = random_matrix(2, 3, seed)
    solution = gabs(make_objective(matrix), levels=4, trials=2, seed=seed)
    for trial in range(2):
        generator = torch.Generator().manual_seed(trial_seed(seed, trial))
        order = torch.randperm(3, generator=generator).tolist()
        drive, seen = greedy_search(matrix, order, levels=4)
        assert solution.score[trial].item() == pytest.approx(max(seen), rel=1e-12)
        assert solution.history[trial, ::4].tolist() == pytest.approx([max(seen[: n + 1]) for n in range(3)])
        if seen[-1] == max(seen):
            expected = torch.tensor(drive, dtype=torch.complex128)
            torch.testing.assert_close(solution.drive[trial], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("levels", [3, 16])
def test_single_point_gets_all_but_what_the_levels_cost(make_objective, random_matrix, levels):
    matrix = random_matrix(1, 8, 3)
    score = gabs(make_objective(matrix), levels=levels, trials=5).score
    # The best level turns each transducer to within pi / levels of the sum so far: it adds at least its
    # projection.
    assert (score >= math.cos(math.pi / levels) * matrix.abs().sum()).all()
    assert (score <= matrix.abs().sum() * (1 + 1e-12)).all()


def test_evaluations_are_counted(make_objective, random_matrix):
    objective = make_objective(random_matrix(2, 5, 0))
    solution = gabs(objective, levels=7, trials=3)
    assert solution.evaluations.tolist() == [1 + 4 * 7] * 3
    assert objective.evaluations == 3 * (1 + 4 * 7)


def test_one_transducer_alone_needs_one_evaluation(make_objective, random_matrix):
    solution = gabs(make_objective(random_matrix(2, 1, 0)))
    assert solution.evaluations.tolist() == [1]
    assert solution.drive.tolist() == [[1 + 0j]]


def test_phases_are_on_the_levels(make_objective, random_matrix):
    solution = gabs(make_objective(random_matrix(2, 6, 5)), levels=8, trials=4)
    steps = solution.phases * 8 / (2 * math.pi)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-12)
    amplitudes = (
        solution.amplitudes
    )  # each transducer is on or off, up to the rounding of its cosine and sine
    torch.testing.assert_close(amplitudes, amplitudes.round(), rtol=1e-15, atol=0)


def test_paper_ranking_in_empty_air(paper_objective):
    # Fig. 3(a): the mean of GABS over 50 trials is above LSSG.
    solution = gabs(paper_objective, levels=16, trials=50)
    assert solution.score.mean() > lssg(paper_objective, levels=16).score
    assert len(set(solution.score.tolist())) > 10  # the orders differ, and so do the results
