"""Readings of drives that a method did not ask for: none is lost, and methods go on from them."""

import itertools
import random
import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.methods.further_readings import independent_readings
from autdtorch.methods.gradient import random_drives
from autdtorch.objectives.perturbations import Quantised

GUESS = torch.randn(3, 5, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
FOCI = {"model": "foci", "kernel": "phasor", "noise": "inferred", "fixed_transducer": 1}
LEARNING = [
    at.Identify(evaluations=14),
    at.Identify(evaluations=5, prior=at.Prior(GUESS)),
    at.BayesOpt(evaluations=6, initial=4, fixed_transducer=1),
    at.BayesOpt(evaluations=6, initial=4, **FOCI),
]
PLANNED = [at.GABS(levels=3), at.LSSG(levels=3), at.RandomSearch(evaluations=6)]


def each(methods):
    return pytest.mark.parametrize("method", methods, ids=lambda method: repr(method)[:25])


@pytest.fixture(scope="module")
def bench(make_objective, random_matrix):
    return make_objective(random_matrix(3, 5, 0))


def readings_of(objective, count, seed=0):
    drives = random_drives(count, len(objective.scene.array), torch.Generator().manual_seed(seed))
    return at.Readings(drives, objective(drives))


def ended(method, state, objective, drives=False):
    """The solution of a loop that tells the drives of `ask`, with or without them."""
    while not state.done:
        asked = method.ask(state)
        state = method.tell(state, objective(asked), *([asked] if drives else []))
    return method.best(state)


def same(one, other):
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in vars(one))


@each([*PLANNED, *LEARNING])
def test_asked_drives_may_be_told_in_any_parts_and_order(bench, method):
    trials, draws = 2 if method.random else 1, random.Random(7)
    state = first = method.start(at.Problem.of(bench), 3, trials)
    expected = ended(method, first, bench)
    assert same(ended(method, first, bench, drives=True), expected)
    while not state.done:
        asked = method.ask(state)
        some = asked[draws.sample(range(len(asked)), draws.randint(1, len(asked)))]
        state = method.tell(state, bench(some), some)
    assert same(method.best(state), expected)


@each(LEARNING)
@settings(max_examples=2)
@given(cuts=st.sets(st.integers(1, 5)))
def test_further_readings_at_once_or_one_by_one_are_the_same_data(bench, method, cuts):
    readings = readings_of(bench, 6)
    state = method.start(at.Problem.of(bench))
    state = method.tell(state, bench(method.ask(state)))
    at_once = method.tell(state, readings.pressure, readings.drives)
    for first, last in itertools.pairwise([0, *sorted(cuts), 6]):
        state = method.tell(state, readings.pressure[first:last], readings.drives[first:last])
    assert state.evaluations == at_once.evaluations
    assert torch.equal(method.ask(state), method.ask(at_once))  # the plan stays until the next step
    assert torch.equal(state.readings.drives, at_once.readings.drives)
    solutions = [ended(method, each, bench) for each in (state, at_once)]
    assert same(*solutions)
    assert solutions[0].evaluations == method.evaluations


@each([at.GABS(levels=4), *LEARNING])
def test_what_a_device_plays_for_asked_drives_answers_them(bench, method):
    device = Quantised(bench, levels=10)
    state = method.start(at.Problem.of(bench))
    while not state.done:
        played = device.quantised(method.ask(state))
        state = method.tell(state, bench(played), played)
    assert state.readings is None
    solution = method.best(state)
    assert solution.evaluations <= method.most_evaluations(state.problem)
    # Its drive and its pressures belong together: both are of the played drive.
    assert torch.allclose(bench(solution.drive), solution.pressure, rtol=1e-9)


@each(PLANNED)
def test_a_plan_goes_on_beside_other_drives_of_which_the_best_counts(bench, method):
    expected = at.run(method, bench)
    problem, optimum = at.Problem.of(bench), at.gradient_ascent(bench)
    state = method.start(problem)
    state = method.tell(state, optimum.pressure, optimum.drive)
    assert state.evaluations == 0
    assert method.best(state).score == optimum.score
    solution = ended(method, state, bench)
    assert torch.equal(solution.history, expected.history)
    assert torch.equal(solution.drive, optimum.drive)
    worst = at.Readings(torch.zeros(1, 5, dtype=torch.complex128), torch.zeros(1, 3))
    assert same(at.run(method, bench, readings=worst), expected)


