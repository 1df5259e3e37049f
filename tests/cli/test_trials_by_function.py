"""Hardware trials whose method is a function of the user."""

import re
import sys

import pytest

from autdtorch.io.readings_file import load_readings

EMULATED = ("hardware=emulated", "hardware.limits.amplitude=1")

FUNCTIONS = """
import autdtorch as at
from dataclasses import replace

def tensor(objective): return at.gabs(objective, levels=4).drive
def few(objective): return replace(s := at.gabs(objective, levels=4), drive=s.drive[:, :5])
def loud(objective): return replace(s := at.gabs(objective, levels=4), drive=2 * s.drive)
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tensor", "method tensor: .*; must return a Solution"),
        ("few", "method few: drive: shape"),
        ("loud", "method loud: drive.*amplitude"),
    ],
)
def test_a_function_without_a_solution_plays_nothing(trial, write, tmp_path, monkeypatch, name, message):
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    write("mine.py", FUNCTIONS)
    write("ours/method/own.yaml", f"_target_: mine.{name}\n")
    status, _, log = trial(*EMULATED, "method=own", "modules=mine")
    assert status == 2
    assert re.search(message, log)
    assert not (tmp_path / "out").exists()


def test_a_function_with_two_searches_goes_on_where_its_log_ends(trial, write, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "twofold", raising=False)
    search = "def search(o): return [at.gabs(o, levels=2), at.lssg(o, levels=4)][1]"
    write("twofold.py", f"import autdtorch as at\n{search}\n")
    write("ours/method/twofold.yaml", "_target_: twofold.search\n")
    words = *EMULATED, "method=twofold", "modules=twofold"
    assert trial(*words, "hardware.limits.evaluations=20")[0] == 3
    status, _, log = trial(*words)
    assert (status, "going on after 20 evaluations" in log) == (0, True)
    readings = load_readings(tmp_path / "out")
    assert trial(*words)[0] == 0
    assert len(load_readings(tmp_path / "out")) == len(readings) == (1 + 8 * 2) + 2 * 4
