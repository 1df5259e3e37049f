"""A study is repeatable, checks its settings first, and does not compute again what it finds finished."""

import functools
import json
import logging
import math
from dataclasses import dataclass, replace

import pytest
import torch
from small_scenes import CUBE, small_scene

import autdtorch as at
import autdtorch.study.run_study
from autdtorch.io.goal_section import load_goal
from autdtorch.propagators import FreeSpacePropagator, Run
from autdtorch.propagators.full import DomainSimulation
from autdtorch.study.folder import TRIALS_FILE, TrialFile
from autdtorch.study.results import summary_rows
from autdtorch.study.run_study import _for_poses, run_study

PLANE = at.Plane(center=(20e-3, 12e-3, 12e-3), normal=(1, 0, 0), size=(20e-3, 16e-3))
METHODS = {"lssg": at.LSSG(levels=4), "gabs": at.GABS(levels=4)}
FREE_SPACE = {"method": "free_space"}


def scene(plane=PLANE, obstacles=()):
    return replace(small_scene(obstacles), observation_plane=plane)


@pytest.fixture
def scenes():
    return {"second": scene(), "first": scene()}


@pytest.fixture
def count_runs(monkeypatch):
    computed = []
    run_scene = autdtorch.study.run_study._run_scene

    def counted(name, *rest):
        computed.append(name)
        return run_scene(name, *rest)

    monkeypatch.setattr(autdtorch.study.run_study, "_run_scene", counted)
    return computed


def test_every_trial_of_every_method_has_its_figures(scenes, tmp_path):
    results = run_study(
        scenes, METHODS, solver=FREE_SPACE, trials=3, seed=2, plane_spacing=2e-3, folder=tmp_path
    )
    assert list(results.scenes) == ["second", "first"]
    propagator = FreeSpacePropagator(scenes["first"])
    for result in results.scenes.values():
        assert list(result.methods) == ["lssg", "gabs"]
        assert torch.equal(result.transfer_matrix, propagator.transfer_matrix())
        assert [method.trials for method in result.methods.values()] == [1, 3]
        for method in result.methods.values():
            expected = propagator.field(method.solution.drive, scenes["first"].control_points).abs()
            # Sums of 4 terms, in another order.
            torch.testing.assert_close(method.solution.pressure, expected, rtol=1e-13, atol=0)
            assert torch.equal(method.metrics.mean, method.solution.pressure.mean(dim=-1))
            median = method.solution.score.quantile(0.5)
            assert method.solution.score[method.shown_trial] == median
            field = propagator.field(method.solution.drive, PLANE.points(2e-3).reshape(-1, 3))
            shown = field[method.shown_trial].reshape(10, 8)
            torch.testing.assert_close(method.plane_pressure, shown, rtol=1e-13, atol=0)
            loud = field.abs() >= method.metrics.mean[:, None] / 2**0.5
            torch.testing.assert_close(
                method.metrics.area, loud.sum(dim=1).double() * 4e-6 / 3, rtol=1e-13, atol=0
            )
    assert len((tmp_path / TRIALS_FILE).read_text(encoding="utf-8").splitlines()) == 2 * 4


def test_a_scene_without_observation_plane_has_no_areas(tmp_path):
    scenes = {"a": scene(None, obstacles=(CUBE,))}
    result = run_study(scenes, METHODS, tmp_path, solver=FREE_SPACE).scenes["a"]
    assert result.obstacles == 1
    for method in result.methods.values():
        assert method.metrics.area is None
        assert method.plane_pressure is None


def test_the_runs_of_a_simulation_are_recorded(tmp_path, monkeypatch):
    def simulate(self, sources, strength, receivers, stepped):
        rows, places = [], receivers.positions[:, 0]
        for nodes, own in zip(sources, strength, strict=True):
            rows.append(at.green(places, nodes.positions[:, 0], self.plan.scene.wavenumber) @ own)
        return 4 * math.pi * torch.stack(rows), [Run(7, 0.1, len(rows) == 3, 0.5)] * len(rows)

    monkeypatch.setattr(DomainSimulation, "_simulate", simulate)
    solver = {"method": "full", "spacing": 2e-3, "tolerance": 0.2, "kernel": "reference"}
    with pytest.warns(at.SteadyStateWarning):
        result = run_study({"a": scene()}, METHODS, tmp_path, solver=solver).scenes["a"]
    simulation = result.simulation
    assert (simulation.method, simulation.spacing, simulation.tolerance) == ("full", 2e-3, 0.2)
    # The transfer matrix of 3 control points, and the plane: one simulation for four equivalent transducers.
    assert simulation.runs == (Run(7, 0.1, True, 0.5),) * 3 + (Run(7, 0.1, False, 0.5),)
    # The transfer matrix was simulated by reciprocity, which is exact up to rounding.
    torch.testing.assert_close(
        result.transfer_matrix, FreeSpacePropagator(scene()).transfer_matrix(), rtol=1e-12, atol=0
    )


