"""The commands of `scripts/`, and their blocks in the documentation."""

import contextlib
import importlib
import os
import re
import subprocess
import sys
from typing import Any

import pytest
from checks.damage import check
from shared.document import DOCS, with_block
from shared.runner import SCRIPTS, commands, run

FOLDERS = {"benchmark": "benchmarks", "check": "checks", "study": "studies"}
PATHS = os.pathsep.join((str(SCRIPTS), str(SCRIPTS.parent)))
OUTPUT: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 120}


@pytest.mark.parametrize("script", FOLDERS)
def test_every_command_has_a_summary_and_its_block_in_the_documentation(script: str) -> None:
    summaries = commands(FOLDERS[script])
    assert summaries
    for name, summary in summaries.items():
        assert summary.endswith(".")
        source = (SCRIPTS / FOLDERS[script] / f"{name}.py").read_text(encoding="utf-8")
        for document in re.findall(r'^DOCUMENT = "(.+)"', source, re.MULTILINE):
            with_block((DOCS / document).read_text(encoding="utf-8"), f"{script}.py {name}", "")


@pytest.mark.parametrize("folder", FOLDERS.values())
def test_the_help_of_every_command_is_printed_and_nothing_is_started(
    folder: str, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in commands(folder):
        with contextlib.suppress(ModuleNotFoundError):  # of an extra; there is a help without its options
            module = importlib.import_module(f"{folder}.{name}")
            monkeypatch.setattr(module, "main", lambda **_: pytest.fail("the work was started"))
        for flag in ("--help", "-h"):
            monkeypatch.setattr(sys, "argv", [folder, name, flag])
            try:
                status = run(folder, "")
            except SystemExit as end:
                status = end.code
            assert status == 0, name
            assert capsys.readouterr().out.startswith("usage: ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("script", [*FOLDERS, "hardware_trial", "one_node_slurm"])
def test_the_help_of_a_script_is_printed_and_nothing_is_started(script: str, tmp_path) -> None:
    code = [sys.executable, SCRIPTS / f"{script}.py", "--help"]
    done = subprocess.run(code, cwd=tmp_path, env=os.environ | {"PYTHONPATH": PATHS}, **OUTPUT)
    assert done.returncode == 0, done.stderr
    source = (SCRIPTS / f"{script}.py").read_text(encoding="utf-8")
    assert source.partition('"""')[2].partition("\n")[0].removesuffix('"""') in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_command_without_its_package_is_refused_in_a_line(monkeypatch, capsys) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name}", name="acoustools")

    monkeypatch.setattr("shared.runner.importlib.import_module", missing)
    monkeypatch.setattr(sys, "argv", ["check.py", "bound"])
    with pytest.raises(SystemExit) as end:
        run("checks", "")
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("checks/bound.py needs acoustools, which is not installed")


def test_damaged_files_change_no_number_and_cost_no_undamaged_line(tmp_path) -> None:
    counts, wrong = check(damages=9, seed=1, folder=tmp_path)
    assert counts.total() == 9
    assert wrong == []
