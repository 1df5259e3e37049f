"""Fixtures that run the command line in this process: a subprocess would have to import PyTorch each time."""

import copy
import functools
import logging
import sys
from pathlib import Path

import pytest

from autdtorch.cli import config_files
from autdtorch.cli.config_files import CONFIGS
from autdtorch.cli.main import main
from autdtorch.io.yaml_file import load_yaml


@pytest.fixture(autouse=True, scope="session")
def configs_parsed_once():
    """Keep our parsed configs, which Hydra reads in each run."""
    parsed = functools.cache(load_yaml)

    def load(path):
        absolute = Path(path).resolve()
        return copy.deepcopy(parsed(absolute)) if absolute.is_relative_to(CONFIGS) else load_yaml(path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config_files, "load_yaml", load)
        yield


@pytest.fixture
def run(tmp_path, monkeypatch, request):
    """Runs a command line in an empty folder; returns its exit status. With `drawn`, figures are drawn."""
    if "drawn" not in request.fixturenames:
        request.getfixturevalue("undrawn")
    root, package = logging.getLogger(), logging.getLogger("autdtorch")
    handlers, levels = root.handlers[:], (root.level, package.level)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(sys, "path", sys.path[:])  # the command adds the working directory

    def command(*arguments):
        monkeypatch.setattr(sys, "argv", ["autdtorch", *arguments])
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    yield command
    if "joblib" in sys.modules:  # else the next test would get workers in the folder of this one
        from joblib.externals.loky import get_reusable_executor

        get_reusable_executor().shutdown(kill_workers=True)
    # Hydra's logging writes to the stderr of this test alone.
    root.handlers[:] = handlers
    root.setLevel(levels[0])
    package.setLevel(levels[1])


@pytest.fixture
def drawn():
    """Has figures drawn."""


@pytest.fixture
def refused(run, capsys):
    """Runs a command line that is refused; returns the one line of its error."""

    def command(*arguments):
        capsys.readouterr()
        assert run(*arguments) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        (line,) = captured.err.splitlines()
        return line

    return command


@pytest.fixture
def write(tmp_path):
    """Writes a text file below the folder of the test."""

    def text_file(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    return text_file


SCENE = """
name: two
frequency: 40e3
medium: {density: 1.2, sound_speed: 340.0}
array: {type: grid, shape: [3, 3], pitch: 10.5e-3, center: [0, 0, 0], normal: [1, 0, 0]}
control_points: {type: points, positions: [[80e-3, 10e-3, 0.0], [80e-3, -20e-3, 5e-3]]}
"""


@pytest.fixture
def trial(run, write, tmp_path, capsys):
    """Runs a trial in that scene; returns its status, and what it printed on stdout and stderr."""
    write("ours/scene/two.yaml", SCENE)

    def command(*words, folder="output=out"):
        capsys.readouterr()
        status = run("--config-dir", str(tmp_path / "ours"), "scene=two", folder, *words)
        return status, *capsys.readouterr()

    return command
