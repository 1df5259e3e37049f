"""Damaged files of studies and hardware trials, which must resume.

Damages the files of a study and of an emulated hardware trial at random. Each must end with the numbers of
the undisturbed run, bit for bit. Every row that the damage left whole and every damaged file must stay on
disk, and the next start must log no warning.
"""

import functools
import json
import logging
import random
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from unittest import mock

import torch
from shared.timing import logged_warnings

import autdtorch as at
from autdtorch import hardware
from autdtorch.study.folder import PREVIOUS, TRIALS_FILE
from autdtorch.study.results import PROVENANCE_FILE
from autdtorch.study.results_file import RESULTS_FILE
from autdtorch.study.run_study import run_study
from autdtorch.utils.files import SET_ASIDE

LOG_FILE = "trial.jsonl"

AIR = at.Medium(density=1.2, sound_speed=340.0)
CUBE = at.Box(center=(12e-3, 0, 0), size=(6e-3, 8e-3, 4e-3), density=100.0, sound_speed=340.0)
SOLVER = {"spacing": 2e-3, "tolerance": 0.1}
METHODS = {
    "gabs": functools.partial(at.gabs, levels=4),
    "identify": functools.partial(at.identify, evaluations=12),
}

OPTIONS = {
    "--damages": {"type": int, "default": 300, "help": "number of damaged files"},
    "--seed": {"type": int, "default": 0, "help": "seed of the damages"},
}


def main(damages: int, seed: int) -> int:
    logging.getLogger("autdtorch").propagate = False  # hundreds of expected warnings
    with tempfile.TemporaryDirectory() as folder:
        counts, wrong = check(damages, seed, Path(folder))
    for case, count in sorted(counts.items()):
        print(f"{count:4d} {case}")
    print(*wrong, f"{counts.total()} damages, {len(wrong)} problems", sep="\n")
    return int(bool(wrong))


def _scene(*obstacles: at.Box) -> at.Scene:
    array = at.TransducerArray.grid((2, 2), pitch=8e-3, center=(0, 0, 0), normal=(1, 0, 0))
    return at.Scene(array, AIR, 40e3, [(22e-3, 3e-3, 1e-3), (20e-3, -5e-3, 4e-3)], obstacles)


def study(folder: Path, seed: int = 0) -> list[torch.Tensor]:
    """Start or resume a study, and return all its numbers; each seed has another cube."""
    results = run_study(
        {"empty": _scene(), "cube": _scene(replace(CUBE, density=100.0 + seed))},
        METHODS,
        solver={**SOLVER, "cache": folder / "matrices"},
        trials={"gabs": 5, "identify": 2},
        seed=seed,
        folder=folder,
        config=f"seed: {seed}",
    )
    solutions = [result.solution for scene in results.scenes.values() for result in scene.methods.values()]
    matrices = [scene.transfer_matrix for scene in results.scenes.values()]
    return [*matrices, *(number for solution in solutions for number in astuple(solution))]


def trial(folder: Path, seed: int = 0) -> list[torch.Tensor]:
    """Start or resume a hardware trial on the emulated bench, and return all its numbers."""
    scene = _scene()
    channels = range(len(scene.array))
    matrix = at.make_propagator(scene).transfer_matrix()
    bench = hardware.EmulatedBench(hardware.SONICSURFACE, matrix, channels)
    with hardware.open_link(hardware.SONICSURFACE, channels, backend=bench.bus) as link:
        limited = hardware.LimitedLink(link, hardware.Limits(amplitude=1.0))
        sensor = hardware.EmulatedSensor(bench)
        objective = hardware.HardwareObjective(scene, limited, sensor, folder / LOG_FILE, {"seed": seed})
        try:
            return list(astuple(at.gabs(objective, levels=8, seed=seed)))
        finally:
            objective.log.end(limited.seconds_on)


Damage = Callable[[random.Random, bytes, bytes], bytes]
"""Damages the content of a file; the last argument is the content of that file in another study or trial."""


def _changed(rng: random.Random, content: bytes, _: bytes) -> bytes:
    place = rng.randrange(len(content))
    return content[:place] + bytes([content[place] ^ rng.randrange(1, 256)]) + content[place + 1 :]


