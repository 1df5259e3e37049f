"""Laws of every method: ask and tell, files of states, trials, and settings that are refused."""

import math
from dataclasses import dataclass
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.methods.base import NEAR_TIE, Step
from autdtorch.methods.seeds import trial_seed
from autdtorch.objectives.perturbations import Quantised

GUESS = torch.randn(3, 5, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))

BLACK_BOX = [
    at.LSS(),
    at.LSSG(levels=4, passes=2),
    at.GABS(levels=4),
    at.GABS(levels=4, passes=3),
    at.GABS(levels=3, order="strength"),
    at.RandomSearch(evaluations=130),
    at.Identify(evaluations=15),
    at.Identify(evaluations=5, prior=at.Prior(GUESS)),
    at.BayesOpt(evaluations=7, initial=5, fixed_transducer=1),
    at.BayesOpt(7, 5, 1, model="foci", kernel="phasor", noise="inferred"),
    at.BayesOpt(3, 5, 1, model="foci", kernel="phasor", noise="inferred", prior=at.Prior(GUESS)),
    at.PhaseStepping(rounds=2),
]
METHODS = [*BLACK_BOX, at.GradientAscent(steps=20)]
RANDOM = [method for method in METHODS if method.random]


def each(methods):
    return pytest.mark.parametrize("method", methods, ids=lambda method: repr(method)[:25])


@dataclass(frozen=True)
class OneByOne(at.Method):
    """A user's method: one random drive after the other."""

    evaluations: int = 5

    def begin(self, problem, seeds):
        drives = [torch.full((1, problem.transducers), 1j**seed) for seed in seeds]
        return Step(torch.stack(drives).to(torch.complex128), {})

    def advance(self, state, pressure, score):
        done = state.best.history.shape[1] == self.evaluations
        return Step(state.drives[:, :0] if done else state.drives * 1j, {})


@each(METHODS)
def test_a_loop_of_ones_own_with_states_from_a_file_finds_what_run_finds(objective, method, tmp_path):
    trials, path, problem = 2 if method.random else 1, tmp_path / "state.npz", at.Problem.of(objective)
    state = first = method.start(problem, seed=3, trials=trials)
    while len(drives := method.ask(state)):
        pressure = objective(drives)
        at.save_state(path, method, told := method.tell(state, pressure))
        if state is first:
            assert torch.equal(method.ask(told), method.ask(method.tell(state, pressure)))  # it is as before
        state = at.load_state(path, method, problem)
        assert torch.equal(method.ask(state), method.ask(told))
    assert (state.done, first.evaluations) == (True, 0)
    torch.manual_seed(1)
    global_state = torch.get_rng_state()
    solution, expected = method.best(state), at.run(method, objective, seed=3, trials=trials)
    assert torch.equal(torch.get_rng_state(), global_state)
    assert torch.equal(solution.drive, expected.drive)
    assert torch.equal(solution.history, expected.history)


def test_a_run_stops_and_goes_on_from_its_file(objective, tmp_path):
    method, path = at.GABS(levels=4), tmp_path / "state.npz"
    stopped = at.run(method, objective, state_file=path, stop=lambda state: state.evaluations >= 9)
    assert stopped.evaluations.tolist() == [9] == [objective.evaluations]
    whole = at.run(method, objective, state_file=path)
    assert objective.evaluations == 17
    assert torch.equal(whole.drive, at.run(method, objective).drive)
    for other in (at.GABS(levels=5), at.LSSG()):
        with pytest.raises(ValueError, match=r"state\.npz: state of .*gabs.*; must be of"):
            at.run(other, objective, state_file=path)
    for others in ({"seed": 1}, {"trials": 2}):
        with pytest.raises(
            ValueError, match=r"state_file: .*state\.npz'; must be .* the same seed and trials"
        ):
            at.run(method, objective, state_file=path, **others)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"state\.npz"):
        at.run(method, objective, state_file=path)


def test_a_method_of_ones_own_runs_as_ours_do(objective):
    solution = at.run(OneByOne(), objective, trials=3)
    assert solution.evaluations.tolist() == [5] * 3
    # A common phase changes no magnitude: all its drives are as good, and the first is kept.
    first = [torch.full((5,), 1j ** trial_seed(0, trial)) for trial in range(3)]
    assert torch.equal(solution.drive, torch.stack(first))
    assert (OneByOne.name, OneByOne.label) == ("OneByOne", "OneByOne")


