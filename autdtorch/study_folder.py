"""The folder of a study: what it holds of the same study is used again, another's is kept aside."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from filelock import FileLock, Timeout

from autdtorch.results import (
    PROVENANCE_FILE,
    RESULTS_FILE,
    Provenance,
    SceneResult,
    StudyResult,
    load_provenance,
    load_results,
    save_provenance,
    save_results,
)
from autdtorch.trial_file import TRIALS_FILE, TrialFile

logger = logging.getLogger(__name__)

MATRICES_FOLDER = "matrices"

_LOCK_FILE = ".lock"


class StudyFolder:
    """What a study finds on disk and leaves there; see `open_folder`.

    Attributes:
        path: of the folder; None where the study is kept in memory alone.
        provenance: of the study, with the date when it was first begun.
        scenes: results of the scenes that are finished, by name.
        trials: finished trials of all scenes.
    """

    def __init__(self, path: Path | None, provenance: Provenance) -> None:
        """Read what the folder, which must be locked, holds of the study of this provenance.

        Raises:
            OSError: the folder cannot be read or written.
        """
        self.path = path
        self.provenance = provenance
        self.scenes: dict[str, SceneResult] = {}
        if path is not None:
            self._take_over(path)
        self.trials = TrialFile(None if path is None else path / TRIALS_FILE, provenance.seed)
        if len(self.trials):
            logger.info("re-using %d trials from %s", len(self.trials), path)

    @property
    def matrices(self) -> Path | None:
        """Where transfer matrices are kept."""
        return None if self.path is None else self.path / MATRICES_FOLDER

    def save(self, name: str, scene: SceneResult, order: Mapping[str, object]) -> None:
        """Keep a finished scene; `order` has the names of all scenes in their order.

        Raises:
            OSError: the folder cannot be written.
        """
        self.scenes[name] = scene
        self.scenes = {other: self.scenes[other] for other in order if other in self.scenes}
        if self.path is not None:
            save_results(StudyResult(self.provenance, self.scenes), self.path)

    def _take_over(self, path: Path) -> None:
        stored = _stored_provenance(path)
        if stored is None or not self.provenance.config or not stored.same_origin(self.provenance):
            _set_aside(path)
            save_provenance(self.provenance, path)
            return
        self.provenance = stored
        if not (path / RESULTS_FILE).exists():
            return
        try:
            self.scenes = dict(load_results(path).scenes)
        except ValueError as error:
            logger.warning("computing scenes again: %s", error)
            return
        logger.info("re-using %s from %s, same settings and same source", ", ".join(self.scenes), path)


@contextlib.contextmanager
def open_folder(folder: str | os.PathLike[str] | None, provenance: Provenance) -> Iterator[StudyFolder]:
    """Have a folder to oneself for the time of a study; it is made if need be.

    Args:
        folder: None to keep the study in memory alone.
        provenance: of the study; what the folder holds is used again if it is of the same origin and its
            settings are known.

    Raises:
        ValueError: another process writes into the folder.
        OSError: the folder cannot be made, read or written.
    """
    if folder is None:
        yield StudyFolder(None, provenance)
        return
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    # The system frees the lock when the process ends, however it ends.
    lock = FileLock(path / _LOCK_FILE)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        accepted = "another process writes there; wait until it ends, or give another folder"
        raise ValueError(f"output: {path}; {accepted}") from error
    try:
        yield StudyFolder(path, provenance)
    finally:
        lock.release()


def _stored_provenance(path: Path) -> Provenance | None:
    try:
        return load_provenance(path)
    except FileNotFoundError:
        return None
    except ValueError as error:
        logger.warning("computing everything again: %s", error)
        return None


def _set_aside(path: Path) -> None:
    """Rename the files of another study, so that this one does not overwrite them."""
    for name in (RESULTS_FILE, TRIALS_FILE, PROVENANCE_FILE):
        file = path / name
        if file.exists():
            kept = file.with_name(f"previous-{name}")
            file.replace(kept)
            logger.warning("%s is not of the same settings, source and packages: kept as %s", file, kept.name)