def _zeroed(rng: random.Random, content: bytes, _: bytes) -> bytes:
    place = rng.randrange(len(content))
    block = content[place : place + rng.choice((8, 64, 512))]
    return content[:place] + b"\0" * len(block) + content[place + len(block) :]


def _lines_changed(change: Callable[[random.Random, list[bytes], list[bytes]], object]) -> Damage:
    def damage(rng: random.Random, content: bytes, other: bytes) -> bytes:
        lines = content.splitlines(keepends=True)
        change(rng, lines, other.splitlines(keepends=True))
        return b"".join(lines)

    return damage


def _insert(rng: random.Random, lines: list[bytes], line: bytes) -> None:
    lines.insert(rng.randrange(len(lines)), line)


def _damage_end(rng: random.Random, lines: list[bytes], _: list[bytes]) -> None:
    line = rng.randrange(len(lines))
    lines[line] = lines[line].removesuffix(b"\n") + rng.choice((b"", b"\0", rng.randbytes(1)))


ANY: dict[str, Damage] = {
    "byte changed": _changed,
    "cut": lambda rng, content, _: content[: rng.randrange(len(content))],
    "block zeroed": _zeroed,
    "garbage appended": lambda rng, content, _: content + rng.randbytes(rng.choice((1, 50, 5000))),
    "emptied": lambda *_: b"",
    "file of another": lambda _, __, other: other,
}
OF_LINES: dict[str, Damage] = {
    "line removed": _lines_changed(lambda rng, lines, _: lines.pop(rng.randrange(len(lines)))),
    "line doubled": _lines_changed(lambda rng, lines, _: _insert(rng, lines, lines[-1])),
    "end of a line damaged": _lines_changed(_damage_end),
    "lines swapped": _lines_changed(lambda rng, lines, _: lines.append(lines.pop(rng.randrange(len(lines))))),
    "garbage line": _lines_changed(lambda rng, lines, _: _insert(rng, lines, rng.randbytes(80) + b"\n")),
    "line of another": _lines_changed(lambda rng, lines, other: _insert(rng, lines, rng.choice(other))),
}
MOST_LOST = {"byte changed": 1, "end of a line damaged": 0}
"""Rows that a damage can cost; others cost the rows that they touch."""


@dataclass(frozen=True)
class Subject:
    """A program whose files are damaged, and the numbers of its undisturbed run."""

    journal: str  # name of its file of lines
    begin: Callable[
        [Path], list[torch.Tensor]
    ]  # starts or resumes it in a folder, and returns all its numbers
    numbers: list[torch.Tensor]
    states: tuple[Path, Path]  # folders of a finished and of an interrupted run
    another: Path  # folder of another run


def study_subject(folder: Path) -> Subject:
    """Return a study: finished, and interrupted in its second scene."""
    finished, half, another = (folder / name for name in ("study", "half-study", "another-study"))
    numbers = study(finished)
    study(another, seed=1)
    with mock.patch("autdtorch.objectives.goals.WeakestFocus.bound", side_effect=[0.0, KeyboardInterrupt]):
        try:
            study(half)
        except KeyboardInterrupt:
            _shorten(half / TRIALS_FILE, 10)
    return Subject(TRIALS_FILE, study, numbers, (finished, half), another)


def trial_subject(folder: Path) -> Subject:
    """Return a hardware trial: finished, and interrupted."""
    finished, half, another = (folder / name for name in ("trial", "half-trial", "another-trial"))
    for place in (finished, another):
        place.mkdir()
    numbers = trial(finished)
    trial(another, seed=1)
    shutil.copytree(finished, half)
    _shorten(half / LOG_FILE, 12)
    return Subject(LOG_FILE, trial, numbers, (finished, half), another)


def _shorten(path: Path, lines: int) -> None:
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:lines]))


def _content(path: Path) -> bytes:
    return path.read_bytes() if path.exists() else b""


def _rows(content: bytes) -> set[bytes]:
    """Return the whole lines of a file, without the first of a log."""
    return {line for line in content.split(b"\n")[:-1] if not line.startswith(b'{"origin": ')}


def _count(rows: set[bytes]) -> int:
    """Count the rows of trials or evaluations; a log has another row at its end."""
    return sum(b'"drive": ' in row for row in rows)


