"""A folder of configs that somebody sent runs no function, reads no variable and writes nowhere else."""

import pickle
import sys
from pathlib import Path

import pytest

from autdtorch.cli.config_files import CONFIGS

SCENE = (CONFIGS / "scene" / "homogeneous.yaml").read_text(encoding="utf-8")
CALL = "{_target_: torch.load, f: evil.pt, weights_only: false}"
LINES = "_target_: torch.load\nf: evil.pt\nweights_only: false\n"
GLOBAL = "# @package _global_\n"
DEFAULT = ["/scene@scenes.x: homogeneous", "override /scene: null", "override /method: null"]
EXPERIMENT = f"{GLOBAL}defaults: [{', '.join(DEFAULT)}]\n"


class Touch:
    """When it is unpickled, it leaves the file `canary`."""

    def __reduce__(self):
        return Path.touch, (Path("canary"),)


@pytest.fixture
def send(write, tmp_path, monkeypatch):
    """Writes files below a folder `sent`; beside it are a pickle and a module that leave `canary`."""
    write("here/evil.py", "from pathlib import Path\nfrom torch import load\nPath('canary').touch()\n")
    (tmp_path / "here" / "evil.pt").write_bytes(pickle.dumps(Touch()))
    monkeypatch.setenv("SECRET", "hunter2")
    monkeypatch.delitem(sys.modules, "evil", raising=False)

    def send_all(files):
        monkeypatch.chdir(tmp_path / "here")  # after `run` has changed it
        for name, text in files.items():
            write(f"here/sent/{name}", text)

    return send_all


LAUGHS = "a0: &a0 [lol, lol]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 10)
)
HYDRA = {
    "callbacks": f"{{x: {CALL}}}",
    "launcher": f"{{x: {CALL}}}",
    "sweeper": f"{{x: {CALL}}}",
    "job_logging": "{version: 1, root: {}, filters: {x: {(): torch.load, f: evil.pt, weights_only: false}}}",
    "job": "{env_set: {PYTHONPATH: sent}}",
    "searchpath": "[sent/more]",
    "run": "{dir: ../elsewhere}",
}
DEFAULTS = (
    "/evil@hydra.callbacks: run",
    "/evil@_global_.hydra.callbacks: run",
    "optional /evil@hydra.callbacks: [run]",
    "/evil/run@hydra.callbacks",
    "override /hydra/launcher: joblib",
    "/hydra/launcher/joblib",
    "/evil@${x}.callbacks: run",
    "override /scene: ../../evil/run",
)


def scene(name):
    return SCENE.replace("name: homogeneous", f"name: {name}")


#: By folder of the file that is sent: its text, and the key that the one line names.
ATTACKS = {
    "method": [
        (LINES, "method._target_"),
        (f"_target_: autdtorch.lssg\nlevels: {CALL}\n", "method.levels._target_"),
        (f"_target_: autdtorch.lssg\nextra: [{CALL}]\n", "method.extra.0._target_"),
        ("_target_: autdtorch.lssg\n_partial_: false\n", "method._partial_"),
        ("_target_: autdtorch.load_results\n", "method._target_"),
        ("_target_: evil.load\nf: evil.pt\n", "method._target_"),
        ("_target_: autdtorch.lssg\nlevels: ${oc.decode:'4'}\n", "levels"),
    ],
    "scene": [
        (f"{SCENE}extra: {CALL}\n", "scene.extra._target_"),
        (SCENE.replace("obstacles: []", f"obstacles: [{CALL}]"), "obstacles[0]._target_"),
        *((f"{GLOBAL}hydra: {{{key}: {value}}}\n", "hydra") for key, value in HYDRA.items()),
        *((f"{GLOBAL}defaults:\n  - {entry}\n", "defaults") for entry in DEFAULTS),
        (f"# @package hydra.callbacks\nx: {CALL}\n", "@package hydra.callbacks"),
        (f"# @package _global_.hydra.callbacks\nx: {CALL}\n", "@package _global_.hydra"),
        (scene("${oc.env:SECRET}"), "name"),
        (scene(r"\${oc.env:SECRET}"), "name"),
        (scene("${scene.dollar}{oc.env:SECRET}\ndollar: $"), "name"),
        ("x: !!python/object/apply:pathlib.Path.touch [canary]\n", "line 1"),
        (SCENE + LAUGHS, "line"),
    ],
    "solver": [
        (f"spacing: {CALL}\n", "solver.spacing._target_"),
        ("cache: ../elsewhere\n", "solver.cache"),
        ("cache: /proc/elsewhere\n", "solver.cache"),
    ],
    "experiment": [
        (f"{EXPERIMENT}methods: {{x: {CALL}}}\n", "methods.x._target_"),
        (f"{EXPERIMENT}methods: {{x: {{levels: {CALL}}}}}\n", "methods.x.levels._target_"),
        (f"{GLOBAL}modules: [evil]\nmethod: {{_target_: evil.load}}\n", "modules"),
        (f"{GLOBAL}output: ../elsewhere\n", "output"),
        (f"{GLOBAL}output: /proc/elsewhere\n", "output"),
        (f"{GLOBAL}output: .\n", "output"),
    ],
}
CASES = [(group, text, key) for group, cases in ATTACKS.items() for text, key in cases]


