"""Functions of methods: their stub and old keywords; settings that are written once; a goal that is new."""

import ast
import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
import torch
import yaml

import autdtorch as at
from autdtorch.io.goal_section import GOALS, goal_section, load_goal
from autdtorch.methods import functions
from autdtorch.methods.catalogue import METHODS, VARIANTS
from autdtorch.study.run_study import run_study

STUB = Path(functions.__file__).with_suffix(".pyi")
CONFIGS = Path(__file__).parents[2] / "configs/method"
FUNCTIONS = {
    node.name: node for node in ast.parse(STUB.read_text()).body if isinstance(node, ast.FunctionDef)
}


@pytest.fixture
def objective(make_objective, random_matrix):
    return make_objective(random_matrix(3, 5, 0))


def test_the_stub_has_the_parameters_of_the_functions():
    assert set(FUNCTIONS) == set(METHODS) - {"holography"}
    for name, node in FUNCTIONS.items():
        parameters = inspect.signature(getattr(functions, name)).parameters.values()
        by_position = [one.name for one in parameters if one.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD]
        assert [one.arg for one in node.args.args] == by_position
        listed = {one.arg: ast.unparse(one.annotation) for one in node.args.args + node.args.kwonlyargs}
        assert listed == {one.name: one.annotation for one in parameters}
        defaults = [*node.args.defaults, *(one for one in node.args.kw_defaults if one)]
        shown = [ast.literal_eval(one) for one in defaults]
        expected = [... if one.name == "goal" else one.default for one in parameters]
        assert shown == expected[len(expected) - len(shown) :]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_old_keyword_of_the_goal_is_taken_with_a_warning(objective, name):
    function = getattr(at, name)
    few = {"evaluations": 20, "levels": 4, "steps": 5}
    settings = {key: few[key] for key in few.keys() & inspect.signature(function).parameters.keys()}
    if name == "random_search":
        del settings["levels"]
    with pytest.warns(DeprecationWarning, match="score= is now goal=") as caught:
        found = function(objective, score=at.MeanPressure(), **settings)
    assert caught[0].filename == __file__
    assert torch.equal(found.drive, function(objective, goal=at.MeanPressure(), **settings).drive)
    with pytest.raises(TypeError, match="score: has the new name goal"):
        function(objective, score=at.MeanPressure(), goal=at.MeanPressure())


def test_old_names_of_the_goal_elsewhere(objective):
    with pytest.warns(DeprecationWarning, match="score= is now goal="):
        at.run(at.LSS(), objective, score=at.MeanPressure())
    with pytest.warns(DeprecationWarning, match="score= is now goal="):
        problem = at.FocusProblem(objective, score=at.MeanPressure())
    with pytest.warns(DeprecationWarning, match=r"FocusProblem\.goal"):
        assert problem.score is problem.goal


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_configs_have_the_settings_of_a_class_or_a_variant(path):
    settings = yaml.safe_load(path.read_text(encoding="utf-8"))
    kind = METHODS[settings.pop("_target_").removeprefix("autdtorch.")]
    settings = {key: float(value) if value == "1e-4" else value for key, value in settings.items()}
    assert kind(**settings) == VARIANTS.get(path.stem, kind())


@dataclass(frozen=True)
class LoudestFocus(at.Goal):
    """A goal of one file: its class."""

    name: ClassVar[str] = "loudest_focus"

    share: float = 1.0

    def __call__(self, pressure):
        return self.share * self.checked(pressure).amax(dim=-1)


def test_a_new_goal_needs_its_class_and_one_entry(objective, monkeypatch, tmp_path):
    monkeypatch.setitem(GOALS, LoudestFocus.name, LoudestFocus)  # the entry
    goal = load_goal("goal", {"name": "loudest_focus", "share": 0.5})
    assert goal == LoudestFocus(0.5) == load_goal("goal", goal_section(goal))
    for method in (at.GABS(levels=4), at.Identify(20), at.GradientAscent(2, 20), at.Holography()):
        solution = at.run(method, objective, goal=goal)
        assert torch.equal(solution.score, 0.5 * solution.pressure.amax(dim=1))
    scenes, solver = {"scene": objective.scene}, {"method": "free_space"}
    study = run_study(scenes, {"lss": at.LSS()}, tmp_path, solver=solver, goal=goal)
    again = at.load_results(tmp_path)
    assert again.scenes["scene"].score_label == study.scenes["scene"].score_label == "loudest focus [Pa]"