@pytest.fixture
def study(scenes, tmp_path):
    return functools.partial(run_study, scenes, METHODS, solver=FREE_SPACE, folder=tmp_path)


def test_finished_scenes_of_the_same_settings_and_source_are_used_again(
    study, count_runs, caplog, monkeypatch
):
    first = study(config="a: 1")
    with caplog.at_level(logging.INFO, logger="autdtorch.study.folder"):
        again = study(config="a: 1")
    assert count_runs == ["second", "first"]
    assert "re-using second, first" in caplog.text
    assert again.provenance == first.provenance
    drives = [result.scenes["first"].methods["gabs"].solution.drive for result in (first, again)]
    assert torch.equal(*drives)
    study(config="a: 2")
    study()
    monkeypatch.setattr("autdtorch.study.results.source_digest", lambda: "changed")
    study(config="a: 2")
    assert count_runs == ["second", "first"] * 4


def test_a_study_goes_on_after_the_scenes_that_were_finished(scenes, count_runs, tmp_path):
    objectives = []

    def interrupted(objective):
        solution = at.lssg(objective)
        objectives.append(objective)
        if len(objectives) == 2:
            raise KeyboardInterrupt
        return solution

    interrupted.__module__ = at.lssg.__module__  # results of others' methods are not re-used
    study = functools.partial(run_study, scenes, solver=FREE_SPACE, folder=tmp_path, config="a: 1")
    with pytest.raises(KeyboardInterrupt):
        study({"lssg": interrupted})
    assert list(at.load_results(tmp_path).scenes) == ["second"]
    results = study({"lssg": at.lssg})
    assert count_runs == ["second", "first", "first"]
    assert list(results.scenes) == ["second", "first"]
    assert list(at.load_results(tmp_path).scenes) == ["second", "first"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenes": {}}, "scenes: empty"),
        ({"methods": {}}, "methods: empty"),
        ({"scenes": {"a/b": scene()}}, r"scenes: 'a/b'; .*letters, digits"),
        ({"scenes": {3: scene()}}, "scenes: 3; a name must be text"),
        ({"methods": {3: at.gabs}}, "methods: 3; a name must be text"),
        ({"trials": 0}, "trials: 0; must be an integer >= 1"),
        ({"trials": {"gabs": -1}}, r"trials\.gabs: -1"),
        ({"trials": {"gabs": 1, "lssg": 2}}, "trials: unknown random method 'lssg'; allowed .*: gabs"),
        ({"trials": {}}, "trials: .* must also give the number for gabs"),
        ({"seed": -1}, "seed: -1"),
        ({"plane_spacing": float("nan")}, "plane_spacing: nan m"),
        ({"solver": {"spacing": -1.0}}, r"solver: spacing: -1\.0 m"),
        ({"goal": "mean_pressure"}, "goal: 'mean_pressure'; must be a Goal"),
        ({"goal": at.Push(0, (1, 0, 0))}, "goal: body: 0; must be a body, and the scene has none"),
        (
            {"goal": at.Levitate(None, particle=at.Particle.of("EPS", 2e-3))},
            "goal: particle.radius: 0.002 m; must be",
        ),
        (
            {"goal": at.Levitate(None, particle=at.Particle.of("EPS", 1e-3)), "scenarios": {}},
            "scenarios: {}; must be",
        ),
        (
            {
                "goal": at.Push(0, (1, 0, 0)),
                "scenes": {"a": scene(None, (CUBE,))},
                "solver": {"method": "box"},
            },
            'solver: method: \'box\'; must be "auto" or "tmatrix"',
        ),
        (
            {
                "goal": at.Levitate(None, particle=at.Particle.of("EPS", 1e-3)),
                "methods": {"i": at.Identify()},
            },
            "method i: goal: 'levitate'; must be of pressures at control points, which identify fits; for a",
        ),
        ({"goal": at.TargetPressures([3, 4])}, r"goal: targets: \(3\.0, 4\.0\); must be 3 numbers"),
        ({"methods": {"gabs": at.GABS(first=16)}}, "method gabs: first: 16; must be an integer from 0 to"),
    ],
)
def test_settings_are_checked_before_anything_is_simulated(changes, message, tmp_path, monkeypatch):
    monkeypatch.setattr(
        autdtorch.study.run_study, "_run_scene", lambda *_: pytest.fail("simulated too early")
    )
    with pytest.raises(ValueError, match=message) as caught:
        run_study(**{"scenes": {"a": scene()}, "methods": METHODS, "folder": tmp_path} | changes)
    assert "\n" not in str(caught.value)