@pytest.mark.parametrize(("group", "text", "key"), CASES, ids=[f"{group} {key}" for group, _, key in CASES])
def test_an_attack_by_a_config_ends_in_one_line(group, text, key, refused, send, tmp_path):
    send({f"{group}/x.yaml": text, "evil/run.yaml": f"x: {CALL}\n"})
    before = set(tmp_path.rglob("*"))
    line = refused("--config-dir", "sent", f"{group}=x", "plane_spacing=0.02")
    assert key in line
    assert len(line) < 600
    assert "hunter2" not in line
    assert set(tmp_path.rglob("*")) == before  # no canary, nothing elsewhere


def test_a_primary_config_sets_nothing_of_hydras(refused, send, tmp_path):
    send({"x.yaml": f"hydra: {{callbacks: {{x: {CALL}}}}}\n"})
    assert "x.yaml: hydra" in refused("--config-dir", "sent", "--config-name", "x")
    assert not list(tmp_path.rglob("canary"))


def test_a_name_that_goes_up_does_not_move_the_output(refused, send):
    send({"x.yaml": SCENE})
    assert "output: 'outputs/../x_gabs'" in refused(
        "--config-dir", "sent", "scene=../x", "plane_spacing=0.02"
    )


def test_what_hydra_is_made_of_is_not_taken_from_a_folder_of_configs(run, send, tmp_path):
    """Hydra looks there before it asks its plugins for what they are called."""
    groups = ("config", "launcher/basic", "launcher/joblib", "sweeper/basic", "job_logging/stdout")
    send({f"hydra/{group}.yaml": f"{GLOBAL}hydra: {{callbacks: {{x: {CALL}}}}}\n" for group in groups})
    assert run("--config-dir", "sent", "-m", "method=lssg", "plane_spacing=0.02") == 0
    assert not list(tmp_path.rglob("canary"))


def test_a_launcher_of_ones_own_comes_from_a_folder_that_is_trusted(run, send):
    send({"hydra/launcher/mine.yaml": "defaults: [basic]\n"})
    command = ("-m", "hydra/launcher=mine", "method=lssg", "plane_spacing=0.02")
    assert run("--config-dir", "sent", *command) == 2
    assert run(*command, "hydra.searchpath=[sent]") == 0


@pytest.mark.parametrize("target", ["reaching.load", "reaching.torch", "reaching.no", "reaching.torch.load"])
def test_of_a_trusted_module_only_its_own_functions_are_methods(target, refused, send, write, tmp_path):
    write("here/reaching.py", "import torch\nfrom torch import load\n")
    send({"method/x.yaml": LINES.replace("torch.load", target)})
    line = refused("--config-dir", "sent", "method=x", "modules=[reaching, evil]")
    assert f"method._target_: '{target}'" in line
    assert not list(tmp_path.rglob("canary"))  # nor is a module imported that no method needs


def test_the_command_line_may_name_any_folder(run, tmp_path):
    command = ("method=lssg", "plane_spacing=0.02", f"output={tmp_path / 'out'}")
    assert run(*command, f"solver.cache={tmp_path / 'cache'}") == 0
    assert (tmp_path / "out" / "results.h5").is_file()
