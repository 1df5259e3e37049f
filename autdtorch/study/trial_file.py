"""The finished trials of a study, appended to a file as they end: a line of JSON for each.

Lines survive the end of the process at any moment, and a study that is begun again goes on after them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from autdtorch.methods.solution import Solution, joined
from autdtorch.objectives.metrics import focus_metrics
from autdtorch.study.results import stored_solution
from autdtorch.utils.array_types import REAL
from autdtorch.utils.files import JsonLines
from autdtorch.utils.validation import integer_at_least, invalid, not_negative, real_tensor, require_kind

TRIALS_FILE = "trials.jsonl"


class TrialFile:
    """The finished trials by scene, method and number, in memory and in a file."""

    def __init__(self, path: Path, origin: str, seed: int, shapes: Mapping[str, tuple[int, int]]) -> None:
        """Read the trials of the study from the file, which is not changed before `mend`.

        The origin is part of the checksum of the lines. The `shapes` are the numbers of transducers and of
        control points by name of the scene.
        """
        self._seed = seed
        self._shapes = shapes
        self._trials: dict[tuple[str, str, int], tuple[Solution, float]] = {}  # and its seconds
        self._lines = JsonLines(path, origin, self._use)

    def __len__(self) -> int:
        """Return the number of trials."""
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
            self._trials[scene, method, trial] = _alone(solution, trials.index(trial)), share
        self._lines.append(*(self._row(scene, method, trial) for trial in added))

    def solution(self, scene: str, method: str, trials: int) -> tuple[Solution, torch.Tensor]:
        """Return the joined solution of the first `trials` trials, and seconds (T,) of each."""
        each = [self._trials[scene, method, trial] for trial in range(trials)]
        seconds = torch.tensor([share for _, share in each], **REAL)
        return joined([solution for solution, _ in each]), seconds

    def _row(self, scene: str, method: str, trial: int) -> dict[str, Any]:
        solution, seconds = self._trials[scene, method, trial]
        metrics = vars(focus_metrics(solution.pressure)).items()
        return {
            "scene": scene,
            "method": method,
            "trial": trial,
            "seed": self._seed,
            "score": float(solution.score),
            **{name: float(value) for name, value in metrics if value is not None},
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
        transducers, foci = self._shapes[row["scene"]]
        fields: dict[str, Any] = {
            name: [row[name]] for name in ("pressure", "score", "evaluations", "history")
        }
        fields["drive"] = torch.view_as_complex(real_tensor("drive", row["drive"]))[None]
        solution = stored_solution(fields, transducers, foci)
        if solution.history.shape[1] != int(solution.evaluations):
            raise invalid("history", row["history"], f"must be {row['evaluations']} numbers")
        self._trials[where] = solution, not_negative("seconds", row["seconds"], "s")


def _alone(solution: Solution, place: int) -> Solution:
    """One of the trials (T,), its history as long as its evaluations."""
    row = slice(place, place + 1)
    evaluations = solution.evaluations[row]
    history = solution.history[row, : int(evaluations)]
    return Solution(solution.drive[row], solution.pressure[row], solution.score[row], evaluations, history)