def test_gaps_are_refused_where_a_drive_was_asked_for_and_kept_elsewhere(bench):
    method = at.RandomSearch(evaluations=2)
    state = method.start(at.Problem.of(bench))
    asked = method.ask(state)
    pressure = bench(asked)
    pressure[1, 0] = torch.nan
    with pytest.raises(ValueError, match=r"pressure\[1\]: .*; must have no gap, as the drive was asked for"):
        method.tell(state, pressure, asked)
    state = method.tell(state, pressure, -1j * asked * torch.tensor([1, 1, 1, 1, -1]))
    assert (len(state.readings), state.readings.count) == (2, 5)
    assert method.best(state).pressure.isfinite().all()


def test_identify_goes_on_from_earlier_readings_with_gaps(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 8, 0))
    best = at.gradient_ascent(objective).score
    with pytest.raises(ValueError, match="evaluations: 4; must be an integer >= 20"):
        at.identify(objective, 4)
    readings = readings_of(objective, 40)
    readings.pressure[::3, 0] = readings.pressure[5:15, 2] = torch.nan
    before = objective.evaluations
    solution = at.identify(objective, 4, readings=readings)
    assert objective.evaluations == before + 4 == before + int(solution.evaluations)
    assert solution.score > 0.999 * best  # readings without noise determine the matrix
    with pytest.raises(ValueError, match="evaluations: 4; must be"):
        at.identify(objective, 4, readings=readings[[0] * 40])  # one drive 40 times


def test_drives_that_repeat_or_differ_little_show_little():
    drives = random_drives(20, 6, torch.Generator().manual_seed(0))
    assert independent_readings(drives) == 20
    assert independent_readings(drives[[0, 1, 1, 0, 2]]) == 3
    assert independent_readings(random_drives(100, 6, torch.Generator())) == 24
    # The phase of one transducer: constant, cosine and sine
    one = drives[:1].expand(16, -1).clone()
    one[:, 2] = torch.polar(torch.ones(16).double(), torch.linspace(0, 6, 16).double())
    assert independent_readings(one) == 3


def test_an_outlier_among_earlier_readings_is_left_out_and_named(make_objective, random_matrix, caplog):
    objective = make_objective(random_matrix(3, 8, 0))
    readings = readings_of(objective, 40)
    readings.pressure[7, 1] *= 100
    solution = at.identify(objective, 4, readings=readings)
    assert solution.score > 0.999 * at.gradient_ascent(objective).score
    assert "earlier reading 7 at control point 1" in caplog.text


def test_an_outlier_among_earlier_readings_harms_no_search_of_foci(bench, caplog):
    readings = readings_of(bench, 30)
    wrong = at.Readings(readings.drives, readings.pressure.clone())
    wrong.pressure[3, 1] *= 100
    method = at.BayesOpt(evaluations=4, initial=2, **FOCI)
    score = [at.run(method, bench, readings=each).score for each in (readings, wrong)]
    assert torch.allclose(*score, rtol=0.02)  # the matrix is known from 29 drives of 5 transducers
    assert "left out, far from the fit: 1 pressure" in caplog.text


def test_repeats_of_a_drive_accuse_no_sensor(make_objective, random_matrix, caplog):
    matrix = random_matrix(3, 5, 0)
    objective = make_objective(matrix)
    readings = readings_of(objective, 1)[[0] * 20]
    problem = at.Problem.of(objective, readings=readings)
    at.Identify(evaluations=5, prior=at.Prior(matrix)).start(problem)
    assert "sensor" not in caplog.text


def test_a_search_of_foci_refuses_a_sensor_that_never_read_anything(bench):
    readings = readings_of(bench, 20)
    readings.pressure[:, 1] = 0
    with pytest.raises(ValueError, match=r"readings.pressure\[:, 1\]: 0.0 Pa; must not be 0 throughout"):
        at.bo_foci(bench, 6, readings=readings)