WRONG_SCORES = {
    "each focus": lambda pressure: pressure,
    "one for all": lambda pressure: pressure.min(),
    "nothing": lambda pressure: None,
    "complex": lambda pressure: pressure.amin(dim=-1) * 1j,
    "boolean": lambda pressure: pressure.amin(dim=-1) > 1,
    "not a number": lambda pressure: pressure.amin(dim=-1) * math.nan,
    "two things": lambda pressure: (pressure.amin(dim=-1), 1),
}


@pytest.mark.parametrize("goal", WRONG_SCORES.values(), ids=WRONG_SCORES)
@each([at.GABS(levels=4), METHODS[7], METHODS[9], METHODS[-1]])  # those with a matrix begin with the goal
def test_a_goal_that_gives_no_scores_is_refused(objective, method, goal):
    problem = at.Problem.of(objective, goal)
    with pytest.raises(ValueError, match=r"^score") as refused:
        method.tell(state := method.start(problem), objective(method.ask(state)))
    assert "\n" not in str(refused.value)


@each([at.Identify(evaluations=20), at.GradientAscent(steps=5)])
def test_a_method_that_climbs_refuses_goals_without_a_gradient(objective, method):
    for goal in (lambda pressure: pressure.detach().amin(dim=-1), lambda pressure: pressure.amin(-1).numpy()):
        with pytest.raises(ValueError, match=r"goal: .*must be differentiable"):
            at.run(method, objective, goal=goal)


def test_a_goal_that_changes_its_argument_harms_nothing(objective):
    def goal(pressure):
        return pressure.mul_(-1).amax(dim=-1).neg()

    changed, expected = (at.run(at.GABS(levels=4), objective, goal=one) for one in (goal, at.weakest_focus))
    assert torch.equal(changed.pressure, expected.pressure)


def test_a_problem_without_geometry_or_matrix_is_refused_where_they_are_needed():
    problem = at.Problem(transducers=4, foci=2)
    assert at.GABS().start(problem).drives.shape == (1, 1, 4)
    matrix = "objective: None; must have a transfer matrix"
    for method, message in ((at.LSS(), r"problem\.scene"), (at.GradientAscent(), matrix)):
        with pytest.raises(ValueError, match=message):
            method.start(problem)
    with pytest.raises(ValueError, match="trials: 2; must be 1"):
        at.LSSG().start(problem, trials=2)
    with pytest.raises(ValueError, match="transducers: 0"):
        at.Problem(transducers=0, foci=2)


def test_different_seeds_and_trials_are_unrelated():
    seeds = {trial_seed(seed, trial) for seed in range(20) for trial in range(50)}
    assert len(seeds) == 1000
    assert 0 <= min(seeds) < max(seeds) < 2**63  # torch takes no more than 63 bits


@each(METHODS)
def test_solution_is_consistent(make_objective, random_matrix, method):
    matrix = random_matrix(3, 5, 1)
    objective = make_objective(matrix)
    solution = at.run(method, objective, trials=2 if method.random else 1)
    trials, evaluations = solution.history.shape
    assert solution.drive.shape == (trials, 5)
    assert solution.pressure.shape == (trials, 3)
    assert (solution.pressure <= matrix.abs().sum(dim=1) * (1 + 1e-12)).all()  # the triangle bound
    assert objective.evaluations == solution.evaluations.sum()
    if getattr(method, "passes", 1) == 1:  # else a trial may end early
        assert solution.evaluations.tolist() == [evaluations] * trials
    assert (solution.history.diff(dim=1) >= 0).all()
    # The last drive, which identify returns, is the best within rounding; the drive of the highest posterior
    # mean is so within the noise that few readings leave open.
    apart = 1e-2 if getattr(method, "model", "") == "foci" else 1e-4
    if getattr(method, "prior", None) is None:  # with the prior of another matrix it may be any
        torch.testing.assert_close(solution.history[:, -1], solution.score, rtol=apart, atol=0)
    # A near tie is no improvement, so that the history may end so little below.
    assert (solution.history[:, -1] >= solution.score * (1 - NEAR_TIE)).all()
    assert torch.equal(solution.score, solution.pressure.amin(dim=1))
    assert torch.equal(objective(solution.drive), solution.pressure)


@each(BLACK_BOX)
def test_on_a_device_of_few_levels_the_drive_is_the_one_it_played(objective, method):
    device = Quantised(objective, 6, on_off=method.random)  # amplitudes of the others stay
    solution = at.run(method, device, trials=2 if method.random else 1)
    steps = solution.phases * 6 / (2 * math.pi)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-12)
    # Played without the wrapper it gives what was observed; both roundings of an amplitude differ.
    torch.testing.assert_close(objective(solution.drive), solution.pressure, rtol=1e-12, atol=0)