def _seconds_on(rows: set[bytes]) -> float:
    """Return the emission time in the rows of a log; 0 for a study."""
    return max((json.loads(row).get("seconds_on", 0.0) for row in rows), default=0.0)


def journal_problems(before: bytes, damaged: bytes, journal: Path, most_lost: int) -> list[str]:
    """Return the broken promises about a resumed file of lines; the damage can cost `most_lost` rows."""
    wrong, content = [], _content(journal)
    rows, whole = _rows(content), {row for row in _rows(before) if row in damaged}
    if lost := whole - rows:
        wrong.append(f"{len(lost)} whole rows lost")
    if len(lost := _rows(before) - rows) > most_lost:
        wrong.append(f"{len(lost)} rows lost where the damage touched {most_lost}")
    if _seconds_on(rows) < _seconds_on(whole):
        wrong.append(f"on for {_seconds_on(rows)} s, where {_seconds_on(whole)} s were left")
    if not before.partition(b"\n")[0].startswith(damaged):  # else the log starts again
        debris = damaged
        for row in whole:
            debris = debris.replace(row, b"\n")
        aside = _content(journal.with_name(journal.name + SET_ASIDE))
        if any(line and line not in aside and line not in content for line in debris.split(b"\n")):
            wrong.append("damaged lines are lost")
    return wrong


def problems(subject: Subject, state: Path, folder: Path, damaged: bytes, name: str, kind: str) -> list[str]:
    """Resume in a copy of a state with one damaged file, and return the broken promises."""
    shutil.copytree(state, folder)
    (folder / name).write_bytes(damaged)
    before, journal = _content(state / subject.journal), folder / subject.journal
    start = _content(journal)
    whole = {row for row in _rows(before) if row in start}
    missing = _count(_rows(_content(subject.states[0] / subject.journal))) - _count(whole)
    try:
        numbers = subject.begin(folder)
    except hardware.LogError as error:
        refused = "of another trial" in str(error) and (folder / name).read_bytes() == damaged
        return [] if refused else [f"refused: {error}"]
    wrong = [] if all(map(torch.equal, numbers, subject.numbers)) else ["other numbers"]
    wrong += journal_problems(before, start, journal, MOST_LOST.get(kind, len(_rows(before))))
    if (again := _count(_rows(_content(journal)) - whole)) > missing:  # fewer if the results have them
        wrong.append(f"{again} trials or evaluations made where {missing} were missing")
    if name in (RESULTS_FILE, PROVENANCE_FILE) and (folder / f"{PREVIOUS}1" / name).read_bytes() != damaged:
        wrong.append("the damaged file is lost")
    with logged_warnings() as warned:
        numbers = subject.begin(folder)
    if not all(map(torch.equal, numbers, subject.numbers)) or warned:
        wrong.append(f"the next start is not clean: {[record.getMessage() for record in warned]}")
    return wrong


def check(damages: int, seed: int, folder: Path) -> tuple[Counter[str], list[str]]:
    """Damage and resume; return the damages by kind and file, and a line for each broken promise."""
    rng = random.Random(seed)
    subjects = [study_subject(folder), trial_subject(folder)]
    counts: Counter[str] = Counter()
    wrong: list[str] = []
    for number in range(damages):
        subject = subjects[number % 3 // 2]
        state = rng.choice(subject.states)
        files = [path for path in state.rglob("*.*") if path.suffix != ".lock" and path.name != ".lock"]
        name = str(rng.choice(sorted(files)).relative_to(state))
        kinds = ANY | OF_LINES if name == subject.journal else ANY
        kind = rng.choice(list(kinds))
        twin = subject.another / name
        if not twin.exists():  # a matrix has another name in every study
            (twin,) = twin.parent.iterdir()
        damaged = before = (state / name).read_bytes()
        while damaged == before:
            damaged = kinds[kind](rng, before, twin.read_bytes())
        case = f"{Path(name).suffix} {kind}"
        counts[case] += 1
        try:
            broken = problems(subject, state, folder / str(number), damaged, name, kind)
        except Exception as error:
            broken = [f"{type(error).__name__}: {error}"]
        wrong += [f"{number} {state.name} {case}: {text}" for text in broken]
        shutil.rmtree(folder / str(number))
    return counts, wrong
