"""What holds for every method."""

import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.optim.bayes import bayes_opt
from autdtorch.optim.gabs import gabs
from autdtorch.optim.gradient import gradient_ascent
from autdtorch.optim.identify import identify
from autdtorch.optim.lssg import lssg


def small_bayes_opt(objective, **options):
    return bayes_opt(objective, evaluations=9, initial=6, fixed_transducer=1, **options)


METHODS = pytest.mark.parametrize(
    "method",
    [
        lssg,
        partial(gabs, trials=2),
        partial(small_bayes_opt, trials=2),
        partial(gradient_ascent, trials=2),
        partial(identify, trials=2, evaluations=30),
    ],
    ids=["lssg", "gabs", "bayes_opt", "gradient_ascent", "identify"],
)


@METHODS
@pytest.mark.parametrize("seed", range(3))
def test_no_focus_beats_the_triangle_bound(make_objective, random_matrix, method, seed):
    matrix = random_matrix(3, 5, seed)
    pressure = method(make_objective(matrix)).pressure
    assert (pressure <= matrix.abs().sum(dim=1) * (1 + 1e-12)).all()


@METHODS
def test_solution_is_consistent(make_objective, random_matrix, method):
    objective = make_objective(random_matrix(3, 5, 0))
    solution = method(objective)
    trials, evaluations = solution.history.shape
    assert solution.drive.shape == (trials, 5)
    assert solution.pressure.shape == (trials, 3)
    assert solution.evaluations.tolist() == [evaluations] * trials
    assert objective.evaluations == trials * evaluations
    assert (solution.history.diff(dim=1) >= 0).all()
    # The last drive, which identify returns, is the best but for rounding.
    torch.testing.assert_close(solution.history[:, -1], solution.score, rtol=1e-4, atol=0)
    assert (solution.history[:, -1] >= solution.score).all()
    assert torch.equal(solution.score, solution.pressure.amin(dim=1))
    assert torch.equal(objective(solution.drive), solution.pressure)


@METHODS
def test_same_again_and_no_global_random_state(make_objective, random_matrix, method):
    matrix = random_matrix(3, 5, 0)
    torch.manual_seed(1)
    state = torch.get_rng_state()
    first = method(make_objective(matrix))
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(2)
    again = method(make_objective(matrix))
    assert torch.equal(first.drive, again.drive)
    assert torch.equal(first.history, again.history)


@pytest.mark.parametrize(
    "method",
    [gabs, small_bayes_opt, gradient_ascent, identify],
    ids=["gabs", "bayes_opt", "gradient_ascent", "identify"],
)
def test_a_trial_depends_on_its_seed_and_not_on_the_trials_beside_it(make_objective, random_matrix, method):
    objective = make_objective(random_matrix(3, 6, 0))
    many = method(objective, trials=4, seed=3)
    few = method(objective, trials=2, seed=3)
    assert torch.equal(many.drive[:2], few.drive)
    assert torch.equal(many.history[:2], few.history)
    some = method(objective, trials=[3, 1], seed=3)
    assert torch.equal(some.drive, many.drive[[3, 1]])
    assert torch.equal(some.history, many.history[[3, 1]])
    assert not torch.equal(method(objective, trials=4, seed=4).drive, many.drive)


@pytest.mark.parametrize("method", [lssg, partial(gabs, trials=3)], ids=["lssg", "gabs"])
@settings(deadline=None, max_examples=25)
@given(
    turns=st.lists(st.floats(0, 2 * math.pi), min_size=3, max_size=3),
    seed=st.integers(0, 1000),
)
def test_phases_at_the_control_points_are_never_seen(make_objective, random_matrix, method, turns, seed):
    matrix = random_matrix(3, 5, seed)
    turned = matrix * torch.polar(torch.ones(3).double(), torch.tensor(turns).double())[:, None]
    plain, other = method(make_objective(matrix)), method(make_objective(turned))
    assert torch.equal(plain.drive, other.drive)
    # The turned matrix has other roundings.
    torch.testing.assert_close(plain.pressure, other.pressure, rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        (lssg, {"levels": 1}, "levels: 1; must be an integer >= 2"),
        (lssg, {"levels": 16.0}, r"levels: 16\.0; must be an integer >= 2"),
        (gabs, {"levels": 0}, "levels: 0; must be an integer >= 2"),
        (gabs, {"trials": 0}, "trials: 0; must be an integer >= 1"),
        (gabs, {"trials": True}, "trials: True; must be an integer"),
        (gabs, {"trials": []}, r"trials: \[\]; must be an integer >= 1, or trial numbers, each once"),
        (gabs, {"trials": [2, 2]}, r"trials: \[2, 2\]; must be an integer >= 1, or trial numbers, each"),
        (gabs, {"trials": [0, -1]}, r"trials\[1\]: -1; must be an integer >= 0"),
        (gabs, {"seed": -1}, "seed: -1; must be an integer >= 0"),
        (gradient_ascent, {"starts": 0}, "starts: 0; must be an integer >= 1"),
        (gradient_ascent, {"steps": 1}, "steps: 1; must be an integer >= 2"),
        (
            identify,
            {"evaluations": 13},
            "evaluations: 13; must be an integer >= 14, to identify 5 tr",
        ),
        (identify, {"evaluations": 64.0}, r"evaluations: 64\.0; must be an integer >= "),
        (identify, {"trials": 0}, "trials: 0; must be an integer >= 1"),
        (bayes_opt, {"trials": 0}, "trials: 0; must be an integer >= 1"),
        (bayes_opt, {"seed": 0.5}, r"seed: 0\.5; must be an integer >= 0"),
        (bayes_opt, {"initial": 1}, "initial: 1; must be an integer >= 2"),
        (bayes_opt, {"evaluations": 16, "initial": 16}, "evaluations: 16; must be an integer >= 17"),
        (bayes_opt, {"fixed_transducer": 5}, "fixed_transducer: 5; must be an integer from 0 to 4"),
        (bayes_opt, {"fixed_transducer": -1}, "fixed_transducer: -1; must be an integer >= 0"),
    ],
)
def test_bad_hyperparameters_are_named(make_objective, random_matrix, method, options, message):
    objective = make_objective(random_matrix(2, 5, 0))
    with pytest.raises(ValueError, match=message):
        method(objective, **options)
    assert objective.evaluations == 0


def test_bayes_opt_needs_two_transducers(make_objective, random_matrix):
    with pytest.raises(ValueError, match="transducers of the objective's array: 1; must be an integer >= 2"):
        bayes_opt(make_objective(random_matrix(2, 1, 0)), fixed_transducer=0)