@each([method for method in RANDOM if not isinstance(method, at.BayesOpt)])
def test_a_trial_depends_on_its_seed_and_not_on_the_trials_beside_it(objective, method):
    many, trials = at.run(method, objective, trials=3, seed=3), [2, 1]
    some = at.run(method, objective, trials=trials, seed=3)
    for name in ("drive", "history", "evaluations"):
        assert torch.equal(getattr(some, name), getattr(many, name)[trials])
    if getattr(method, "order", "random") == "random":
        assert not torch.equal(at.run(method, objective, seed=4).drive[0], many.drive[0])


@each([method for method in METHODS if isinstance(method, at.BayesOpt)])
def test_a_block_of_bayes_opt_is_the_same_on_any_number_of_threads(objective, method, set_threads):
    solutions = []
    for count in (1, 3):
        set_threads(count)
        solutions.append(at.run(method, objective, trials=2, seed=3))
    assert torch.equal(solutions[0].drive, solutions[1].drive)
    assert torch.equal(solutions[0].history, solutions[1].history)


@pytest.mark.parametrize("method", [partial(at.identify, evaluations=14), at.gradient_ascent])
def test_a_method_of_small_steps_takes_one_thread_and_gives_the_others_back(
    objective, method, monkeypatch, set_threads
):
    used = set()
    monkeypatch.setattr(
        "autdtorch.methods.gradient._product",
        lambda vectors, matrix: used.add(torch.get_num_threads()) or vectors @ matrix,
    )
    set_threads(2)
    method(objective)
    assert torch.get_num_threads() == 2
    assert used == {1}


@pytest.mark.parametrize("method", [at.lssg, partial(at.gabs, trials=3)], ids=["lssg", "gabs"])
@given(turns=st.lists(st.floats(0, 2 * math.pi), min_size=3, max_size=3), seed=st.integers(0, 1000))
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
        (at.lssg, {"levels": 16.0}, r"levels: 16\.0; must be an integer >= 2"),
        (at.lssg, {"passes": 0}, "passes: 0; must be an integer >= 1"),
        (at.lssg, {"order": "random"}, "order: 'random'; must be \"given\" or the indices of all"),
        (at.lssg, {"order": [1, 1, 0]}, r"order: .1, 1, 0.; must be"),
        (at.gabs, {"levels": 1}, "levels: 1; must be an integer >= 2"),
        (at.gabs, {"passes": 1.5}, r"passes: 1\.5; must be an integer >= 1"),
        (at.gabs, {"order": "loudest"}, 'order: \'loudest\'; must be "random", "given", "strength" or'),
        (at.gabs, {"order": [0, 1, 2, 3]}, r"order: .0, 1, 2, 3.; must be the indices 0 to 4, each once"),
        (at.gabs, {"order": [0, 1, 2, 3, 4.0]}, r"order\[4\]: 4\.0; must be an integer >= 0"),
        (at.gabs, {"first": 5}, "first: 5; must be an integer from 0 to 4"),
        (at.gabs, {"first": -1}, "first: -1; must be an integer >= 0"),
        (at.gabs, {"trials": 0}, "trials: 0; must be an integer >= 1"),
        (at.gabs, {"trials": []}, r"trials: \(\); must be an integer >= 1, or trial numbers, each once"),
        (at.gabs, {"trials": [2, 2]}, r"trials: \(2, 2\); must be"),
        (at.gabs, {"trials": [0, -1]}, r"trials\[1\]: -1; must be an integer >= 0"),
        (at.gabs, {"seed": -1}, "seed: -1; must be an integer >= 0"),
        (at.random_search, {"evaluations": 0}, "evaluations: 0; must be an integer >= 1"),
        (at.random_search, {"levels": 1}, "levels: 1; must be an integer >= 2"),
        (at.gradient_ascent, {"starts": 0}, "starts: 0; must be an integer >= 1"),
        (at.gradient_ascent, {"steps": 1}, "steps: 1; must be an integer >= 2"),
        (at.identify, {"evaluations": 12}, "evaluations: 12; must be an integer >= 13"),
        (at.bayes_opt, {"initial": 1}, "initial: 1; must be an integer >= 2"),
        (at.bayes_opt, {"evaluations": 16}, "evaluations: 16; must be an integer >= 17"),
        (at.bayes_opt, {"fixed_transducer": 5}, "fixed_transducer: 5; must be an integer from 0 to 4"),
        (at.bayes_opt, {"acquisition": "ucb"}, "acquisition: 'ucb'; must be one of ei, log_ei"),
        (at.bayes_opt, {"kernel": None}, "kernel: None; must be one of phases, circle, phasor"),
        (at.bayes_opt, {"kernel": "phasor"}, "kernel: 'phasor'; must be \"phasor\" with the model"),
        (at.bayes_opt, {"model": "all"}, "model: 'all'; must be one of weakest, foci"),
        (at.bayes_opt, {"initial_points": "grid"}, "initial_points: 'grid'; must be one of sobol, random"),
        (at.bayes_opt, {"noise": "fixed"}, "noise: 'fixed'; must be one of inferred"),
        (at.bayes_opt, {"noise": 0}, "noise: 0; must be in 1e-06 to 1"),
    ],
)
def test_bad_hyperparameters_are_named(objective, method, options, message):
    with pytest.raises(ValueError, match=message):
        method(objective, **options)
    assert objective.evaluations == 0


