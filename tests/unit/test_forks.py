"""A process forked while another thread holds a lock does not wait for that thread."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from numba.core.compiler_lock import global_compiler_lock
from tqdm import tqdm
from tqdm.std import TqdmDefaultWriteLock

import autdtorch.utils.progress  # noqa: F401 - what this and the kernels name to `os.register_at_fork`
from autdtorch.fdtd import assembly, kernels
from autdtorch.utils import process
from autdtorch.utils.compiled import _digest
from autdtorch.utils.process import cached_property

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here"),
    pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning"),
]

PATIENCE = 60.0  # after which a child is held to hang [s]
HELD = 0.1  # time for which a thread holds a lock during a fork [s]


def status_of_child(work: Callable[[], object]) -> int | None:
    """Return the status of a forked process that ends with 0 after `work`; None for one that hangs."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return None


@contextmanager
def in_thread(work: Callable[[threading.Event, threading.Event], object]) -> Iterator[None]:
    """Run `work(begun, let_go)` in a thread, from when it is begun; the thread ends afterwards."""
    begun, let_go = threading.Event(), threading.Event()
    thread = threading.Thread(target=work, args=(begun, let_go))
    thread.start()
    assert begun.wait(PATIENCE)
    yield
    let_go.set()
    thread.join()


class Slow:
    def __init__(self, compute: Callable[[], object]) -> None:
        self.compute = compute

    @cached_property
    def value(self) -> Any:
        """A docstring."""
        return self.compute()


def test_a_child_computes_the_property_that_another_thread_was_computing() -> None:
    def work(begun: threading.Event, let_go: threading.Event) -> None:
        assert Slow(lambda: (begun.set(), let_go.wait(PATIENCE))).value

    with in_thread(work):
        assert status_of_child(lambda: Slow(lambda: 1).value) == 0


def test_a_cached_property_is_computed_once_also_by_threads_and_can_be_forgotten() -> None:
    calls = []
    slow = Slow(lambda: calls.append(1) or object())
    first = slow.value
    assert slow.value is first
    del slow.value
    assert slow.value is not first
    assert len(calls) == 2
    assert Slow.value.__doc__ == "A docstring."
    barrier = threading.Barrier(2, timeout=PATIENCE)
    slow = Slow(lambda: (barrier.wait(), object()))
    found: list[object] = []
    both = [threading.Thread(target=lambda: found.append(slow.value)) for _ in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert found[0] is found[1] is slow.value


def one_thread() -> None:
    with process.one_library_thread():
        pass


def bar_drawn() -> None:
    with tqdm.get_lock():
        pass


def kernel_compiled() -> None:
    with global_compiler_lock:
        pass


LOCKS = {
    "number of threads": (process._outside._lock, one_thread),
    "compiler": (global_compiler_lock, kernel_compiled),
}


@pytest.mark.parametrize("name", LOCKS)
def test_a_fork_waits_for_a_lock_whose_holder_ends(name: str) -> None:
    lock, use = LOCKS[name]

    def hold(begun: threading.Event, _: threading.Event) -> None:
        lock.acquire()
        begun.set()
        time.sleep(HELD)
        lock.release()

    with in_thread(hold):
        assert status_of_child(use) == 0
    use()  # the parent has it back


def test_a_child_draws_while_a_bar_is_drawn_in_its_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tqdm, "_lock", TqdmDefaultWriteLock(), raising=False)

    def draw(begun: threading.Event, let_go: threading.Event) -> None:
        with tqdm.get_lock():
            begun.set()
            let_go.wait(PATIENCE)

    with in_thread(draw):
        assert status_of_child(bar_drawn) == 0


def test_a_signal_that_comes_while_a_fork_waits_is_raised_after_it() -> None:
    def hold(begun: threading.Event, _: threading.Event) -> None:
        with global_compiler_lock:
            begun.set()
            time.sleep(HELD)
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            time.sleep(HELD)

    def fork() -> None:
        if os.fork() == 0:
            os._exit(0)
        time.sleep(PATIENCE)

    begin = time.monotonic()
    with in_thread(hold), pytest.raises(KeyboardInterrupt):
        fork()
    assert time.monotonic() - begin < PATIENCE  # the wait is interrupted
    assert status_of_child(kernel_compiled) == 0
    os.waitpid(-1, 0)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_lock_that_a_user_gave_tqdm_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    lock = threading.RLock()
    monkeypatch.setattr(tqdm, "_lock", lock, raising=False)

    def same() -> None:
        assert tqdm.get_lock() is lock

    assert status_of_child(same) == 0


PROGRAM = Path(__file__).parents[1] / "in_processes.py"


KINDS = ["fork", "dataloader", "loky"]


@pytest.mark.timeout(900)  # compiles all kernels, on a machine that may be busy
@pytest.mark.skipif(sys.platform != "linux", reason="forks, which is safe with threads on Linux alone")
def test_processes_of_all_kinds_get_the_results_of_the_one_that_compiled_the_kernels(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", str(PROGRAM), *KINDS]
    cold = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    run = subprocess.run(command, env=cold, capture_output=True, text=True, timeout=800)
    assert run.returncode == 0, run.stderr
    compiled, *different = run.stdout.splitlines()
    assert int(compiled.removeprefix("compiled ")) > 0
    assert different == [f"{kind} 0" for kind in KINDS]
    names = [path.name for path in tmp_path.rglob("*.nbi")]
    digests = {_digest(Path(folder.__file__).parent) for folder in (assembly, kernels)}
    assert {name.split("-")[0].rpartition("_")[2] for name in names} == digests