def test_the_matrix_of_the_study_is_a_prior(tmp_path):
    methods = {"identify": at.Identify(evaluations=3, prior=at.Prior()), "climb": at.GradientAscent()}
    found = run_study({"a": scene(None)}, methods, tmp_path, solver=FREE_SPACE).scenes["a"].methods
    # 1e-4 is what either climb leaves.
    assert found["identify"].solution.score > 0.999 * found["climb"].solution.score


GOALS = [
    at.MeanPressure(),
    at.TargetPressures([9, 6, 9]),
    at.QuietPoints(at.MeanPressure(), [1], 0.1),
    at.Contrast([1]),
]


@pytest.mark.parametrize("goal", GOALS, ids=lambda goal: goal.name)
def test_methods_and_functions_maximise_the_goal_of_the_study(goal, tmp_path):
    methods = {"climb": at.GradientAscent(), "gabs": functools.partial(at.gabs, levels=4)}
    scene_result = run_study({"a": scene(None)}, methods, tmp_path, solver=FREE_SPACE, goal=goal).scenes["a"]
    assert scene_result.bound == goal.bound(scene_result.transfer_matrix)
    assert load_goal("goal", at.load_results(tmp_path).scenes["a"].goal) == goal
    for method in scene_result.methods.values():
        assert torch.equal(method.solution.score, goal(method.solution.pressure))
    climbed = scene_result.methods["climb"].solution.score
    assert scene_result.methods["gabs"].solution.score < climbed <= scene_result.bound


BEAD = at.Particle.of("EPS", 0.3e-3)
FORCES = {
    "push": at.Push(0, (1, 0, 0)),
    "trap": at.Trap([(22e-3, 7e-3, 14e-3)], [(1, 0, 0), (0, 2, 0)], BEAD),
    "levitate": at.Levitate(None, [(1, 0, 0)], BEAD, up=(1, 0, 0)),
}


@pytest.mark.parametrize("goal", FORCES.values(), ids=FORCES)
def test_a_study_of_a_force_has_a_score_and_a_bound_and_no_figures_of_foci(goal, tmp_path):
    methods = {"climb": at.GradientAscent(starts=2), "gabs": at.GABS(levels=4), "lssg": at.LSSG(levels=4)}
    ball = at.Sphere((14e-3, 12e-3, 12e-3), radius=3e-3, rigid=True)
    results = run_study({"a": scene(None, (ball,))}, methods, tmp_path, goal=goal, config="a: 1")
    for found in (results.scenes["a"], at.load_results(tmp_path).scenes["a"]):
        assert load_goal("goal", found.goal) == goal
        assert (found.simulation.method, found.unit) == ("tmatrix", goal.unit)
        scores = [method.solution.score for method in found.methods.values()]
        assert (1 - 1e-12) * max(scores) <= scores[0] <= found.bound  # all transducers in phase are best
        assert all(method.metrics is None for method in found.methods.values())
    head, first, *_ = summary_rows(results)
    assert head == ["scene", "method", "trials", "score", "evaluations", "of the bound"]
    number, *unit = first[3].split()
    factor = {"mN": 1e-3, "µN": 1e-6, "nN": 1e-9, "": 1.0}["".join(unit).removesuffix("/m")]
    assert float(number) * factor == pytest.approx(float(scores[0]), rel=5e-3)  # three digits
    nothing = replace(results.scenes["a"], bound=0.0)  # as of a trap that no drive makes
    share = summary_rows(replace(results, scenes={"a": nothing}))[1][-1]
    assert share.startswith("no drive above 0")
    assert share.endswith("(certified)")
    climb = results.scenes["a"].methods["climb"]
    silent = torch.zeros_like(scores[0])[None]
    climb = replace(climb, solution=replace(climb.solution, score=silent))
    idle = replace(results.scenes["a"], methods={"climb": climb})
    assert summary_rows(replace(results, scenes={"a": idle}))[1][-1].startswith("0 % of ")
    falling = replace(climb, solution=replace(climb.solution, score=-1 - silent))  # as of no trap
    idle.methods["climb"] = falling
    assert summary_rows(replace(results, scenes={"a": idle}))[1][-1].startswith("below 0 % of ")
    (row, *_) = map(json.loads, (tmp_path / TRIALS_FILE).read_text().splitlines())
    assert "weakest" not in str(row)
    assert "min" not in row


@dataclass(frozen=True)
class Loudest(at.Goal):
    def __call__(self, pressure):
        return pressure.amax(dim=-1)


def test_a_goal_of_ones_own_has_no_bound_and_is_computed_again(study, count_runs, tmp_path):
    for _ in range(2):
        results = study(config="a: 1", goal=Loudest())
    assert count_runs == ["second", "first"] * 2
    found = results.scenes["first"]
    assert found.bound == at.load_results(tmp_path).scenes["first"].bound == math.inf
    assert found.score_label == "Loudest [Pa]"
    solution = found.methods["gabs"].solution
    assert torch.equal(solution.score, solution.pressure.amax(dim=1))


