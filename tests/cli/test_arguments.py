"""Arguments and output as shells, terminals and users have them."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize("name", ["für_andré", "結果", "a'b", "a#b", "with space", "a\\'b"])
def test_a_folder_may_have_any_name(run, tmp_path, name):
    assert run("scene=homogeneous", "plane_spacing=0.02", "method=lss", f"output={name}") == 0
    assert (tmp_path / name / "results.h5").exists()


def test_a_home_folder_is_found(run, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("USERPROFILE", str(tmp_path / "home"))
    assert run("scene=homogeneous", "plane_spacing=0.02", "method=lss", "output=~/x") == 0
    assert (tmp_path / "home" / "x" / "results.h5").exists()


@pytest.mark.parametrize("encoding", ["ascii", "cp932"])
def test_output_in_any_encoding_ends_no_study(tmp_path, encoding):
    command = [sys.executable, "-m", "autdtorch", "scene=homogeneous", "plane_spacing=0.02", "method=lss"]
    settings = os.environ | {"PYTHONIOENCODING": encoding}
    ended = subprocess.run(command, cwd=tmp_path, env=settings, capture_output=True, check=False)
    assert ended.returncode == 0, ended.stderr
