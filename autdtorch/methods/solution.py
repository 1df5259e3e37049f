"""The solution of a run: the drive that each trial chose, and how it came there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from autdtorch.scene.drive import amplitudes_of, phases_of
from autdtorch.utils.text import html_facts


@dataclass(frozen=True, eq=False)
class Solution:
    """The drive that each of T trials chose: the best it observed, unless a method says otherwise.

    Attributes:
        drive: (T, M), complex128, as the device played it: rounded to its phase levels, if it has any.
        pressure: magnitudes at the P control points (T, P) [Pa], observed for `drive`.
        score: (T,), observed for `drive`; [Pa] for the weakest focus.
        evaluations: number of evaluations (T,), int64.
        history: best score after each evaluation (T, E). E is the largest number of evaluations that the
            settings allow; a trial that ends earlier repeats its last score.
    """

    drive: torch.Tensor
    pressure: torch.Tensor
    score: torch.Tensor
    evaluations: torch.Tensor
    history: torch.Tensor

    @property
    def phases(self) -> torch.Tensor:
        """Phases of the drive (T, M) in [0, 2 pi) [rad]."""
        return phases_of(self.drive)

    @property
    def amplitudes(self) -> torch.Tensor:
        """Amplitudes of the drive (T, M)."""
        return amplitudes_of(self.drive)

    def __repr__(self) -> str:
        return f"Solution({', '.join(f'{name} {value}' for name, value in self._facts())})"

    def _repr_html_(self) -> str:
        return html_facts("Solution", self._facts())

    def _facts(self) -> list[tuple[str, str]]:
        is_weakest = torch.equal(self.score, self.pressure.amin(dim=1))  # else of another goal
        name, unit = ("weakest focus", " Pa") if is_weakest else ("score", "")
        score = self.score
        reached = f"{score.max():.4g}{unit}"
        if len(score) > 1:
            reached = f"best {reached}, median {score.quantile(0.5):.4g}{unit}, worst {score.min():.4g}{unit}"
        low, high = int(self.evaluations.min()), int(self.evaluations.max())
        return [
            ("trials", str(len(score))),
            ("transducers", str(self.drive.shape[1])),
            ("foci", str(self.pressure.shape[1])),
            (name, reached),
            ("evaluations", str(low) if low == high else f"{low} to {high}"),
        ]


def joined(solutions: Sequence[Solution]) -> Solution:
    """Return one solution with the trials of several; shorter histories repeat their last score."""
    longest = max(solution.history.shape[1] for solution in solutions)
    histories = [
        torch.cat([history, history[:, -1:].expand(-1, longest - history.shape[1])], dim=1)
        for history in (solution.history for solution in solutions)
    ]
    columns = {
        name: torch.cat([getattr(solution, name) for solution in solutions])
        for name in ("drive", "pressure", "score", "evaluations")
    }
    return Solution(history=torch.cat(histories), **columns)
