"""The folder of a study: its files are used again by the same study, and moved aside for another."""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from filelock import FileLock

from autdtorch.scene.scene import Scene
from autdtorch.study.provenance import PROVENANCE_FILE, Provenance, load_provenance, save_provenance
from autdtorch.study.results import SceneResult, StudyResult
from autdtorch.study.results_file import RESULTS_FILE, load_results, save_results
from autdtorch.study.trial_file import TRIALS_FILE, TrialFile
from autdtorch.utils.display import counted
from autdtorch.utils.files import held

logger = logging.getLogger(__name__)

PREVIOUS = "previous-"
"""Start of the names of folders for files of earlier studies and damaged files."""

_FILES = (RESULTS_FILE, TRIALS_FILE, PROVENANCE_FILE)
_LOCK_FILE = ".lock"
_ANOTHER = "of another study (other settings, source or packages)"


class StudyFolder:
    """The files of a study on disk; see `open_folder`.

    `provenance` has the date when the study was first begun; `scenes` are the finished ones, by name. `begin`
    opens the file of `trials`.
    """

    trials: TrialFile

    def __init__(self, path: Path, provenance: Provenance, scenes: Mapping[str, Scene], reuse: bool) -> None:
        """Read the files of the study with this provenance; the folder must be locked.

        Each file holds its own provenance, so that a damaged one does not spoil the others.
        """
        self.path = path
        self.provenance = provenance
        self.scenes: dict[str, SceneResult] = {}
        self._shapes = {name: (len(scene.array), len(scene.control_points)) for name, scene in scenes.items()}
        self._not_used = dict.fromkeys(_FILES, _ANOTHER)
        if reuse:
            self._take_up()

    def begin(self) -> None:
        """Set aside damaged files and those of another study, and open the file of trials.

        Nothing is written before: a study that is refused leaves the folder as it was.
        """
        aside = {name: reason for name, reason in self._not_used.items() if (self.path / name).exists()}
        if aside:
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
            if provenance.same_origin(self.provenance):
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

    def save(self, name: str, scene: SceneResult) -> None:
        """Save a finished scene."""
        self.scenes[name] = scene
        self.scenes = {other: self.scenes[other] for other in self._shapes if other in self.scenes}
        save_results(StudyResult(self.provenance, self.scenes), self.path)


@contextlib.contextmanager
def open_folder(
    path: Path, provenance: Provenance, scenes: Mapping[str, Scene], reuse: bool
) -> Iterator[StudyFolder]:
    """Lock the folder of a study, made if it is missing; `reuse` takes files of its origin from it."""
    path.mkdir(parents=True, exist_ok=True)
    accepted = "another process writes there; wait until it ends, or give another folder"
    with held(FileLock(path / _LOCK_FILE), ValueError(f"output: {path}; {accepted}")):
        yield StudyFolder(path, provenance, scenes, reuse)
