"""The folder of a study: its files are used again by the same study, and moved aside for another.

Finished trials are appended to a file, a line of JSON for each. Lines survive the end of the process at any
moment, and a study that is begun again goes on after them.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock

from autdtorch.methods.solution import Solution, joined
from autdtorch.objectives.metrics import focus_metrics
from autdtorch.scene.scene import Scene
from autdtorch.study.results import (
    PROVENANCE_FILE,
    Provenance,
    SceneResult,
    StudyResult,
    load_provenance,
    save_provenance,
    stored_solution,
)
from autdtorch.study.results_file import RESULTS_FILE, load_results, save_results
from autdtorch.utils.array_types import REAL
from autdtorch.utils.files import JsonLines, held
from autdtorch.utils.text import counted
from autdtorch.utils.validation import integer_at_least, invalid, not_negative, real_tensor, require_kind

logger = logging.getLogger(__name__)

TRIALS_FILE = "trials.jsonl"


class TrialFile:
    """The finished trials by scene, method and number, in memory and in a file."""

    def __init__(
        self, path: Path, origin: str, seed: int, shapes: Mapping[str, tuple[int, int | None]]
    ) -> None:
        """Read the trials of the study from the file, which is not changed before `mend`.

        The origin is part of the checksum of the lines. The `shapes` are the numbers of transducers and of
        control points by name of the scene; None for readings of a force, of any number.
        """
        self._seed = seed
        self._shapes = shapes
        self._trials: dict[tuple[str, str, int], tuple[Solution, float]] = {}  # and its seconds
        self._spent: dict[str, tuple[int, float]] = {}  # trials and their seconds by method
        self._lines = JsonLines(path, origin, self._use)

    def __len__(self) -> int:
        return len(self._trials)

    def mend(self) -> None:
        """Set aside lines that are damaged or of another study; call it before the first `append`."""
        self._lines.mend()

    def missing(self, scene: str, method: str, trials: int) -> list[int]:
        """Return which of the first `trials` trials are not there."""
        return [trial for trial in range(trials) if (scene, method, trial) not in self._trials]

    def append(
        self, scene: str, method: str, trials: Sequence[int], solution: Solution, seconds: float
    ) -> None:
        """Add the trials of a block; those that the file holds already stay as they are.

        Each trial gets an equal share of the wall time `seconds` [s] of the block.
        """
        share = seconds / len(trials)
        added = [trial for trial in trials if (scene, method, trial) not in self._trials]
        for trial in added:
            self._add((scene, method, trial), _alone(solution, trials.index(trial)), share)
        self._lines.append(*(self._row(scene, method, trial) for trial in added))

    def seconds_left(self, counts: Mapping[str, int]) -> tuple[float, float]:
        """Return the least and most time [s] of the missing trials, of so many in each scene by method.

        A trial takes as long as those of its method so far, in all scenes; unknown times are infinite.
        """
        least = most = 0.0
        for method, count in counts.items():
            finished, spent = self._spent.get(method, (0, 0.0))
            missing = count * len(self._shapes) - finished
            least += missing * spent / max(1, finished)
            most += 0.0 if finished else math.inf
        return least, least + most

    def solution(self, scene: str, method: str, trials: int) -> tuple[Solution, torch.Tensor]:
        """Return the joined solution of the first `trials` trials, and seconds (T,) of each."""
        each = [self._trials[scene, method, trial] for trial in range(trials)]
        seconds = torch.tensor([share for _, share in each], **REAL)
        return joined([solution for solution, _ in each]), seconds

    def _row(self, scene: str, method: str, trial: int) -> dict[str, Any]:
        solution, seconds = self._trials[scene, method, trial]
        metrics = {} if self._shapes[scene][1] is None else vars(focus_metrics(solution.pressure))
        return {
            "scene": scene,
            "method": method,
            "trial": trial,
            "seed": self._seed,
            "score": float(solution.score),
            **{name: float(value) for name, value in metrics.items() if value is not None},
            "evaluations": int(solution.evaluations),
            "seconds": seconds,
            "pressure": solution.pressure[0].tolist(),
            "drive": torch.view_as_real(solution.drive[0]).tolist(),
            "history": solution.history[0].tolist(),
        }

    def _use(self, row: dict[str, Any]) -> None:
        """Check and add the trial of a row."""
        for name in ("scene", "method"):
            require_kind(name, row[name], str)
        if row["scene"] not in self._shapes:
            raise invalid("scene", row["scene"], f"must be one of this study: {', '.join(self._shapes)}")
        where = row["scene"], row["method"], integer_at_least("trial", row["trial"], 0)
        if where in self._trials:
            raise invalid("trial", where, "must be there once")
        transducers, points = self._shapes[row["scene"]]
        fields: dict[str, Any] = {
            name: [row[name]] for name in ("pressure", "score", "evaluations", "history")
        }
        fields["drive"] = torch.view_as_complex(real_tensor("drive", row["drive"]))[None]
        solution = stored_solution(fields, transducers, len(row["pressure"]) if points is None else points)
        if solution.history.shape[1] != int(solution.evaluations):
            raise invalid("history", row["history"], f"must be {row['evaluations']} numbers")
        self._add(where, solution, not_negative("seconds", row["seconds"], "s"))

    def _add(self, where: tuple[str, str, int], solution: Solution, seconds: float) -> None:
        self._trials[where] = solution, seconds
        count, spent = self._spent.get(where[1], (0, 0.0))
        self._spent[where[1]] = count + 1, spent + seconds


def _alone(solution: Solution, place: int) -> Solution:
    """One of the trials (T,), its history as long as its evaluations."""
    row = slice(place, place + 1)
    evaluations = solution.evaluations[row]
    history = solution.history[row, : int(evaluations)]
    return Solution(solution.drive[row], solution.pressure[row], solution.score[row], evaluations, history)


PREVIOUS = "previous-"
"""Start of the names of folders for files of earlier studies and damaged files."""

_FILES = (RESULTS_FILE, TRIALS_FILE, PROVENANCE_FILE)
_LOCK_FILE = ".lock"
_MADE_OF_THEM = ("plane.png", "poses.png", "fig*.png", "report.md", "report.html")
_ANOTHER = "of another study (other settings, source or packages)"


class StudyFolder:
    """The files of a study on disk; see `open_folder`.

    `provenance` has the date when the study was first begun; `scenes` are the finished ones, by name. `begin`
    opens the file of `trials`.
    """

    trials: TrialFile

    def __init__(
        self, path: Path, provenance: Provenance, scenes: Mapping[str, Scene], copies: int | None, reuse: bool
    ) -> None:
        """Read the files of the study with this provenance; the folder must be locked.

        Each file holds its own provenance, so that a damaged one does not spoil the others.
        """
        self.path = path
        self.provenance = provenance
        self.scenes: dict[str, SceneResult] = {}
        self._shapes = {
            name: (len(scene.array), None if copies is None else copies * len(scene.control_points))
            for name, scene in scenes.items()
        }
        self._not_used = dict.fromkeys(_FILES, _ANOTHER)
        if reuse:
            self._take_up()

    def begin(self) -> None:
        """Set aside damaged files and those of another study with its pictures, and open the file of trials.

        Nothing is written before: a study that is refused leaves the folder as it was.
        """
        aside = {name: reason for name, reason in self._not_used.items() if (self.path / name).exists()}
        if aside:
            if len(self._not_used) == len(_FILES):  # nothing here is of this study
                made = [file.name for pattern in _MADE_OF_THEM for file in sorted(self.path.glob(pattern))]
                made += filter(lambda name: (self.path / name).exists(), self._drives_of_another())
                aside |= dict.fromkeys(made, _ANOTHER)
            places = (self.path / f"{PREVIOUS}{number}" for number in itertools.count(1))
            aside_folder = next(place for place in places if not place.exists())
            aside_folder.mkdir()
            for name in aside:
                (self.path / name).replace(aside_folder / name)
            why = "; ".join(dict.fromkeys(aside.values()))
            logger.warning("%s of %s kept in %s: %s", ", ".join(aside), self.path, aside_folder, why)
        save_provenance(self.provenance, self.path)
        if TRIALS_FILE in self._not_used:
            self.trials = self._trial_file()
        self.trials.mend()
        if len(self.trials) and len(self.scenes) < len(self._shapes):
            logger.info("re-using %s from %s", counted(len(self.trials), "trial"), self.path)

    def _drives_of_another(self) -> list[str]:
        """Return the names of the drives that another study wrote here; a user's own may lie beside them."""
        try:
            return list(drive_files(load_results(self.path)).values())
        except FileNotFoundError:
            return []  # drives are written after results
        except ValueError:  # which are its drives is unknown, and those of this study must not replace them
            return sorted(file.name for file in self.path.glob("drive*.csv"))

    def _take_up(self) -> None:
        """Use the files of this study; note why others are not used."""
        loaders: dict[str, Callable[[Path], StudyResult | Provenance]]
        loaders = {RESULTS_FILE: load_results, PROVENANCE_FILE: load_provenance}
        for name, load in loaders.items():
            try:
                stored = load(self.path)
            except FileNotFoundError:
                continue
            except ValueError as error:
                self._not_used[name] = str(error)
                continue
            scenes = stored.scenes if isinstance(stored, StudyResult) else {}
            provenance = stored.provenance if isinstance(stored, StudyResult) else stored
            if provenance.origin == self.provenance.origin:
                del self._not_used[name]
                self.provenance = provenance
                self.scenes |= scenes
        if self.scenes:
            names = ", ".join(self.scenes)
            logger.info("re-using %s from %s, same settings and same source", names, self.path)
        self.trials = self._trial_file()
        if len(self._not_used) < len(_FILES) or len(self.trials):
            del self._not_used[TRIALS_FILE]  # its lines are checked one by one

    def _trial_file(self) -> TrialFile:
        return TrialFile(self.path / TRIALS_FILE, self.provenance.origin, self.provenance.seed, self._shapes)

    def seconds_left(self, counts: Mapping[str, int]) -> tuple[float, float]:
        """Return the least and most time [s] until all scenes are finished; unknown times are infinite.

        The fields of a scene take as long as those of the scene that was finished last.
        """
        least, most = self.trials.seconds_left(counts)
        if not self.scenes:
            return least, math.inf
        simulation = self.scenes[next(reversed(self.scenes))].simulation
        seconds = simulation.matrix_seconds + simulation.plane_seconds
        fields = seconds * (len(self._shapes) - len(self.scenes))
        return least + fields, most + fields

    def save(self, name: str, scene: SceneResult) -> None:
        """Save a finished scene."""
        self.scenes[name] = scene
        self.scenes = {other: self.scenes[other] for other in self._shapes if other in self.scenes}
        save_results(StudyResult(self.provenance, self.scenes), self.path)


def drive_files(results: StudyResult) -> dict[tuple[str, str], str]:
    """Return the names of files for the best drives of a study, by scene and method."""
    outcomes = [(name, method) for name, scene in results.scenes.items() for method in scene.methods]
    if len(outcomes) == 1:
        return dict.fromkeys(outcomes, "drive.csv")
    return {(name, method): f"drive_{name}_{method}.csv" for name, method in outcomes}


@contextlib.contextmanager
def open_folder(
    path: Path, provenance: Provenance, scenes: Mapping[str, Scene], copies: int | None, reuse: bool
) -> Iterator[StudyFolder]:
    """Lock the folder of a study, made if it is missing; `reuse` takes files of its origin from it.

    Each of `scenes` has the pressures of so many `copies`: the scene itself, or the scenarios around it; None
    for readings of a force.
    """
    path.mkdir(parents=True, exist_ok=True)
    accepted = "another process writes there; wait until it ends, or give another folder"
    with held(FileLock(path / _LOCK_FILE), ValueError(f"output: {path}; {accepted}")):
        yield StudyFolder(path, provenance, scenes, copies, reuse)
