"""A simulation in boxes that keeps outgoing fields, so that new points and planes take sums, not runs.

Outside the boxes, the Huygens surfaces radiate the whole scattered field. Their amplitudes are kept for the
last drives and, once that has paid, for all transducers. A few points take fewer runs than the transducers
(reciprocity). After as many runs from points as the transducers would have taken, these are simulated. That
is at most twice the fewest runs, however many points follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from autdtorch.fdtd.scattered_field import ScatteredField
from autdtorch.fdtd.symmetry import Symmetry, orbits_of_array
from autdtorch.propagators.box import BoxSimulation, Solved
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.simulation import Run, TransferMatrix
from autdtorch.scene.arrays import apertures_of, strengths_of
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX, Index
from autdtorch.utils.cached import cached_property

_MOST_BYTES = 1e9  # of the amplitudes of all transducers
_DRIVES = 16  # Drives whose fields are kept
_ENTRY_BYTES = 16  # of complex128


@dataclass(frozen=True)
class KeptFields:
    """Amplitudes (n, K) [Pa m] of the Huygens surface of each box under K drives, and the runs they took."""

    boxes: Sequence[ScatteredField]
    amplitudes: Sequence[torch.Tensor]
    runs: tuple[Run, ...]

    def scattered(self, receivers: Apertures, weights: torch.Tensor | None) -> torch.Tensor:
        """Return the scattered field (R, P) at receivers outside the boxes, of sums with weights (R, K).

        Without weights, each drive has a row.
        """
        amplitudes = [own if weights is None else own @ weights.mT for own in self.amplitudes]
        parts = zip(self.boxes, amplitudes, strict=True)
        return torch.stack([box.near_to_far(receivers).radiated(own) for box, own in parts]).sum(dim=0).mT


class KeepingSimulation(BoxSimulation):
    """FDTD of the scattered field in boxes, whose outgoing fields are kept."""

    def __init__(self, plan: Plan) -> None:
        """Make the simulation of a plan; nothing is computed yet."""
        super().__init__(plan)
        self._transducers: KeptFields | None = None
        self._drives: dict[bytes, KeptFields] = {}
        self._runs_from_points, self._apart = 0, True

    def matrix_runs(self, points: torch.Tensor) -> int:
        """Return the number of runs that the transfer matrix of points (P, 3) takes."""
        if not self._keeps(points) or self._begins_at(points):
            return super().matrix_runs(points)
        return self._fewest if self._transducers is None else 0

    def matrix_pays(self, drives: int, points: torch.Tensor) -> bool:
        """Return whether so many drives take longer than the transfer matrix of points (P, 3)."""
        if self._keeps(points) and self._transducers is not None:
            return drives > len(self.plan.scene.array)  # sums for each
        return super().matrix_pays(drives, points)

    def transfer_matrix(self, points: torch.Tensor) -> TransferMatrix:
        """Simulate the transfer matrix of points (P, 3), or sum the kept fields of the transducers."""
        if not self._keeps(points):
            return super().transfer_matrix(points)
        if self._begins_at(points):
            found = super().transfer_matrix(points)
            self._runs_from_points += len(found.runs)
            return found
        new = self._keep_transducers(points)
        if self._transducers is None:  # the boxes are simulated as one
            return super().transfer_matrix(points)
        unit = torch.eye(len(self.plan.scene.array), **COMPLEX)
        field = self._sum(self._transducers, None, unit, points)
        kept = self._transducers.runs
        remaining, periods = max(run.remaining for run in kept), max(run.periods for run in kept)
        return TransferMatrix(field.mT.contiguous(), remaining, periods, tuple(new), from_points=False)

    def fields(self, drive: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, list[Run]]:
        """Return the pressure (R, P) [Pa] of drives (R, M), none of them silent, and the runs it took."""
        if not self._keeps(points):
            return super().fields(drive, points)
        if self._transducers is not None:
            return self._sum(self._transducers, drive, drive, points), []
        keys, kept = [row.numpy().tobytes() for row in drive], self._drives
        known = [row for row, key in enumerate(keys) if key in kept]
        new = [row for row, key in enumerate(keys) if key not in kept]
        field = torch.zeros((len(drive), len(points)), **COMPLEX)
        for row in known:
            field[row] = self._sum(kept[keys[row]], None, drive[row, None], points)[0]
        if not new:
            return field, []
        array, receivers = self.plan.scene.array, Apertures.of_points(points)
        sources, strength = [apertures_of(array)] * len(new), strengths_of(array) * drive[new]
        solved = self._stepped(sources, strength, receivers)
        field[new] = self.total(solved)
        if self._apart:
            amplitudes = solved.amplitudes
            each = (
                KeptFields(solved.boxes, [own[:, place, None].clone() for own in amplitudes], (run,))
                for place, run in enumerate(solved.runs)
            )
            added = zip([keys[row] for row in new], each, strict=True)
            self._drives = dict([*kept.items(), *added][-_DRIVES:])
        return field, solved.runs

    def _keeps(self, points: torch.Tensor) -> bool:
        """Return whether kept fields can be summed at points (P, 3)."""
        return self._apart and self._is_fit and not any(box.inside(points).any() for box in self.boxes)

    @cached_property
    def _is_fit(self) -> bool:
        """True if the fields fit into memory, and no source is next to an obstacle.

        For such sources, runs that begin at points are more accurate.
        """
        size = _ENTRY_BYTES * len(self.plan.scene.array) * sum(len(box.surface[0]) for box in self.boxes)
        nodes = self.plan.scene.array.nodes.positions.reshape(-1, 3)
        return size <= _MOST_BYTES and not self.near_obstacle(nodes)

    def _begins_at(self, points: torch.Tensor) -> bool:
        """Return whether the matrix of points (P, 3) is simulated from these."""
        orbits = self.orbits(points)
        few = self._runs_from_points + orbits.runs <= self._fewest
        return self._transducers is None and orbits.from_points and few

    @property
    def _fewest(self) -> int:
        """Runs that the fields of all transducers take."""
        return len(np.unique(orbits_of_array(self.symmetries)[0]))

    def _keep_transducers(self, points: torch.Tensor) -> list[Run]:
        """Simulate the fields of all transducers, judged at points (P, 3); return the runs it took.

        Under a symmetry that maps a transducer to its representative, cells of the surface map to cells.
        """
        if self._transducers is not None:
            return []
        representative, symmetry = orbits_of_array(self.symmetries)
        first, place = np.unique(representative, return_inverse=True)
        array = self.plan.scene.array
        alone = [apertures_of(array).chosen(slice(own, own + 1)) for own in first]
        strength = torch.ones((len(alone), 1), **COMPLEX)
        solved = self._stepped(alone, strength, Apertures.of_points(points))
        if self._apart:
            amplitudes = []
            for box, own in zip(solved.boxes, solved.amplitudes, strict=True):
                images = np.stack([_images(box, each) for each in self.symmetries])
                unit = own[torch.from_numpy(images[symmetry].T), torch.from_numpy(place)]
                amplitudes.append(strengths_of(array) * unit)
            self._transducers = KeptFields(solved.boxes, amplitudes, tuple(solved.runs))
        return solved.runs

    def _stepped(self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures) -> Solved:
        """Simulate runs, and note whether the boxes were simulated apart, not in one."""
        self._refuse_enclosed_transducers()
        with self._progress(len(sources)) as progress:
            solved = self.solved(sources, strength, receivers, progress.advance)
        self._apart = solved.boxes is self.boxes
        return solved

    def _sum(
        self, kept: KeptFields, weights: torch.Tensor | None, drive: torch.Tensor, points: torch.Tensor
    ) -> torch.Tensor:
        """Return the pressure (R, P) of drives (R, M), which have the weights (R, K) among kept fields.

        Without weights, they are those that were kept.
        """
        array, receivers = self.plan.scene.array, Apertures.of_points(points)
        sources, strength = [apertures_of(array)] * len(drive), strengths_of(array) * drive
        return self.incident(sources, strength, receivers).mT + kept.scattered(receivers, weights)


def _images(box: ScatteredField, symmetry: Symmetry) -> Index:
    """Return for each cell of the Huygens surface the place of its image among them."""
    places = box.surface[0].numpy() - symmetry.center
    if (symmetry.matrix == np.eye(3)).all():
        return np.arange(len(places))
    return np.asarray(KDTree(places).query(places @ symmetry.matrix.T)[1], np.int64)
