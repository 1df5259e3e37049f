"""Every command and every block of Python in README and the documentation runs, or a rule says why not.

The commands of a page run in their order in one folder, a copy of what a clone holds, and so do its blocks of
Python. Bash reads the commands; `autdtorch` and Python then run in this process, which has imported PyTorch.
Cells of notebooks run in test_pages.py.
"""

import contextlib
import functools
import importlib
import io
import itertools
import logging
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import matplotlib
import pytest
from doc_pages import (
    EMULATED,
    IN_BLOCKS,
    LISTED,
    MENTIONED,
    PAGES,
    PYTHON,
    ROOT,
    environment,
    furnish,
    text_of,
)
from packaging.requirements import Requirement

import autdtorch
from autdtorch import hardware
from autdtorch.cli import main as command_line
from autdtorch.propagators import CACHE_VARIABLE

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))


def run(command, folder):
    settings = {"cwd": folder, "env": environment(folder), "capture_output": True, "text": True}
    return subprocess.run(command, **settings, input="\n")


# --- rules


def words_of(command, extra, folder):
    """Return the words that bash makes of a command, with its variables."""
    read = run(["bash", "-ec", f"{command.variables}printf '%s\\0' {command.text} {extra}"], folder)
    assert read.returncode == 0, read.stderr
    return read.stdout.split("\0")[:-1]


def runs(extra=""):
    """The command runs, with `extra` settings that make it shorter."""

    def rule(command, folder):
        program, *arguments = words_of(command, extra, folder)
        with here(folder) as patch:
            if program == "autdtorch":
                patch.setattr(sys, "argv", [program, *arguments])
                status = ending(command_line.main)
            elif arguments[0] == "-c":
                status = ending(exec, arguments[1], {})
            else:
                patch.setattr(sys, "argv", arguments)
                status = ending(runpy.run_path, arguments[0], run_name="__main__")
        assert status == 0

    return rule


def starts(command, folder):
    """The command runs in a process of its own, as a user's does."""
    done = run(["bash", "-ec", command.text], folder)
    assert done.returncode == 0, done.stdout + done.stderr


@contextlib.contextmanager
def here(folder):
    """Be in the folder as a new process is, in front of someone who presses Enter; undo all at the end."""
    root, package = logging.getLogger(), logging.getLogger("autdtorch")
    handlers, levels, modules = root.handlers[:], (root.level, package.level), set(sys.modules)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [str(folder), *sys.path])
        patch.setattr(sys, "stdin", io.StringIO("\n"))
        patch.delenv("HYDRA_FULL_ERROR", raising=False)
        yield patch
    root.handlers[:] = handlers  # Hydra's write to the stderr of this test
    root.setLevel(levels[0])
    package.setLevel(levels[1])
    for name in set(sys.modules) - modules:
        if Path(getattr(sys.modules[name], "__file__", None) or "").parent == folder:
            del sys.modules[name]


def ending(function, *arguments, **keywords):
    """Return the status with which a program ends."""
    try:
        function(*arguments, **keywords)
    except SystemExit as end:
        return end.code or 0
    return 0


def parses(command, folder):
    """The script exists and accepts the arguments; it would run for minutes to hours."""
    from shared import runner

    _, script, *arguments = shlex.split(command.text)
    names = {"benchmark": "benchmarks", "study": "studies", "check": "checks"}
    package = names[Path(script).stem]
    assert (ROOT / script).is_file()
    assert arguments[0] in runner.commands(package)
    source = (ROOT / "scripts" / package / f"{arguments[0]}.py").read_text("utf-8")
    if "autdtorch[crosscheck]" in source:  # may not be installed, and a page that names it says so
        assert "crosscheck" in text_of(command.page)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [Path(script).name, *arguments])
        try:
            module = importlib.import_module(f"{package}.{arguments[0]}")
        except ModuleNotFoundError:
            if "autdtorch[crosscheck]" not in source:
                raise
            return
        patch.setattr(module, "main", lambda **options: 0)
        assert runner.run(package, "") == 0


def installs(command, folder):
    """Files, extras and pins exist; CI installs the package by `make test`."""
    arguments = shlex.split(command.text)[2:]
    pins = {pin.name: pin for pin in map(Requirement, pinned_lines())}
    for option, value in itertools.pairwise(arguments):
        assert option != "-c" or (ROOT / value).is_file()
    for argument in arguments:
        if argument.startswith("."):
            extras = Requirement(f"autdtorch{argument[1:]}").extras
            assert extras <= set(PROJECT["project"]["optional-dependencies"])
        elif "==" in argument:
            wanted = Requirement(argument)
            assert wanted.specifier == pins[wanted.name].specifier


def pinned_lines():
    lines = text_of("constraints.txt").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def makes(command, folder):
    """`make` knows the target and its variables; CI runs those that test and `make lint`."""
    program, *arguments = shlex.split(command.text)
    done = run([program, "-n", *arguments], folder)
    assert done.returncode == 0, done.stderr


def selects(command, folder):
    """The files and the marker exist; the tests run in this suite."""
    arguments = iter(shlex.split(command.text)[1:])
    markers = {marker.partition(":")[0] for marker in PROJECT["tool"]["pytest"]["ini_options"]["markers"]}
    for argument in arguments:
        if argument == "-m":
            assert next(arguments) in markers
        else:
            assert (ROOT / argument).exists()


