"""Running the command line in this process: a subprocess would import PyTorch anew for each."""

import logging
import sys
from collections.abc import Callable

import pytest

from autdtorch.cli.main import main

Run = Callable[..., int]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs a command line in an empty folder; returns its exit status."""
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
