"""Settings of all tests, and fixtures that several folders share.

A test has the marker named like its folder, so that ``pytest -m physics`` runs ``tests/physics``. `make test`
leaves out `docs`, `browser` and `processes`; the last is of files in several folders. Without a GPU, Triton
interprets the CUDA kernel on the CPU. Several processes of pytest share the cores: threads that wait for each
other on busy cores are many times slower.
"""

import gc
import os
import shutil
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest
import torch
from PIL import Image
from threadpoolctl import threadpool_limits

TESTS = Path(__file__).parent

gc.disable()  # until tests begin: what is imported and collected stays

# `nohup pytest &` in a script ignores signals that tests send, in this process and in those that it starts. A
# handler of Python ends that: processes begin with the default action, and this one survives a hang-up.
for name in ("SIGINT", "SIGQUIT", "SIGHUP"):
    number = getattr(signal, name, None)
    if number is not None and signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if name == "SIGINT" else lambda *_: None)

# An example may take long on a busy machine; pytest's limit stays. Each run draws the same examples, so that
# a failure is of the change; by `--hypothesis-profile=search` each draws others.
hypothesis.settings.register_profile("search", deadline=None, max_examples=10)
hypothesis.settings.register_profile("steady", hypothesis.settings.get_profile("search"), derandomize=True)
hypothesis.settings.load_profile("steady")

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when Triton's functions are defined

if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    THREADS = max(1, (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))
    torch.set_num_threads(THREADS)
    threadpool_limits(THREADS)  # of NumPy's BLAS, which is loaded, and spins while it waits
    os.environ["OMP_NUM_THREADS"] = str(THREADS)  # of the processes that tests start


@pytest.fixture(autouse=True)
def nothing_from_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the cache on disk of a user from all tests."""
    monkeypatch.delenv("AUTDTORCH_CACHE_DIR", raising=False)


@pytest.fixture(autouse=True)
def no_timer_left_running() -> Iterator[None]:
    """Cancel timers: outputs that a test leaves on would go off, with a warning, in the middle of another."""
    yield
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):
            thread.cancel()


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write figures as blank images: drawing one takes half a second."""
    blank = Image.new("RGB", (2, 1))
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda _, file: blank.save(file, "png"))


@pytest.fixture
def set_threads() -> Iterator[Any]:
    """Set the number of PyTorch's threads, which afterwards is what it was."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.hookimpl(optionalhook=True)  # pytest may run without xdist
def pytest_xdist_auto_num_workers() -> int:
    """Return one process more than cores, as a tenth of the time is spent in waiting."""
    return (os.cpu_count() or 1) + 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        item.add_marker(item.path.relative_to(TESTS).parts[0])


def pytest_collection_finish() -> None:
    """Collect garbage from now on, but seldom, and look no more at what is there: a tenth of the time."""
    gc.freeze()
    gc.set_threshold(50_000)  # new objects; 700 by default
    gc.enable()


# For Chromium: CI runs as root, and the network is closed.
SWITCHES = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A headless Chromium, by Playwright."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright: install autdtorch[dev]")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium: on Debian, install the package chromium")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=program, args=SWITCHES)
        yield chromium
        chromium.close()
