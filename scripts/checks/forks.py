"""Forks beside running simulations, whose children simulate too: none may hang.

Two threads simulate all the time; at some of the forks they compile the kernels. Each forked process must get
the numbers of its parent. One that takes too long prints where it waits.
"""

import faulthandler
import os
import random
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from typing import BinaryIO

import autdtorch as at

_LONGEST = 60.0  # of a simulation in a child [s]; it takes one, and may compile the kernels, 20 s
_BETWEEN = 0.3  # longest time between forks [s]


OPTIONS = {
    "--forks": {"type": int, "default": 60, "help": "number of forked processes"},
    "--seed": {"type": int, "default": 0, "help": "seed of the moments"},
}


def main(forks: int, seed: int) -> int:
    if not hasattr(os, "fork"):
        sys.exit("this system does not fork")
    warnings.filterwarnings("ignore", ".*multi-threaded", DeprecationWarning)  # of a fork, since Python 3.12
    wrong = check(forks, seed)
    print(*wrong, f"{forks} forks, {len(wrong)} problems", sep="\n")
    return int(bool(wrong))


def simulated() -> list[float]:
    """Return numbers of a simulation in boxes, of a T-matrix, and of a method."""
    array = at.TransducerArray.grid((2, 2), pitch=8e-3, center=(1.2e-3, 12e-3, 12e-3))
    ball = at.Sphere((12e-3, 12e-3, 12e-3), 3e-3, rigid=True)
    points = [[22.3e-3, 7.4e-3, 14.4e-3], [19.9e-3, 16.8e-3, 12.5e-3]]
    scene = at.Scene(array, at.Medium(1.2, 343.0), 40e3, points, (ball,), domain=((0, 0, 0), (24e-3,) * 3))
    numbers = []
    for method in ("box", "tmatrix"):
        objective = at.SimulatedObjective(scene, at.make_propagator(scene, method, 2e-3, cache=False))
        assert objective.transfer_matrix is not None
        solution = at.gabs(objective, trials=4, seed=0)
        numbers += [objective.transfer_matrix.abs().sum().item(), solution.score.sum().item()]
    return numbers


def child(work: Callable[[], bool], said: BinaryIO) -> int:
    """Fork a process that ends with 0 if `work` is true; return its id."""
    number = os.fork()
    if number:
        return number
    status = 1
    faulthandler.dump_traceback_later(_LONGEST, exit=True, file=said)
    try:
        status = 0 if work() else 2
    except BaseException:
        said.write(traceback.format_exc().encode())
        said.flush()
    os._exit(status)


def check(forks: int, seed: int) -> list[str]:
    """Fork beside simulations, and return a text for each child that hung, failed or got other numbers."""
    rng = random.Random(seed)
    expected, end = simulated(), threading.Event()

    def simulate_on() -> None:
        while not end.is_set():
            simulated()

    threads = [threading.Thread(target=simulate_on, daemon=True) for _ in range(2)]
    for thread in threads:
        thread.start()
    wrong = []
    for number in range(forks):
        time.sleep(rng.uniform(0, _BETWEEN))
        with tempfile.TemporaryFile() as said:
            _, status = os.waitpid(child(lambda: simulated() == expected, said), 0)
            if status:
                said.seek(0)
                text = said.read().decode()
                wrong.append(f"fork {number}: status {os.waitstatus_to_exitcode(status)}\n{text}")
    end.set()
    for thread in threads:
        thread.join()
    return wrong
