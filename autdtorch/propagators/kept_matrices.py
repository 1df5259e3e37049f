"""Transfer matrices that a propagator keeps, so that more drives at known points take no runs.

A single drive takes one run, the matrix of a plane as many as the transducers. When a plane has taken as many
runs of drives since its matrix was last kept, its matrix is simulated: at most twice the fewest runs, however
many drives follow. A matrix that is too large to be kept is never simulated for this reason.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from autdtorch.propagators.simulation import TransferMatrix
from autdtorch.utils.digest import digest_of

_MOST_BYTES = 2.5e8  # of all matrices; a plane of 10,000 points and 256 transducers has 4e7
_MOST_PLANES = 1000  # whose runs are counted, 100 bytes each: a plane that moves is another one every time


class KeptMatrices:
    """Transfer matrices of the last points that were asked for, and the runs that drives took at planes."""

    def __init__(self, transducers: int) -> None:
        """Start with none; the matrices have so many columns."""
        self._transducers = transducers
        self._matrices: dict[str, TransferMatrix] = {}
        self._runs: dict[str, int] = {}

    @property
    def bytes(self) -> int:
        """Memory of all matrices."""
        return sum(kept.matrix.nbytes for kept in self._matrices.values())

    def get(self, points: torch.Tensor) -> TransferMatrix | None:
        """Return the matrix of points (P, 3), if it was kept."""
        return self._matrices.get(digest_of(points))

    def add(self, points: torch.Tensor, result: TransferMatrix) -> TransferMatrix | None:
        """Keep the matrix of points (P, 3), and let the oldest go that no longer fit into the memory.

        Returns:
            The matrix that is kept, which may be the one given and is not to be changed; None if it is larger
            than the memory.
        """
        if not self._fits(points):
            return None
        if result.matrix.is_inference():
            with torch.inference_mode(False):  # later calls may need gradients
                result = replace(result, matrix=result.matrix.clone())
        key = digest_of(points)
        self._matrices[key] = result
        self._runs.pop(key, None)
        for oldest in list(self._matrices)[:-1]:
            if self.bytes <= _MOST_BYTES:
                break
            del self._matrices[oldest]
        return result

    def runs(self, points: torch.Tensor) -> int:
        """Return the runs that drives have taken at points (P, 3) whose matrix is not kept but could be."""
        return self._runs.get(digest_of(points), 0)

    def count(self, points: torch.Tensor, runs: int) -> None:
        """Add runs that drives took at points (P, 3)."""
        if not self._fits(points):
            return
        key = digest_of(points)
        self._runs[key] = self._runs.pop(key, 0) + runs
        if len(self._runs) > _MOST_PLANES:
            del self._runs[next(iter(self._runs))]

    def _fits(self, points: torch.Tensor) -> bool:
        """Return whether the complex128 matrix of points (P, 3) is small enough to be kept."""
        return len(points) * self._transducers * torch.complex128.itemsize <= _MOST_BYTES
