"""Times of transfer matrices beside busy processes, by default and on one thread.

Each figure is the median over processes that take turns, so that all see the machine in one state. A process
simulates each scene several times; the median counts. Takes about five minutes on 2 cores.
"""

import contextlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from shared.scenes import ROOT

ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}

CHILD = """
import json, logging, statistics, sys, time
import autdtorch as at
logging.disable()
folder, repeats = sys.argv[1], int(sys.argv[2])
paper = at.load_scene(f"{folder}/two_cubes.yaml")
array = at.TransducerArray.autd3(center=(0, 50e-3, 50e-3), normal=(1, 0, 0))
discs = at.Scene(array, paper.medium, 40e3, paper.control_points, paper.obstacles)
times = {}
for name, scene, method, count in (
    ("two cubes, box", paper, "box", repeats),
    ("AUTD3 with discs, box", discs, "box", max(1, repeats // 3)),
    ("two cubes, full", paper, "full", max(1, repeats // 3)),
):
    at.make_propagator(scene, method, cache=False).transfer_matrix()
    spent = []
    for _ in range(count):
        begin = time.perf_counter()
        at.make_propagator(scene, method, cache=False).transfer_matrix()
        spent.append(time.perf_counter() - begin)
    times[name] = statistics.median(spent)
print(json.dumps(times))
"""


OPTIONS = {
    "--against": {"type": Path, "help": "another checkout, measured in turn"},
    "--processes": {"type": int, "default": 8, "help": "busy processes"},
    "--rounds": {"type": int, "default": 3, "help": "processes of each variant"},
    "--repeats": {"type": int, "default": 9, "help": "simulations in a process"},
}


def main(against: Path | None, processes: int, rounds: int, repeats: int) -> None:
    """Compare on the machine as it is, and beside busy processes."""
    none: dict[str, str] = {}
    variants = {"default": (ROOT, none), "one thread": (ROOT, ONE_THREAD)}
    if against:
        other = against.resolve()
        variants |= {"other": (other, none), "other, one": (other, ONE_THREAD)}
    print("Last column: the default's time over this one's.\nThe machine as it is:")
    compare(variants, rounds, repeats)
    print(f"Beside {processes} busy processes:")
    with busy(processes):
        compare(variants, rounds, max(1, repeats // 3))


@contextlib.contextmanager
def busy(processes: int) -> Iterator[None]:
    """Run busy processes within the context."""
    hogs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        time.sleep(2)
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def simulated(checkout: Path, settings: dict[str, str], repeats: int) -> dict[str, float]:
    """Return the seconds of each scene, measured in a new process."""
    environment = os.environ | {"PYTHONPATH": str(checkout)} | settings
    command = [sys.executable, "-W", "ignore", "-c", CHILD, str(ROOT / "configs" / "scene"), str(repeats)]
    ended = subprocess.run(command, env=environment, cwd=checkout, capture_output=True, text=True, check=True)
    return json.loads(ended.stdout.splitlines()[-1])


def compare(variants: dict[str, tuple[Path, dict[str, str]]], rounds: int, repeats: int) -> None:
    """Print the median of each variant, and its ratio to the first."""
    times: dict[str, dict[str, list[float]]] = {}
    for _ in range(rounds):
        for name, (checkout, settings) in variants.items():
            for scene, seconds in simulated(checkout, settings, repeats).items():
                times.setdefault(scene, {}).setdefault(name, []).append(seconds)
    for scene, by_variant in times.items():
        first = statistics.median(by_variant[next(iter(variants))])
        for name, seconds in by_variant.items():
            median = statistics.median(seconds)
            spread = f"{min(seconds):.3f} to {max(seconds):.3f}"
            print(f"  {scene:24}{name:16}{median:8.3f} s ({spread})  {first / median:.2f} times", flush=True)
