"""What holds for every method."""

import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.methods.bayes.bayes import bayes_opt
from autdtorch.methods.gabs import gabs
from autdtorch.methods.gradient import gradient_ascent
from autdtorch.methods.identify import identify
from autdtorch.methods.lssg import lss, lssg
from autdtorch.methods.random_search import random_search
from autdtorch.methods.ranking import NEAR_TIE
from autdtorch.objectives.perturbations import Quantised


def small_bayes_opt(objective, **options):
    return bayes_opt(objective, evaluations=9, initial=6, fixed_transducer=1, **options)


BLACK_BOX_METHODS = {
    "lss": lss,
    "lssg": lssg,
    "gabs": partial(gabs, trials=2),
    "gabs by strength": partial(gabs, order="strength", trials=2),
    "bayes_opt": partial(small_bayes_opt, trials=2),
    "random_search": partial(random_search, evaluations=70, trials=2),
    "identify": partial(identify, evaluations=30, trials=2),
}
EVERY_METHOD = BLACK_BOX_METHODS | {"gradient_ascent": partial(gradient_ascent, trials=2)}
METHODS = pytest.mark.parametrize("method", EVERY_METHOD.values(), ids=EVERY_METHOD.keys())


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
    # A near tie is no improvement, so that the history may end so little below.
    assert (solution.history[:, -1] >= solution.score * (1 - NEAR_TIE)).all()
    assert torch.equal(solution.score, solution.pressure.amin(dim=1))
    assert torch.equal(objective(solution.drive), solution.pressure)


@pytest.mark.parametrize("method", BLACK_BOX_METHODS.values(), ids=BLACK_BOX_METHODS.keys())
@pytest.mark.parametrize("on_off", [False, True])
def test_on_a_device_of_few_levels_the_drive_is_the_one_it_played(
    make_objective, random_matrix, method, on_off
):
    inner = make_objective(random_matrix(3, 5, 0))
    solution = method(Quantised(inner, 6, on_off))
    steps = solution.phases * 6 / (2 * math.pi)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-12)
    # Played without the wrapper it gives what was observed; both roundings of an amplitude differ.
    torch.testing.assert_close(inner(solution.drive), solution.pressure, rtol=1e-12, atol=0)


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
    [
        gabs,
        partial(gabs, passes=3),
        small_bayes_opt,
        partial(random_search, evaluations=70),
        identify,
        gradient_ascent,
    ],
    ids=["gabs", "gabs, 3 passes", "bayes_opt", "random_search", "identify", "gradient_ascent"],
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


@pytest.mark.parametrize(
    "options",
    [{}, {"acquisition": "log_ei", "embedding": "circle", "initial_points": "random", "noise": "inferred"}],
    ids=["paper", "others"],
)
def test_a_trial_of_bayes_opt_is_the_same_in_any_block_and_on_any_number_of_threads(
    make_objective, random_matrix, options
):
    objective = make_objective(random_matrix(3, 7, 0))
    run = partial(bayes_opt, objective, evaluations=60, initial=8, fixed_transducer=1, seed=3, **options)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = run(trials=7)
        for count, block in ((1, [5]), (2, range(7)), (3, [6, 0, 3])):
            torch.set_num_threads(count)
            solution = run(trials=block)
            assert torch.equal(solution.drive, alone.drive[list(block)])
            assert torch.equal(solution.history, alone.history[list(block)])
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("method", [identify, gradient_ascent])
def test_a_method_of_small_steps_takes_one_thread_and_gives_the_others_back(
    make_objective, random_matrix, method, monkeypatch
):
    used = set()
    monkeypatch.setattr(
        "autdtorch.methods.gradient._pressure",
        lambda matrix, drive: used.add(torch.get_num_threads()) or (drive[:, None] * matrix).sum(dim=-1),
    )
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        method(make_objective(random_matrix(2, 3, 0)))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert used == {1}


@pytest.mark.parametrize("method", [lssg, partial(gabs, trials=3)], ids=["lssg", "gabs"])
@settings(max_examples=25)
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
        (lssg, {"passes": 0}, "passes: 0; must be an integer >= 1"),
        (lssg, {"order": "random"}, "order: 'random'; must be \"given\" or the indices of all, each once"),
        (lssg, {"order": [1, 1]}, r"order: .1, 1.; must be"),
        (gabs, {"passes": 1.5}, r"passes: 1\.5; must be an integer >= 1"),
        (gabs, {"order": "loudest"}, 'order: \'loudest\'; must be "random", "given", "strength" or'),
        (gabs, {"order": [0, 1, 2, 3]}, r"order: .0, 1, 2, 3.; must be the indices 0 to 4, each once"),
        (gabs, {"order": [0, 1, 2, 3, 3]}, r"order: .0, 1, 2, 3, 3.; must be"),
        (gabs, {"order": [0, 1, 2, 3, 4.0]}, r"order\[4\]: 4\.0; must be an integer >= 0"),
        (gabs, {"order": None}, "order: None; must be"),
        (gabs, {"first": 5}, "first: 5; must be an integer from 0 to 4"),
        (gabs, {"first": -1}, "first: -1; must be an integer >= 0"),
        (random_search, {"evaluations": 0}, "evaluations: 0; must be an integer >= 1"),
        (random_search, {"levels": 1}, "levels: 1; must be an integer >= 2"),
        (random_search, {"trials": 0}, "trials: 0; must be an integer >= 1"),
        (gabs, {"levels": 0}, "levels: 0; must be an integer >= 2"),
        (gabs, {"trials": 0}, "trials: 0; must be an integer >= 1"),
        (gabs, {"trials": True}, "trials: True; must be an integer"),
        (gabs, {"trials": []}, r"trials: \(\); must be an integer >= 1, or trial numbers, each once"),
        (gabs, {"trials": [2, 2]}, r"trials: \(2, 2\); must be an integer >= 1, or trial numbers, each"),
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
        (bayes_opt, {"acquisition": "ucb"}, "acquisition: 'ucb'; must be one of ei, log_ei"),
        (bayes_opt, {"embedding": None}, "embedding: None; must be one of phases, circle"),
        (bayes_opt, {"initial_points": "grid"}, "initial_points: 'grid'; must be one of sobol, random"),
        (bayes_opt, {"noise": "fixed"}, "noise: 'fixed'; must be one of inferred"),
        (bayes_opt, {"noise": 0}, "noise: 0; must be in 1e-06 to 1"),
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