def substituted(command, folder):
    """Only the part in $(...) runs: the rest needs root. It prints the name of a file."""
    inner = re.search(r"\$\((.*)\)", command.text)
    done = run(["bash", "-ec", inner[1]], folder)
    assert Path(done.stdout.strip()).is_file(), done.stderr


def covered_by(path, name):
    """Another test runs the command."""

    def rule(command, folder):
        assert f"def {name}(" in text_of(path)

    return rule


def launches(command, folder):
    """Hydra finds the launcher and prints its settings; tests/cli/test_slurm.py runs sweeps on Slurm."""
    one_job = re.sub(r"(=\w+),\w+", r"\1", command.text.replace(" -m ", " "))
    runs("--cfg hydra")(command._replace(text=one_job), folder)


def lives(command, folder):
    """The live view prints its address, and SIGTERM ends it (a job in the background ignores SIGINT)."""
    from autdtorch.plot.view3d import rendering_problem

    if problem := rendering_problem():
        pytest.skip(problem)
    words = [*shlex.split(command.text), "explore.browser=false", COARSE]
    pipe = {"stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, cwd=folder, env=environment(folder), **pipe) as live:
        try:
            assert live.stdout.readline().startswith("The live view is at http://127.0.0.1:")
            live.terminate()
            assert live.wait(timeout=120) == 0
        finally:
            live.kill()  # no effect once it has ended


def left_out(reason):
    """The command cannot run in a test."""

    def rule(command, folder):
        assert reason

    return rule


COARSE = "solver.spacing=2.8e-3"  # a third of a wavelength
SHORT = f"trials=1 {COARSE} plane_spacing=4e-3"
RULES = [
    (r"pip install ", installs),
    (r"make ", makes),
    (r"pytest ", selects),
    (r"python scripts/(benchmark|study|check)\.py ", parses),
    (r"python3 -m venv ", left_out("makes an environment, as `make test` does")),
    (r"sudo cp ", substituted),
    (r"sudo udevadm ", left_out("needs root, and a device")),
    (r"jupyter lab ", left_out("waits for a browser")),
    (r"jupytext ", covered_by("tests/docs/test_pages.py", "test_jupytext_executes_a_page")),
    (r"autdtorch explore\b", lives),
    (r"ssh ", left_out("needs another machine")),
    (r"autdtorch .*hydra/launcher=mine", launches),
    (r"python scripts/hardware_trial.py \$bench method=identify", runs(f"hardware.emulated=true {COARSE}")),
    (
        r"python scripts/hardware_trial.py \$bench",
        runs(f"hardware.emulated=true method=gabs method.levels=2 method.passes=1 {COARSE}"),
    ),
    (r"autdtorch hardware=emulated|python scripts/hardware_trial.py ", runs(COARSE)),
    (r"autdtorch .*poses=", runs(f"{COARSE} poses.count=3")),
    (r"autdtorch --help", starts),
    (r"autdtorch collect ", runs()),
    (
        r"autdtorch calibrate ",
        covered_by("tests/cli/test_calibrate_command.py", "test_a_scene_is_calibrated"),
    ),
    (r"autdtorch play ", runs(f"{COARSE} play.seconds=0.1")),
    (r"autdtorch ", runs(SHORT)),
    (r"python -c ", runs()),
]


def follow(command, folder):
    for pattern, rule in RULES:
        if re.match(pattern, command.text):
            return rule(command, folder)
    pytest.fail(f"{command.page}: no rule says how to test {command.text!r}")


def program(page, folder):
    """Run the Python of a page in this process; a live view that it leaves is closed."""
    code = PYTHON[page]
    if "view3d" in code or "explore" in code:
        from autdtorch.plot.view3d import rendering_problem

        if problem := rendering_problem():
            pytest.skip(problem)
    if page == "docs/hardware.md":
        code = EMULATED + code
    with here(folder) as patch, matplotlib.rc_context({"backend": "Agg"}):
        for name in ("open_link", "open_scope", "FileSensor"):  # to be undone
            patch.setattr(hardware, name, getattr(hardware, name))
        for name in ("explore", "make_propagator"):  # as coarse as commands, unless the page says otherwise
            patch.setattr(autdtorch, name, functools.partial(getattr(autdtorch, name), spacing=2.8e-3))
        names = {"__name__": "__main__"}
        exec(compile(code, f"{page} as Python", "exec"), names)
        if "live" in names:
            names["live"].close()


# --- tests


@pytest.fixture
def matrices(tmp_path_factory, monkeypatch):
    """A folder of matrices that all pages share: several show the same scenes."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path_factory.getbasetemp() / "matrices"))


@pytest.mark.usefixtures("undrawn", "matrices")
@pytest.mark.parametrize("page", [page for page in PAGES if LISTED[page] or PYTHON[page]])
def test_a_page_runs(page, tmp_path):
    furnish(tmp_path)
    for command in LISTED[page]:
        assert "..." not in command.text, "is no command"
        follow(command, tmp_path)
    if PYTHON[page]:
        program(page, tmp_path)


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    """A folder for commands that write nothing."""
    folder = tmp_path_factory.mktemp("clone")
    furnish(folder)
    return folder


@pytest.mark.parametrize("command", MENTIONED, ids=lambda command: f"{command.page}: {command.text}")
def test_commands_in_the_text_are_accepted(command, clone):
    follow(command, clone)


def test_every_rule_is_needed():
    texts = [*IN_BLOCKS, *(command.text for command in MENTIONED)]
    for pattern, _ in RULES:
        assert any(re.match(pattern, text) for text in texts), pattern