def test_readings_take_the_place_of_initial_drives(bench):
    for count, asked in ((2, 3), (5, 1), (9, 1)):
        for method in (at.BayesOpt(8, 5), at.BayesOpt(8, 5, **FOCI)):
            state = method.start(at.Problem.of(bench), readings=readings_of(bench, count))
            assert state.drives.shape == (1, asked, 5)
    assert ended(method, state, bench).evaluations == 8
    prior = at.BayesOpt(3, 5, **FOCI, prior=at.Prior(GUESS))
    first = prior.start(at.Problem.of(bench)).drives
    assert not torch.equal(prior.start(at.Problem.of(bench), readings=readings_of(bench, 9)).drives, first)


def test_a_search_from_many_readings_needs_few_new_ones(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 8, 0))
    readings, best = readings_of(objective, 40), at.gradient_ascent(objective).score
    assert at.bo_foci(objective, 6, readings=readings).score > 0.95 * best  # measured: 0.999
    assert at.bo_foci(objective, 6).score < 0.9 * best


def test_readings_that_a_search_cannot_use_are_told(bench, caplog):
    readings = readings_of(bench, 6)
    readings.pressure[0, 1] = torch.nan
    half = at.Readings(torch.cat([readings.drives, 0.5 * readings.drives[:2]]),
                       torch.cat([readings.pressure, 0.5 * readings.pressure[:2]]))  # fmt: skip
    at.bayes_opt(bench, 6, 4, readings=half)
    assert "3 of 8 readings are not used: they have gaps or amplitudes below 1" in caplog.text


def test_points_of_readings_are_control_points_in_any_order(bench):
    readings, points = readings_of(bench, 20), bench.scene.control_points
    order = [2, 0, 1]
    placed = at.Readings(readings.drives, readings.pressure[:, order], points[order] + 1e-5)
    expected = at.identify(bench, 4, readings=readings)
    assert same(at.identify(bench, 4, readings=placed), expected)
    two = at.Readings(readings.drives, readings.pressure[:, :2], points[:2])
    assert at.Problem.of(bench, readings=two).readings.pressure[:, 2].isnan().all()
    away = at.Readings(readings.drives, readings.pressure, points + 1e-3)
    with pytest.raises(
        ValueError, match=r"readings\.points\[\d\]: .* m; must be a control point of the scene"
    ):
        at.run(at.GABS(), bench, readings=away)
    with pytest.raises(ValueError, match=r"readings\.points: .*the problem has no scene"):
        at.Problem(5, 3, readings=placed)
    with pytest.raises(ValueError, match=r"readings\.drives: shape \(20, 5\); must be \(N, 4\)"):
        at.Problem(4, 3, readings=readings)
    with pytest.raises(ValueError, match=r"readings\.pressure: shape \(20, 3\); must be \(N, 2\)"):
        at.Problem(5, 2, readings=readings)
    with pytest.raises(ValueError, match=r"readings: .*; must be None for a sequence"):
        at.run(at.GABS(), [bench, bench], readings=readings)


@each(LEARNING)
def test_a_run_with_readings_goes_on_from_its_file(bench, method, tmp_path):
    readings, path = readings_of(bench, 9), tmp_path / "state.npz"
    expected = at.run(method, bench, readings=readings)
    at.run(method, bench, readings=readings, state_file=path, stop=lambda state: state.evaluations >= 2)
    with pytest.raises(ValueError, match=re.escape('"readings":')):
        at.run(method, bench, state_file=path)
    assert same(at.run(method, bench, readings=readings, state_file=path), expected)


def test_a_file_holds_what_was_told_of_a_step(bench, tmp_path):
    method, path, problem = at.GABS(levels=4), tmp_path / "state.npz", at.Problem.of(bench)
    state = method.start(problem)
    state = method.tell(state, bench(method.ask(state)))
    readings = readings_of(bench, 2)
    state = method.tell(state, readings.pressure, readings.drives)
    some = method.ask(state)[1:3]
    state = method.tell(state, bench(some), some)
    at.save_state(path, method, state)
    loaded = at.load_state(path, method, problem)
    assert torch.equal(method.ask(loaded), method.ask(state))
    assert len(method.ask(loaded)) == 2
    assert torch.equal(loaded.readings.pressure, readings.pressure)
    assert same(ended(method, loaded, bench), ended(method, state, bench))
