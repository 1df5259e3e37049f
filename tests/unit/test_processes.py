"""Other processes simulate and search as this one does, forked ones included, and find the same."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[1] / "in_processes.py"


KINDS = ["fork", "dataloader", "spawn", "loky"]


@pytest.mark.skipif(sys.platform != "linux", reason="forks, which is safe with threads on Linux alone")
def test_processes_of_all_kinds_find_the_same() -> None:
    command = [sys.executable, "-W", "error", str(PROGRAM), *KINDS]
    run = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert (run.returncode, run.stdout.splitlines()) == (0, [f"{kind} 0" for kind in KINDS]), run.stderr
