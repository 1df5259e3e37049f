"""The folder of a study: what it holds of the same study is used again, another's is kept aside."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from filelock import FileLock

from autdtorch.locking import held
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
PREVIOUS = "previous-"
"""Start of the names of the folders where earlier studies are kept."""

_LOCK_FILE = ".lock"


class StudyFolder:
    """What a study finds on disk and leaves there; see `open_folder`.

    Attributes:
        path: of the folder; None where the study is kept in memory alone.
        provenance: of the study, with the date when it was first begun.
        scenes: results of the scenes that are finished, by name.
        trials: finished trials of all scenes.
    """

    def __init__(self, path: Path | None, provenance: Provenance, reuse: bool) -> None:
        """Read what the folder, which must be locked, holds of the study of this provenance."""
        self.path = path
        self.provenance = provenance
        self.scenes: dict[str, SceneResult] = {}
        self.trials = TrialFile(None, provenance.seed)
        stored = None if path is None or not reuse else _stored_provenance(path)
        self._goes_on = stored is not None and stored.same_origin(provenance)
        if path is not None and stored is not None and self._goes_on:
            self.provenance = stored
            self.scenes = _stored_scenes(path)

    def begin(self) -> None:
        """Set aside what the folder holds of another study, and open the file of trials.

        Until then nothing is written: a study that is refused leaves the folder as it was.

        Raises:
            OSError: the folder cannot be read or written.
        """
        if self.path is None:
            return
        if not self._goes_on:
            _set_aside(self.path)
            save_provenance(self.provenance, self.path)
        self.trials = TrialFile(self.path / TRIALS_FILE, self.provenance.seed)
        if len(self.trials):
            logger.info("re-using %d trials from %s", len(self.trials), self.path)

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


@contextlib.contextmanager
def open_folder(
    folder: str | os.PathLike[str] | None, provenance: Provenance, reuse: bool
) -> Iterator[StudyFolder]:
    """Have a folder to oneself for the time of a study; it is made if need be.

    Args:
        folder: None to keep the study in memory alone.
        provenance: of the study.
        reuse: whether what the folder holds of the same origin is used again.

    Raises:
        ValueError: another process writes into the folder.
        OSError: the folder cannot be made, read or written.
    """
    if folder is None:
        yield StudyFolder(None, provenance, reuse)
        return
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    accepted = "another process writes there; wait until it ends, or give another folder"
    with held(FileLock(path / _LOCK_FILE), ValueError(f"output: {path}; {accepted}")):
        yield StudyFolder(path, provenance, reuse)


def _stored_provenance(path: Path) -> Provenance | None:
    try:
        return load_provenance(path)
    except FileNotFoundError:
        return None
    except ValueError as error:
        logger.warning("computing everything again: %s", error)
        return None


def _stored_scenes(path: Path) -> dict[str, SceneResult]:
    if not (path / RESULTS_FILE).exists():
        return {}
    try:
        scenes = dict(load_results(path).scenes)
    except ValueError as error:
        logger.warning("computing scenes again: %s", error)
        return {}
    logger.info("re-using %s from %s, same settings and same source", ", ".join(scenes), path)
    return scenes


def _set_aside(path: Path) -> None:
    """Move the files of another study, so that this one does not overwrite them."""
    files = [file for name in (RESULTS_FILE, TRIALS_FILE, PROVENANCE_FILE) if (file := path / name).exists()]
    if not files:
        return
    kept = next(place for n in itertools.count(1) if not (place := path / f"{PREVIOUS}{n}").exists())
    kept.mkdir()
    for file in files:
        file.replace(kept / file.name)
    logger.warning("another study was in %s (other settings, source or packages): kept in %s", path, kept)
