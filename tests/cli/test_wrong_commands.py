"""Wrong settings on the command line, and errors of a user's modules, end in one line."""

import os
import re
import subprocess
import sys

import pytest

import autdtorch.cli.arguments
import autdtorch.study.run_study

#: Overrides in one string, divided by two spaces, and the beginning of the message.
WRONG = {
    "goal=loudest": "goal: 'loudest'; must be one of contrast, levitate, mean_pressure, push, quiet_points, ",
    "goal=push": "goal: direction: None; must be 3 real numbers",
    "goal=push  goal.direction=[1,0,0]": "goal: body: 0; must be a body, and the scene has none",
    "goal=trap  goal.particle.density=20": "goal.particle: material: 'EPS'; must be null where density and",
    "goal=trap  goal.particle.material=wood": "goal.particle: material: 'wood'; must be one of EPS, water",
    "goal=trap  goal.particle.radius=5e-3": "goal: particle.radius: 0.005 m; must be at most 0.001",
    "goal=trap  goal.particle=3": "goal.particle: 3; must be a mapping, such as",
    "goal=trap  scenarios={count:3}": "scenarios: {'count': 3}; must be null: a goal of force",
    "goal.name=loudest": r"goal\.name: 'loudest'; must be one of weakest_focus, mean_pressure, ",
    "goal=target_pressures": "goal: targets: None; must be",
    "goal=target_pressures  goal.targets=[4,2]": r"goal: targets: \(4\.0, 2\.0\); must be 4 numbers",
    "goal=quiet_points  goal.points=[4]": r"goal: points: \(4,\); must be indices from 0 to 3",
    "goal=quiet_points  goal.points=[3]  goal.goal=gabs": r"goal\.goal\.name: 'gabs'; must be one of",
    "goal=quiet_points  goal.points=[3]  goal.goal=3": r"goal\.goal: 3; must be the name of a goal",
    "+goal.targets=[1]": "goal: unknown key 'targets'.*; allowed keys: name, weights",
    "+goal._target_=os.system": r"goal\._target_: 'os\.system'; must not be given",
    "goal=quiet_points  goal.goal={_target_:os.system}": r"goal\.goal\._target_: 'os\.system'; must not be",
    "scene=two_cube": r"scene: 'two_cube'; must be one of .* \(did you mean 'two_cubes'\?\)",
    "method=GABS": r"method: 'GABS'; must be one of .* \(did you mean 'gabs'\?\)",
    "experiment=nature": "experiment: 'nature'; must be one of paper",
    "trails=3": r"trails: unknown key \(did you mean 'trials'\?\)",
    "trial=3": r"trial: unknown key \(did you mean 'explore.trial' or 'trials'\?\)",
    "spacing=2e-3": r"spacing: unknown key \(did you mean 'solver.spacing' or 'plane_spacing'\?\)",
    "solvr.spacing=2e-3": r"solvr: unknown key \(did you mean 'solver'\?\)",
    "hardware.device=autd3": r"hardware\.device: there is no hardware; must be chosen, as hardware=NAME",
    "method.level=8": r"method\.level: unknown key \(did you mean 'levels'\?\); keys that are set: levels, ",
    "scene.medium.absorption=1": r"scene\.medium\.absorption: .*; .* as \+scene\.medium\.absorption=1;",
    "+solver.spcing=1e-3": "solver: unknown key 'spcing' .*; allowed keys: method, spacing, ",
    "+speed=1": "settings: unknown key 'speed' .*; allowed keys: scene, method, ",
    "solver.spacing=abc": "solver: spacing: 'abc'; must be a real number",
    "plane_spacing=1": r"plane_spacing: 1\.0 m; must be at most 0\.1 m, the plane's edge",
    "scene.frequency=-40e3": r"scene: Scene\.frequency: -40000\.0 Hz; must be finite and > 0",
    "method._target_=autdtorch.tabu": r"method\._target_: 'autdtorch\.tabu'; must be one of autdtorch",
    "method._target_=tabu.search  modules=tabu": r"method\._target_: .*No module named 'tabu'",
    "method._target_=.foo.gabs  modules=.foo": r"method\._target_: '\.foo\.gabs'; must be a module",
    "method._target_=autdtorch": r"method\._target_: 'autdtorch'; must be one of",
    "~method._target_": "method: no _target_",
    "scene.obstacles.0.density=5": "scene.obstacles.0.density: a list has no item",
    "scene.array={type: file, path: a.csv}": r"scene\.array\.path: unknown key",
    "solver.spacing=[1": r"argument 'solver\.spacing=\[1': no viable alternative at input",
    "-m  hydra.sweep.dir=a=b": r"argument 'hydra\.sweep\.dir=a=b': mismatched input",
    "seed=1,2": "Ambiguous value for argument 'seed=1,2'",
    "--config-dir  nowhere": "Additional config directory '.*nowhere' not found",
    "scene=two_cubes  scene.control_points=[]": r"scene\.control_points: a list in place of a map.*; ~scene",
    "output=file": "output: 'file' is a file; must be a folder",
    "output=file/below": "file/below: Not a directory",
    "experiment=paper  scene=two_cubes": "scene: given beside an experiment, .* own scenes: homog",
    "experiment=paper  scenes.two_cubes.frequency=0": r"scenes\.two_cubes: Scene\.frequency: 0 Hz",
    "experiment=paper  methods.gabs.levels=0": r"methods\.gabs: levels: 0",
    "experiment=paper  trials.gabs=0": r"trials\.gabs: 0; must be an integer >= 1",
    "experiment=paper  scenes=3": "scenes: 3; must be a mapping",
    "experiment=paper  poses={count: 2}": "poses: .*beside an experiment",
    "poses={rotaton: [0, 0, 1], count: 3}": "poses: unknown key 'rotaton' .*'rotation'",
    "three_cubes": "three_cubes: must be key=value",
    "explor": "explor: must be key=value, .*did you mean 'explore'",
    "hydra/launcher=nope": r"hydra/launcher: 'nope'; must be one of basic, joblib.*extra cluster",
    "hydra/job_logging=lab/mine.yaml": r".*: hydra\.searchpath=\[FOLDER\] hydra/job_logging=mine",
    "scene=configs/scene/two_cubes.yaml": "scene: .* a name, not a path: scene=two_cubes; .*--config-dir",
    "scene=lab/scene/duct.yaml": "scene: .* a name, not a path: --config-dir lab scene=duct",
    "hardware=emulated  hardware/sensor=scpe": r"hardware/sensor: 'scpe'; .*did you mean 'scope'",
    "collect": "collect: ''; must be one folder",
    "collect  .": r"\.: no finished study \(results\.h5\) there or below",
    "scene=homogeneous  collect": "collect: 'scene=homogeneous'; must be one folder",
    "--scene  two_cubes": "--scene: unknown option; settings have no dashes, as in scene=VALUE",
    "--multrun  seed=1,2": "--multrun: unknown option .*did you mean '--multirun'",
    "-m  output=x": r"output=x: a sweep has a folder .* hydra\.sweep\.dir=x",
    "hydra.mode=MULTIRUN  output=x": r"output=x: a sweep has a folder .* hydra\.sweep\.dir=x",
    "explore  scene=homogeneous  explore.port=-1": "port: -1; must be an integer >= 0",
    "explore  scene=homogeneous  +explore.other=1": "explore: unknown key 'other'",
    "explore  scene=homogeneous  explore.drive=missing.npz": ".*missing.npz: there is no such file",
    "explore  scene=homogeneous  explore.trial=missing": "trial: 'missing'; must be the folder of a trial",
    "explore  scene=homogeneous  method=lssg": "method=lssg: has no effect on explore",
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_command_gets_one_line(words, refused, write, monkeypatch):
    monkeypatch.setattr(
        autdtorch.study.run_study, "_run_scene", lambda *_: pytest.fail("simulated too early")
    )
    write("file", "")
    line = refused(*words.split("  "))
    assert re.match(rf"autdtorch: {WRONG[words]}", line), line


@pytest.mark.parametrize("launcher", ["slurm", "joblib", "submitit_local"])
def test_a_launcher_that_is_not_installed_names_its_extra(launcher, refused, monkeypatch):
    monkeypatch.setattr(autdtorch.cli.arguments, "find_spec", lambda _: None)
    line = refused("-m", "scene=homogeneous", f"hydra/launcher={launcher}")
    assert re.match(rf"autdtorch: hydra/launcher: '{launcher}'; needs the extra cluster: pip install", line)


def test_the_traceback_comes_back_where_it_is_asked_for(run, refused, monkeypatch):
    assert refused("seed=-1") == "autdtorch: seed: -1; must be an integer >= 0"
    assert "HYDRA_FULL_ERROR" not in os.environ
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(ValueError, match=r"^seed: -1; must be an integer >= 0$"):
        run("seed=-1")
    assert os.environ["HYDRA_FULL_ERROR"] == "1"


def test_a_scene_that_is_not_yaml_is_named_with_its_line(refused, write):
    write("mine/scene/duct.yaml", "frequency: 40e3\n\tarray: {}\n")
    line = refused("--config-dir", "mine", "scene=duct")
    assert re.match(r"autdtorch: mine/scene/duct\.yaml, line 2: .*must be valid YAML", line)


OWN_METHODS = """
def greedy(objective, steps, trials, seed): ...
def broken(objective): return objective.missing
def empty(objective): ...
"""
BAD_METHODS = {
    "greedy": (2, "autdtorch: method: 'mine.greedy'; missing a required argument: 'steps'; must take an obj"),
    "broken": (1, r"autdtorch: AttributeError: .* 'missing' \(mine.py, line 3, in broken\); HYDRA_FULL_ERR"),
    "empty": (2, "autdtorch: method empty: None; must return a Solution"),
}


def test_an_error_of_ones_own_method_is_one_line(run, write, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    write("mine.py", OWN_METHODS)
    for name, (status, message) in BAD_METHODS.items():
        write("here/method/bad.yaml", f"_target_: mine.{name}\n")
        assert run("--config-dir", "here", "method=bad", "modules=mine") == status
        assert re.match(message, capsys.readouterr().err.splitlines()[-1])


BAD_MODULES = {
    "unfinished": ("def search(objective:\n", "SyntaxError: '\\(' was never closed"),
    "divides": ("1 / 0\n", "ZeroDivisionError: division by zero"),
    "long": ("raise ValueError('two\\nlines')\n", "ValueError: two lines"),
    "ends": ("raise SystemExit(1)\n", "SystemExit: 1"),
    "imports": ("import nothing_such\n", "ModuleNotFoundError: No module named 'nothing_such'"),
}


def test_a_module_that_cannot_be_imported_is_named_with_the_reason(refused, write):
    for name, (content, reason) in BAD_MODULES.items():
        write(f"{name}.py", content)
        line = refused(f"method._target_={name}.search", f"modules={name}")
        message = rf"autdtorch: method\._target_: '{name}\.search'; {name} cannot be imported \({reason}"
        assert re.match(message, line)


@pytest.mark.parametrize(("setting", "status"), [("scene=typo", 2), ("--version", 0)])
def test_a_process_ends_with_its_status_and_all_that_it_wrote(setting, status, tmp_path):
    """Also where PyTorch's library is still loading."""
    command = [sys.executable, "-m", "autdtorch", setting]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == status
    assert len(f"{done.stdout}{done.stderr}".splitlines()) == 1


@pytest.mark.skipif(os.name == "nt", reason="a pipe without a reader is another error there")
@pytest.mark.parametrize("option", ["--help", "--version"])  # more than a buffer, and less
def test_a_reader_of_the_output_that_has_ended_is_no_error(option):
    reads, writes = os.pipe()
    os.close(reads)
    command = [sys.executable, "-m", "autdtorch", option]
    ended = subprocess.run(command, stdout=writes, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writes)
    assert (ended.returncode, ended.stderr) == (141, "")
