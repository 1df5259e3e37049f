"""Arguments and output as shells, terminals and users have them."""

import io
import os
import subprocess
import sys

import pytest

from autdtorch.cli.arguments import settings_first


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
def test_output_in_any_encoding_ends_no_study(run, monkeypatch, encoding):
    streams = {name: io.TextIOWrapper(io.BytesIO(), encoding=encoding) for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, stream)
    assert run("scene=homogeneous", "plane_spacing=0.02", "method=lss") == 0
    streams["stdout"].flush()
    assert b"area [mm" in streams["stdout"].buffer.getvalue()


WITHOUT_STREAMS = """
import os, sys
from pathlib import Path
from autdtorch.cli.arguments import prepare_streams
prepare_streams()
with open("data", "wb") as file:  # its number is none of those that libraries write errors to
    print("lost")
    print("lost", file=sys.stderr, flush=True)
    os.write(2, b"lost")
    Path("numbers").write_text(f"{file.fileno()} {os.path.getsize('data')}")
"""


@pytest.mark.skipif(os.name != "posix", reason="a shell that closes the streams")
@pytest.mark.parametrize("closed", ["2>&-", "0<&- 1>&- 2>&-"])
def test_without_standard_streams_output_leads_nowhere(tmp_path, closed):
    command = f'exec "$0" -c "$1" {closed}'
    subprocess.run(["sh", "-c", command, sys.executable, WITHOUT_STREAMS], cwd=tmp_path, check=True)
    number, size = map(int, (tmp_path / "numbers").read_text().split())
    assert number > 2
    assert size == 0


def test_a_program_without_a_console_runs(run, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert run("scene=homogeneous", "plane_spacing=0.02", "method=lss", "output=made") == 0
    assert (tmp_path / "made" / "results.h5").exists()
    assert run("scene=none_such") == 2
    for made in (sys.stdout, sys.stderr):
        made.close()


def test_settings_may_follow_options():
    words = ["scene=bench", "--config-dir", "my bench", "readings=a.csv", "-m", "--cfg=job", "seed=1"]
    settings = ["scene=bench", "readings=a.csv", "seed=1"]
    assert settings_first(words) == [*settings, "--config-dir", "my bench", "-m", "--cfg=job"]
