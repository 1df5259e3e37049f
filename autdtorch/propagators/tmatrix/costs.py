"""The memory and the time of the waves of bodies with known T-matrices, before any is computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from autdtorch.propagators.tmatrix.coupling import ENTRY_BYTES, USUAL_STEPS

# Fitted on one core to 1 to 3 spheres of 10 to 28 mm before 16 or 249 discs, with up to 2 reflectors: memory
# and time are within a factor of two.

_WAVE_SECONDS, _WAVE_BYTES = 2e-7, 200.0
"""Time [s] of a wave of a transducer, or at a point, and of an image of it; memory [bytes] of the first."""

_PAIR_SECONDS, _WAY_SECONDS = 7e-7, 5e-8
"""Time [s] of a pair of unknown waves in the solutions by waves of three degrees, and what an image adds."""

_SCENE_SECONDS, _SCENE_BYTES = 0.02, 6e6
"""Further time [s] and memory [bytes] of a scene."""


@dataclass(frozen=True)
class WaveCosts:
    """The costs of a transfer matrix by T-matrices.

    Attributes:
        waves: of each body.
        images: of each transducer and body, itself among them.
        transducers: of the array.
        points: outside all bodies.
    """

    waves: Sequence[int]
    images: int
    transducers: int
    points: int

    @property
    def memory(self) -> float:
        """The most memory in use at a time [bytes]."""
        return _SCENE_BYTES + ENTRY_BYTES * self._pairs + _WAVE_BYTES * sum(self.waves) * self.transducers

    @property
    def seconds(self) -> float:
        """The time [s]."""
        single = sum(self.waves) * self.images * (self.transducers + self.points)
        pair = _PAIR_SECONDS + _WAY_SECONDS * self.images
        return _SCENE_SECONDS + pair * self._pairs + _WAVE_SECONDS * single

    @property
    def _pairs(self) -> int:
        """Pairs of unknown waves, those that come back to their body; fewer where steps are quicker."""
        unknown = sum(self.waves if self.images > 1 else self.waves[:-1])
        return unknown * min(unknown, USUAL_STEPS * self.transducers)
