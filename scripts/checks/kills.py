"""Studies, sweeps and hardware trials killed at random moments, which must resume.

Uses SIGKILL, also while they start. Each must end with the numbers of the undisturbed run, bit for bit, and
repeat nothing that was finished.
"""

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

ROOT = Path(__file__).parents[2]
STUDY = ROOT / "tests" / "slow_study.py"  # slow enough to be killed in the middle
TRIAL = ROOT / "scripts" / "hardware_trial.py"

_OUTPUT = "output.txt"
_POLL = 0.005  # [s]
_TRIAL = 0.2  # [s], about the time of a trial
_LONGEST = 600.0  # [s]


@dataclass(frozen=True)
class Subject:
    """A program to kill."""

    command: tuple[str, ...]  # starts or resumes it in the working directory
    journals: str  # pattern of the files to which it appends lines
    numbers: Callable[[Path], list[torch.Tensor]]  # reads all its results in a folder

    def start(self, folder: Path) -> subprocess.Popen[bytes]:
        """Start it in a folder, with its output in a file there."""
        with (folder / _OUTPUT).open("wb") as output:
            command = [sys.executable, *self.command]
            return subprocess.Popen(command, cwd=folder, stdout=output, stderr=output)

    def lines(self, folder: Path) -> int:
        """Count the trials or evaluations in its journals."""
        return sum(path.read_bytes().count(b'"drive": ') for path in folder.glob(self.journals))


@dataclass(frozen=True)
class Calm:
    """An undisturbed run: its results, the lines in its journals, and the time until the first [s]."""

    numbers: list[torch.Tensor]
    lines: int
    first: float


def of_studies(folder: Path) -> list[torch.Tensor]:
    """Return the numbers of all studies below a folder."""
    studies = [load_results(path) for path in sorted(folder.rglob("results.h5"))]
    scenes = [scene for study in studies for scene in study.scenes.values()]
    methods = [method for scene in scenes for method in scene.methods.values()]
    parts = [getattr(method.solution, field.name) for method in methods for field in fields(method.solution)]
    planes = [method.plane_pressure for method in methods if method.plane_pressure is not None]
    return [*(scene.transfer_matrix for scene in scenes), *parts, *planes]


def of_trial(folder: Path) -> list[torch.Tensor]:
    """Return the evaluations of a hardware trial and its drive."""
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
            *(str(TRIAL), "output=out", "method=gabs", "method.levels=64"),
            *("hardware=emulated", "hardware.limits.amplitude=1"),
        ),
        "out/trial.jsonl",
        of_trial,
    ),
}


OPTIONS = {
    "--kills": {"type": int, "default": 40, "help": "kills of each subject"},
    "--seed": {"type": int, "default": 0, "help": "seed of the moments"},
}


def main(kills: int, seed: int) -> int:
    failed = False
    for name in SUBJECTS:
        with tempfile.TemporaryDirectory() as folder:
            runs, wrong = check(name, kills, seed, Path(folder))
        print(*wrong, f"{name}: {kills} kills in {runs} runs, {len(wrong)} problems", sep="\n", flush=True)
        failed |= bool(wrong)
    return failed


def calm_run(subject: Subject, folder: Path) -> Calm:
    begin = time.monotonic()
    process = subject.start(folder)
    wait(lambda: subject.lines(folder) > 0, process)
    first = time.monotonic() - begin
    finish(process, folder)
    return Calm(subject.numbers(folder), subject.lines(folder), first)


def killed_run(
    subject: Subject, calm: Calm, most: int, rng: random.Random, folder: Path
) -> tuple[int, list[str]]:
    """Kill and resume, at most `most` times; return the kills, and a line for each broken promise."""
    kills = 0
    while kills < most:
        done = subject.lines(folder)
        enough = rng.randint(max(1, done), calm.lines)
        process = subject.start(folder)
        wait(lambda enough=enough: subject.lines(folder) >= enough, process)
        # A moment later; without progress, anywhere in the start.
        moment = time.monotonic() + rng.uniform(0, calm.first if enough == done else _TRIAL)
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
    """Kill a subject; return the number of finished runs, and a line for each broken promise."""
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
    """Wait until a process has ended; RuntimeError if it failed."""
    if process.wait(_LONGEST):
        raise RuntimeError((folder / _OUTPUT).read_text(encoding="utf-8"))
