"""Transfer matrices that a propagator keeps, so that more drives at known points take no runs.

A single drive takes one run, the matrix of a plane as many as the transducers. When a plane has taken as many
runs of drives, its matrix is simulated: at most twice the fewest runs, however many drives follow.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from autdtorch.propagators.simulation import TransferMatrix
from autdtorch.utils.digest import digest_of

_MOST_BYTES = 2.5e8  # of all matrices; a plane of 10,000 points and 256 transducers has 4e7


class KeptMatrices:
    """Transfer matrices of the last points that were asked for, and the runs that drives took at planes."""

    def __init__(self) -> None:
        """Start with none."""
        self._matrices: dict[str, TransferMatrix] = {}
        self._runs: dict[str, int] = {}

    def get(self, points: torch.Tensor) -> TransferMatrix | None:
        """Return the matrix of points (P, 3), if it was kept."""
        return self._matrices.get(digest_of(points))

    def add(self, points: torch.Tensor, result: TransferMatrix) -> None:
        """Keep the matrix of points (P, 3), and let the oldest go that no longer fit into the memory."""
        with torch.inference_mode(False):  # later calls may need gradients
            self._matrices[digest_of(points)] = replace(result, matrix=result.matrix.clone())
        sizes = {
            key: kept.matrix.numel() * kept.matrix.element_size() for key, kept in self._matrices.items()
        }
        for key in list(sizes)[:-1]:
            if sum(sizes.values()) <= _MOST_BYTES:
                return
            del self._matrices[key], sizes[key]

    def runs(self, points: torch.Tensor) -> int:
        """Return the runs that drives have taken at points (P, 3)."""
        return self._runs.get(digest_of(points), 0)

    def count(self, points: torch.Tensor, runs: int) -> None:
        """Add runs that drives took at points (P, 3)."""
        self._runs[digest_of(points)] = self.runs(points) + runs
