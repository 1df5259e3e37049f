import numpy as np
import pytest
import scipy.optimize
import torch

from autdtorch.methods.functions import gradient_ascent


def polished(matrix, starts):
    """Weakest focus at its best by sequential quadratic programming from many starts, over the phases."""
    G = matrix.numpy()
    scale = np.abs(G).sum(axis=1).min()
    generator = np.random.default_rng(0)

    def slack(x):
        return np.abs(G @ np.exp(1j * x[1:])) / scale - x[0]

    def slope(x):
        p, q = G @ np.exp(1j * x[1:]), np.exp(1j * x[1:])
        phases = (p.conj()[:, None] * G * (1j * q)).real / np.abs(p)[:, None] / scale
        return np.hstack([-np.ones((len(G), 1)), phases])

    found = [
        scipy.optimize.minimize(
            lambda x: -x[0],
            np.concatenate([[0.0], 2 * np.pi * generator.random(G.shape[1])]),
            jac=lambda x: np.eye(len(x))[0] * -1,
            constraints={"type": "ineq", "fun": slack, "jac": slope},
            method="SLSQP",
            options={"maxiter": 300},
        ).x
        for _ in range(starts)
    ]
    return max((slack(x) + x[0]).min() for x in found) * scale


@pytest.mark.parametrize("seed", range(3))
def test_reaches_the_best_of_many_starts_of_another_optimiser(make_objective, random_matrix, seed):
    matrix = random_matrix(4, 10, seed)
    score = gradient_ascent(make_objective(matrix), trials=3).score
    # The cold end of the smooth minimum leaves some 1e-4.
    assert score.min() > (1 - 1e-3) * polished(matrix, starts=20)


def test_every_trial_ends_at_the_best_of_the_paper_scene(paper_objective):
    score = gradient_ascent(paper_objective, trials=10).score
    assert score.min() > (1 - 1e-3) * polished(paper_objective.transfer_matrix, starts=5)


def test_what_nothing_reaches_is_no_reason_to_fail(make_objective):
    solution = gradient_ascent(make_objective(torch.zeros(2, 3, dtype=torch.complex128)))
    assert solution.score.tolist() == [0.0]


def test_objectives_in_a_list_are_run_one_after_the_other_and_rows_are_a_matrix(
    make_objective, random_matrix
):
    matrices = [random_matrix(2, 4, seed) for seed in range(2)]
    found = gradient_ascent([make_objective(matrix) for matrix in matrices])
    for solution, matrix in zip(found, matrices, strict=True):
        best = gradient_ascent(matrix.tolist()).score.item()
        assert solution.score.item() == pytest.approx(best, rel=1e-3)  # what smoothing leaves
    with pytest.raises(ValueError, match=r"objective\[1\]"):
        gradient_ascent([make_objective(matrices[0]), matrices[1]])