@pytest.mark.parametrize("transducers", [2, 5, 6])
def test_bayes_opt_runs_with_its_defaults_on_few_transducers(make_objective, random_matrix, transducers):
    solution = at.bayes_opt(make_objective(random_matrix(2, transducers, 0)), 12, 6)
    assert solution.drive[0, -1].angle() == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match="transducers of the objective's array: 1; must be an integer >= 2"):
        at.bayes_opt(make_objective(random_matrix(2, 1, 0)))


def magnitudes(matrix, drives):
    return (drives @ matrix.mT).abs()


WRONG_READINGS = {
    "negative": (lambda good: good - 9, r"objective\[0, 0\]: -.*; must be a magnitude"),
    "huge": (lambda good: 1e300 * good, "must be a magnitude"),
    "not a number": (lambda good: good * math.nan, "nan.* Pa"),
    "complex": (lambda good: good * 1j, "real"),
    "shape": (lambda good: good[:, :2], r"shape \(1, 2\); must be \(1, 3\)"),
}


@pytest.mark.parametrize(("change", "message"), WRONG_READINGS.values(), ids=WRONG_READINGS)
def test_a_reading_that_cannot_be_is_refused_and_harms_nothing(random_matrix, change, message):
    matrix, method = random_matrix(3, 8, 0), at.GABS(levels=4)
    state = method.start(at.Problem(8, 3))
    good, before = magnitudes(matrix, method.ask(state)), state.drives.clone()
    with pytest.raises(ValueError, match=message):
        method.tell(state, change(good))
    assert torch.equal(state.drives, before)
    assert method.tell(state, good).evaluations == len(good)


def test_ask_tell_and_best_refuse_what_does_not_fit_the_state(random_matrix):
    matrix, method = random_matrix(3, 8, 0), at.GABS(levels=2)
    state = method.start(at.Problem(8, 3))
    with pytest.raises(ValueError, match="nothing was observed yet"):
        method.best(state)
    for other in (at.LSSG(), at.GABS(levels=3)):
        with pytest.raises(ValueError, match=r"^state: .*must be of "):
            other.tell(state, magnitudes(matrix, method.ask(state)))
    while not state.done:
        state = method.tell(state, magnitudes(matrix, method.ask(state)))
    with pytest.raises(ValueError, match="it is done"):
        method.tell(state, torch.zeros(0, 3))


def test_drives_that_a_caller_scales_in_place_leave_the_state_alone(random_matrix):
    matrix, method, drives_of = random_matrix(3, 8, 0), at.GABS(levels=3), []
    for in_place in (False, True):
        state = method.start(at.Problem(8, 3))
        while not state.done:
            drives = method.ask(state)
            state = method.tell(state, magnitudes(matrix, drives.mul_(0.5) if in_place else 0.5 * drives))
        drives_of.append(method.best(state).drive)
    assert torch.equal(*drives_of)


@each([at.GABS(levels=4), METHODS[9], METHODS[-1]])
def test_scores_of_a_goal_with_parameters_carry_no_gradient(objective, method):
    weight = torch.ones((), dtype=torch.float64, requires_grad=True)
    solution = at.run(method, objective, goal=lambda pressure: weight * pressure.amin(dim=-1))
    assert not solution.score.requires_grad
    assert not solution.history.requires_grad
