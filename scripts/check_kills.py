"""Kill a study, a sweep and an emulated hardware trial at random moments by SIGKILL, and begin them again.

Each must end with the numbers of the undisturbed one, bit for bit, and do nothing twice that had ended.

    python scripts/check_kills.py --kills 40
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import torch

import autdtorch as at
from autdtorch.study.results_file import load_results

SCRIPTS = Path(__file__).parent
STUDY = SCRIPTS.parent / "tests" / "slow_study.py"  # with trials that take a while
TRIAL = SCRIPTS / "hardware_trial.py"

_SAID = "said.txt"
_POLL = 0.005  # [s]
_LATER = 0.2  # [s], about what a trial takes
_LONGEST = 600.0  # [s]


@dataclass(frozen=True)
class Subject:
    """What is killed.

    Attributes:
        command: begins it in the working directory, or goes on there.
        journals: pattern of the files to which it appends lines.
        numbers: reads all that it found in a folder.
    """

    command: tuple[str, ...]
    journals: str
    numbers: Callable[[Path], list[torch.Tensor]]

    def start(self, folder: Path) -> subprocess.Popen[bytes]:
        """Begin it in a folder, where it also leaves what it says."""
        with (folder / _SAID).open("wb") as said:
            return subprocess.Popen([sys.executable, *self.command], cwd=folder, stdout=said, stderr=said)

    def lines(self, folder: Path) -> int:
        """Count the trials or evaluations in its journals."""
        return sum(path.read_bytes().count(b'"drive": ') for path in folder.glob(self.journals))


@dataclass(frozen=True)
class Calm:
    """What an undisturbed run was like.

    Attributes:
        numbers: that it found.
        lines: trials or evaluations in its journals.
        first: time until the first of them [s].
    """

    numbers: list[torch.Tensor]
    lines: int
    first: float


def of_studies(folder: Path) -> list[torch.Tensor]:
    """The numbers of all studies below a folder."""
    studies = [load_results(path) for path in sorted(folder.rglob("results.h5"))]
    scenes = [scene for study in studies for scene in study.scenes.values()]
    methods = [method for scene in scenes for method in scene.methods.values()]
    parts = [getattr(method.solution, field.name) for method in methods for field in fields(method.solution)]
    planes = [method.plane_pressure for method in methods if method.plane_pressure is not None]
    return [*(scene.transfer_matrix for scene in scenes), *parts, *planes]


def of_trial(folder: Path) -> list[torch.Tensor]:
    """The evaluations of a hardware trial and the drive that it found."""
    rows = [json.loads(line) for line in (folder / "out" / "trial.jsonl").read_bytes().splitlines()]
    rows = [row for row in rows if "drive" in row]
    parts = [torch.tensor([row[key] for row in rows]) for key in ("evaluation", "drive", "pressure")]
    return [*parts, at.load_drive(folder / "out" / "drive.npz")]


SUBJECTS = {
    "study": Subject((str(STUDY), "out"), "out/trials.jsonl", of_studies),
    "sweep": Subject(
        (
            *("-m", "autdtorch", "-m", "scene=homogeneous,sphere", "method=gabs,identify", "trials=6"),
            *("solver.spacing=2.8e-3", "solver.tolerance=0.1", "plane_spacing=0.02"),
        ),
        "multirun/*/trials.jsonl",
        of_studies,
    ),
    "hardware trial": Subject(
        (
            *(str(TRIAL), "--output", "out", "--device", "emulated", "--scene", "homogeneous"),
            *("--method", "gabs", "--set", "levels=64", "--amplitude-limit", "1"),
        ),
        "out/trial.jsonl",
        of_trial,
    ),
}


def calm_run(subject: Subject, folder: Path) -> Calm:
    """Run to the end, undisturbed."""
    begin = time.monotonic()
    process = subject.start(folder)
    wait(lambda: subject.lines(folder) > 0, process)
    first = time.monotonic() - begin
    finish(process, folder)
    return Calm(subject.numbers(folder), subject.lines(folder), first)


def killed_run(
    subject: Subject, calm: Calm, most: int, rng: random.Random, folder: Path
) -> tuple[int, list[str]]:
    """Kill and begin again until a process comes to its end by itself, or there were enough kills.

    Returns:
        How often it was killed, and what was not as promised.
    """
    kills = 0
    while kills < most:
        done = subject.lines(folder)
        enough = rng.randint(max(1, done), calm.lines)
        process = subject.start(folder)
        wait(lambda enough=enough: subject.lines(folder) >= enough, process)
        # A moment later; of nothing new, anywhere in the start.
        moment = time.monotonic() + rng.uniform(0, calm.first if enough == done else _LATER)
        wait(lambda moment=moment: time.monotonic() > moment, process)
        process.kill()
        if process.wait() != -signal.SIGKILL:
            finish(process, folder)
            break
        kills += 1
    finish(subject.start(folder), folder)
    numbers, lines = subject.numbers(folder), subject.lines(folder)
    wrong = []
    if len(numbers) != len(calm.numbers) or not all(map(torch.equal, numbers, calm.numbers)):
        wrong.append("other numbers")
    if lines != calm.lines:
        wrong.append(f"{lines} trials or evaluations, not {calm.lines}")
    return kills, wrong


def check(name: str, kills: int, seed: int, folder: Path) -> tuple[int, list[str]]:
    """Kill one of `SUBJECTS` so many times.

    Returns:
        The number of runs to the end that this took, and what was not as promised.
    """
    rng = random.Random(seed)
    subject = SUBJECTS[name]
    (folder / "calm").mkdir()
    calm = calm_run(subject, folder / "calm")
    wrong: list[str] = []
    runs = done = 0
    while done < kills:
        runs += 1
        place = folder / str(runs)
        place.mkdir()
        more, problems = killed_run(subject, calm, kills - done, rng, place)
        done += more
        wrong += [f"{name}, run {runs}, {more} kills: {problem}" for problem in problems]
    return runs, wrong


def wait(condition: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    """Wait until a condition holds or the process has ended."""
    end = time.monotonic() + _LONGEST
    while not condition() and process.poll() is None:
        if time.monotonic() > end:
            raise TimeoutError(f"{process.args}: no end after {_LONGEST:g} s")
        time.sleep(_POLL)


def finish(process: subprocess.Popen[bytes], folder: Path) -> None:
    """Wait until a process, begun in a folder, has ended.

    Raises:
        RuntimeError: it failed.
    """
    if process.wait(_LONGEST):
        raise RuntimeError((folder / _SAID).read_text(encoding="utf-8"))


def main() -> int:
    """Run the command line; returns 1 if anything was not as promised."""
    parser = argparse.ArgumentParser(description="Kill at random moments, and begin again.")
    parser.add_argument("--kills", type=int, default=40, help="of each (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    failed = False
    for name in SUBJECTS:
        with tempfile.TemporaryDirectory() as folder:
            runs, wrong = check(name, options.kills, options.seed, Path(folder))
        for line in (*wrong, f"{name}: {options.kills} kills in {runs} runs, {len(wrong)} problems"):
            print(line, flush=True)
        failed |= bool(wrong)
    return failed


if __name__ == "__main__":
    sys.exit(main())
