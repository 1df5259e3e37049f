"""Ask and tell: one loop runs every method, a state survives a file, and what is wrong is refused."""

import subprocess
import sys
from dataclasses import dataclass

import pytest
import torch

import autdtorch as at
from autdtorch.methods.base import Step, trial_seed

METHODS = [
    at.LSS(),
    at.LSSG(levels=4, passes=2),
    at.GABS(levels=4, passes=3),
    at.GABS(levels=3, order="strength"),
    at.RandomSearch(evaluations=130),
    at.Identify(evaluations=30),
    at.GradientAscent(steps=20),
    at.BayesOpt(evaluations=12, initial=5, fixed_transducer=1),
]
EVERY = pytest.mark.parametrize("method", METHODS, ids=lambda method: repr(method)[:25])


@dataclass(frozen=True)
class OneByOne(at.Method):
    """A method of one's own: one random drive after the other."""

    evaluations: int = 5

    def most_evaluations(self, problem):
        return self.evaluations

    def begin(self, problem, seeds):
        drives = [torch.full((1, problem.transducers), 1j**seed) for seed in seeds]
        return Step(torch.stack(drives).to(torch.complex128), {})

    def advance(self, state, pressure, score):
        done = state.best.history.shape[1] == self.evaluations
        return Step(state.drives[:, :0] if done else state.drives * 1j, {})


@EVERY
def test_a_loop_of_ones_own_finds_what_run_finds(make_objective, random_matrix, method):
    objective = make_objective(random_matrix(3, 5, 0))
    state = method.start(at.Problem.of(objective), seed=3)
    while len(drives := method.ask(state)):
        state = method.tell(state, objective(drives))
    assert state.done
    found, expected = method.best(state), at.run(method, objective, seed=3)
    assert torch.equal(found.drive, expected.drive)
    assert torch.equal(found.history, expected.history)


@EVERY
def test_a_state_from_a_file_goes_on_as_if_nothing_had_happened(
    make_objective, random_matrix, method, tmp_path
):
    objective = make_objective(random_matrix(3, 5, 0))
    problem = at.Problem.of(objective)
    state = method.start(problem, seed=3, trials=2 if method.random else 1)
    path = tmp_path / "state.npz"
    while len(drives := method.ask(state)):
        at.save_state(path, method, method.tell(state, objective(drives)))
        state = at.load_state(path, method, problem)
    expected = at.run(method, objective, seed=3, trials=2 if method.random else 1)
    assert torch.equal(method.best(state).drive, expected.drive)
    assert torch.equal(method.best(state).history, expected.history)


@EVERY
def test_telling_changes_no_state(make_objective, random_matrix, method):
    objective = make_objective(random_matrix(3, 5, 0))
    first = method.start(at.Problem.of(objective))
    pressure = objective(method.ask(first))
    second, again = method.tell(first, pressure), method.tell(first, pressure)
    assert torch.equal(method.ask(second), method.ask(again))
    if len(drives := method.ask(second)):
        method.tell(second, objective(drives))
        third = method.tell(again, objective(drives))
        assert third.evaluations == len(pressure) + len(drives)
    assert first.evaluations == 0


def test_a_run_stops_and_goes_on_from_its_file(make_objective, random_matrix, tmp_path):
    objective = make_objective(random_matrix(3, 5, 0))
    method, path = at.GABS(levels=4), tmp_path / "state.npz"
    stopped = at.run(method, objective, state_file=path, stop=lambda state: state.evaluations >= 9)
    assert stopped.evaluations.tolist() == [9]
    assert objective.evaluations == 9
    whole = at.run(method, objective, state_file=path)
    assert objective.evaluations == 17
    assert torch.equal(whole.drive, at.run(method, objective).drive)
    for other in (at.GABS(levels=5), at.LSSG()):
        with pytest.raises(ValueError, match=r"state\.npz: state of .*gabs.*; must be of"):
            at.run(other, objective, state_file=path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"state\.npz"):
        at.run(method, objective, state_file=path)


def test_a_method_of_ones_own_runs_as_ours_do(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 5, 0))
    solution = at.run(OneByOne(), objective, trials=3)
    assert solution.evaluations.tolist() == [5] * 3
    # A common phase changes no magnitude: all its drives are as good, and the first is kept.
    assert torch.equal(
        solution.drive, torch.stack([torch.full((5,), 1j ** trial_seed(0, t)) for t in range(3)])
    )
    assert (OneByOne.name, OneByOne.label) == ("OneByOne", "OneByOne")


def test_the_goal_is_a_function_of_its_own(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 4, 0))
    solution = at.run(at.RandomSearch(6), objective, score=lambda pressure: pressure.mean(dim=-1))
    assert torch.equal(solution.score, solution.pressure.mean(dim=-1))


class Broken:
    """An objective with a broken sensor."""

    def __init__(self, objective, pressure):
        self.scene = objective.scene
        self.evaluations = 0
        self._pressure = pressure

    def __call__(self, drive):
        return self._pressure


@pytest.mark.parametrize(
    ("pressure", "message"),
    [
        (torch.tensor([[1.0, torch.nan], [1.0, 1.0]]), "pressure of the objective: .*nan.* Pa; every entry"),
        (torch.ones(2, 3), r"pressure of the objective: shape \(2, 3\); must be \(2, 2\)"),
        (torch.ones(2, 2, dtype=torch.complex128), "pressure of the objective: .*real"),
    ],
    ids=["nan", "shape", "complex"],
)
def test_what_is_no_pressure_is_refused(make_objective, random_matrix, pressure, message):
    objective = Broken(make_objective(random_matrix(2, 4, 0)), pressure)
    with pytest.raises(ValueError, match=message):
        at.run(at.RandomSearch(evaluations=2), objective)


def test_a_score_of_another_shape_is_refused(make_objective, random_matrix):
    with pytest.raises(ValueError, match=r"score: shape \(1, 2, 2\); must be \(1, 2\)"):
        at.run(at.RandomSearch(2), make_objective(random_matrix(2, 4, 0)), score=lambda pressure: pressure)


def test_a_problem_without_geometry_or_matrix_is_refused_where_they_are_needed():
    problem = at.Problem(transducers=4, foci=2)
    assert at.GABS().start(problem).drives.shape == (1, 1, 4)
    for method, field in ((at.LSS(), "problem.scene"), (at.GradientAscent(), "objective")):
        with pytest.raises(ValueError, match=field):
            method.start(problem)
    with pytest.raises(ValueError, match="trials: 2; must be 1"):
        at.LSSG().start(problem, trials=2)
    with pytest.raises(ValueError, match="transducers: 0"):
        at.Problem(transducers=0, foci=2)


def test_different_seeds_and_trials_are_unrelated():
    seeds = {trial_seed(seed, trial) for seed in range(20) for trial in range(50)}
    assert len(seeds) == 1000
    assert min(seeds) >= 0  # torch takes no more than 63 bits
    assert max(seeds) < 2**63


def test_importing_the_methods_loads_no_numba():
    code = (
        "import sys, autdtorch.methods.catalogue;"
        "sys.exit(any(name.split('.')[0] == 'numba' for name in sys.modules))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