def test_a_function_that_takes_no_score_is_refused_for_another_goal(tmp_path):
    def weakest(objective):
        return at.lssg(objective)

    with pytest.raises(ValueError, match="method own: 'weakest'; must have a parameter `goal`"):
        run_study({"a": scene()}, {"own": weakest}, tmp_path, solver=FREE_SPACE, goal=at.MeanPressure())


@pytest.mark.parametrize("returned", [1, 3])
def test_a_method_returns_the_trials_it_is_asked_for(returned, tmp_path):
    def method(objective, trials, seed):
        return at.gabs(objective, levels=4, trials=returned, seed=seed)

    with pytest.raises(ValueError, match=rf"method own: {returned} trials; must be the trials \[0, 1\]"):
        run_study({"a": scene(None)}, {"own": method}, tmp_path, solver=FREE_SPACE, trials=2)


def test_poses_start_at_the_drives_of_the_scene_before(tmp_path):
    scenes = {str(step): scene(None, (CUBE,)).moved((0, 1e-3 * step, 0)) for step in range(3)}
    settings = {"method": "box", "spacing": 2e-3, "tolerance": 0.1}
    method = at.GABS(levels=4, order="given")
    results = run_study(scenes, {"gabs": method}, tmp_path / "poses", solver=settings, poses=True, trials=2)
    found = [each.methods["gabs"].solution for each in results.scenes.values()]
    # all transducers are on from the second pose on: one observation, then four phases of each
    assert [int(solution.evaluations[0]) for solution in found] == [1 + 3 * 4, 1 + 4 * 4, 1 + 4 * 4]
    for before, after, each in zip(found, found[1:], list(results.scenes.values())[1:], strict=False):
        observed = (before.drive[0] @ each.transfer_matrix.T).abs().amin()
        assert float(after.history[0, 0]) == pytest.approx(float(observed))


def test_poses_are_simulated_by_tmatrices_where_these_are_fewer_runs():
    cube = at.Box((12e-3,) * 3, (3e-3,) * 3, rigid=True)
    scenes = {f"{step}": scene(None, (cube,)).moved((0, 1e-5 * step, 0)) for step in range(60)}
    solver = {"spacing": 2e-3, "tolerance": 0.1}
    assert _for_poses(scenes, solver) == solver | {"method": "tmatrix"}
    assert _for_poses({"0": scenes["0"]}, solver) == solver


def test_scenarios_stand_for_each_scene(tmp_path):
    around = {"count": 3, "by": "worst", "failed": 1}
    study = functools.partial(
        run_study, {"a": scene()}, METHODS, tmp_path, solver=FREE_SPACE, plane_spacing=2e-3, config="one"
    )
    result = study(scenarios=around).scenes["a"]
    points = len(scene().control_points)
    every = at.Scenarios.around(FreeSpacePropagator(scene()), **around)
    assert torch.equal(result.transfer_matrix, every.transfer_matrix)
    assert result.score_label == "weakest focus, worst of scenes [Pa]"
    for method in result.methods.values():
        assert method.solution.pressure.shape == (1, 3 * points)
        assert every.scores(method.solution.drive).amin() == pytest.approx(float(method.solution.score))
        assert method.solution.score <= result.bound
        foci = at.focus_metrics(method.solution.pressure[:, :points], method.plane_pressure[None].abs(), 4e-6)
        assert method.metrics.area.item() == pytest.approx(foci.area.item())  # of the scene itself
    again = study(scenarios=around).scenes["a"]  # read from the folder
    assert torch.equal(again.methods["gabs"].solution.drive, result.methods["gabs"].solution.drive)
    for wrong, message in (({"counts": 3}, "counts"), ({"count": 0}, "count: 0"), ({"by": "best"}, "by")):
        with pytest.raises(ValueError, match=f"scenarios.*{message}"):
            study(scenarios=wrong)
    with pytest.raises(ValueError, match="scenarios: failed: -1"):
        study(scenarios={"failed": -1}, config="two")


def test_the_time_left_of_a_study_goes_by_method_and_scene(study, tmp_path, monkeypatch):
    left = []
    append = TrialFile.append

    def timed(self, scene, method, trials, solution, seconds):
        append(self, scene, method, trials, solution, {"lssg": 1.0, "gabs": 500.0}[method])
        left.append(self.seconds_left({"lssg": 1, "gabs": 5}))

    monkeypatch.setattr(TrialFile, "append", timed)
    study(trials=5)
    # of one method the time is known; then of both; then in the second scene no matter how unequal they are
    assert left == [(1.0, math.inf), (501.0, 501.0), (500.0, 500.0), (0.0, 0.0)]
