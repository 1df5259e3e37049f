"""A body's T-matrix and its poses, which waves between bodies, arrays and points see of a `TMatrix`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch

from autdtorch.utils.validation import LENGTH_TOLERANCE


@dataclass(frozen=True, eq=False)
class BodyMatrix:
    """A body that scatters sound, in one pose or in many; `TMatrix` describes the attributes."""

    matrix: torch.Tensor
    wavenumber: complex
    radius: float
    center: torch.Tensor
    axes: torch.Tensor

    @property
    def degree(self) -> int:
        """The largest degree of the waves."""
        return math.isqrt(len(self.matrix)) - 1

    @property
    def varies(self) -> bool:
        """True if gradients by the body are asked for."""
        return any(part.requires_grad for part in (self.matrix, self.center, self.axes))

    def in_poses(self, poses: Sequence[int]) -> Self:
        """Return the body with poses of these leading dimensions."""
        return replace(self, center=self.center.expand(*poses, 3), axes=self.axes.expand(*poses, 3, 3))

    def some_poses(self, first: int, count: int) -> Self:
        """Return the body in some of its poses, counted over all leading dimensions."""
        some = slice(first, first + count)
        return replace(self, center=self.center.reshape(-1, 3)[some], axes=self.axes.reshape(-1, 3, 3)[some])

    def with_next_degree(self) -> Self:
        """Return the body with a degree more, which it does not scatter."""
        more = 2 * self.degree + 3
        return replace(self, matrix=torch.nn.functional.pad(self.matrix, (0, more, 0, more)))

    def offsets(self, name: str, positions: torch.Tensor) -> torch.Tensor:
        """Return positions (..., P, 3) in the body's coordinates, after checking that they are outside."""
        offsets = positions - self.center[..., None, :]
        nearest = float(torch.linalg.vector_norm(offsets.detach(), dim=-1).amin())
        if nearest < self.radius - LENGTH_TOLERANCE:
            accepted = f"must be at least {self.radius:.4g} m from the centre of the body"
            raise ValueError(f"{name}: {nearest:.4g} m at the nearest; {accepted}")
        return offsets @ self.axes
