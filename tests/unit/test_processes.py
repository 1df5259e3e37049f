"""Other processes simulate and search as this one does, forked ones included, and find the same."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[1] / "in_processes.py"


@pytest.mark.skipif(sys.platform != "linux", reason="forks, which is safe with threads on Linux alone")
@pytest.mark.parametrize("kind", ["fork", "dataloader", "spawn", "loky"])
def test_processes_of_all_kinds_find_the_same(kind: str) -> None:
    run = subprocess.run(
        [sys.executable, "-W", "error", str(PROGRAM), kind], capture_output=True, text=True, timeout=240
    )
    assert (run.returncode, run.stdout.strip()) == (0, "0"), run.stderr
