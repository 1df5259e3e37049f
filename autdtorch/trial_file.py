"""The finished trials of a study, appended to a file as they end.

A line a trial, as JSON, with all that the trial found: what is there survives the end of the process, at
whatever moment it comes, and a study that is begun again goes on after it.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import torch

from autdtorch.metrics import focus_metrics
from autdtorch.optim.base import Solution, joined
from autdtorch.writing import naming

logger = logging.getLogger(__name__)

TRIALS_FILE = "trials.jsonl"

Trial: TypeAlias = tuple[Solution, float]
"""What one trial found, and the seconds it took."""

_METRICS = ("mean", "min", "std", "uniformity")


class TrialFile:
    """Trials by scene, method and number: those that the file holds, and those that are added."""

    def __init__(self, path: Path | None, seed: int) -> None:
        """Read what the file holds; a line that is not complete, and all behind it, is cut off.

        Args:
            path: of the file; None to keep the trials in memory alone.
            seed: of the study, for the rows.

        Raises:
            OSError: the file cannot be read or cut.
        """
        self._path = path
        self._seed = seed
        self._trials: dict[tuple[str, str, int], Trial] = {}
        if path is not None and path.exists():
            self._read(path)

    def __len__(self) -> int:
        """Number of trials."""
        return len(self._trials)

    def missing(self, scene: str, method: str, trials: int) -> list[int]:
        """Which of the first `trials` trials are not there."""
        return [trial for trial in range(trials) if (scene, method, trial) not in self._trials]

    def append(self, scene: str, method: str, trials: Sequence[int], found: Solution, seconds: float) -> None:
        """Add trials that ended together.

        Args:
            scene: name.
            method: name.
            trials: their numbers (T,).
            found: what they found.
            seconds: what they took together; each is given an equal share.

        Raises:
            OSError: the file cannot be written.
        """
        share = seconds / len(trials)
        for place, trial in enumerate(trials):
            self._trials[scene, method, trial] = _alone(found, place), share
        if self._path is None:
            return
        rows = [self._row(scene, method, trial) for trial in trials]
        with naming(self._path), self._path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(row) + "\n" for row in rows))
            file.flush()
            os.fsync(file.fileno())

    def found(self, scene: str, method: str, trials: int) -> tuple[Solution, torch.Tensor]:
        """What the first `trials` trials found, all of which must be there, and seconds (T,) of each."""
        each = [self._trials[scene, method, trial] for trial in range(trials)]
        seconds = torch.tensor([share for _, share in each], dtype=torch.float64)
        return joined([solution for solution, _ in each]), seconds

    def _row(self, scene: str, method: str, trial: int) -> dict[str, Any]:
        solution, seconds = self._trials[scene, method, trial]
        metrics = focus_metrics(solution.pressure)
        return {
            "scene": scene,
            "method": method,
            "trial": trial,
            "seed": self._seed,
            "score": float(solution.score),
            **{name: float(getattr(metrics, name)) for name in _METRICS},
            "evaluations": int(solution.evaluations),
            "seconds": seconds,
            "pressure": solution.pressure[0].tolist(),
            "drive": torch.view_as_real(solution.drive[0]).tolist(),
            "history": solution.history[0].tolist(),
        }

    def _read(self, path: Path) -> None:
        content = path.read_bytes()
        complete = 0
        for line in content.splitlines(keepends=True):
            if not line.endswith(b"\n"):  # its last number may lack digits
                break
            try:
                self._take(json.loads(line))
            except (ValueError, KeyError, TypeError):
                break
            complete += len(line)
        if complete < len(content):
            logger.warning(
                "%s: line %d is not complete: cut off there", path, content[:complete].count(b"\n") + 1
            )
            os.truncate(path, complete)

    def _take(self, row: dict[str, Any]) -> None:
        real = {
            key: torch.tensor([row[key]], dtype=torch.float64) for key in ("pressure", "score", "history")
        }
        drive = torch.view_as_complex(torch.tensor([row["drive"]], dtype=torch.float64))
        solution = Solution(
            drive, real["pressure"], real["score"], torch.tensor([row["evaluations"]]), real["history"]
        )
        self._trials[row["scene"], row["method"], row["trial"]] = solution, row["seconds"]


def _alone(found: Solution, place: int) -> Solution:
    """One of the trials (T,), its history as long as its evaluations."""
    row = slice(place, place + 1)
    evaluations = found.evaluations[row]
    history = found.history[row, : int(evaluations)]
    return Solution(found.drive[row], found.pressure[row], found.score[row], evaluations, history)
