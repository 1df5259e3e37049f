"""The transducer array: where the transducers are, where they point, how strong they are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from autdtorch.geometry import plane_basis
from autdtorch.validation import (
    ArrayLike,
    finite_vector,
    points_tensor,
    positive,
    positive_integers,
    real_tensor,
    require_distinct,
    unit_vector,
)

#: On-axis pressure of a transducer at full drive, times distance [Pa m], in the paper's Eq. 2.
PAPER_SOURCE_STRENGTH = 1 / (4 * math.pi)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class TransducerArray:
    """M transducers of equal strength. The tensors are the array's own copies, on the CPU.

    Attributes:
        positions: (M, 3) [m], float64, all different.
        normals: directions of emission (M, 3), float64, of length 1.
        source_strength: on-axis pressure at full drive times distance [Pa m], > 0.
    """

    positions: torch.Tensor
    normals: torch.Tensor
    source_strength: float

    def __init__(
        self, positions: ArrayLike, normals: ArrayLike, source_strength: float = PAPER_SOURCE_STRENGTH
    ) -> None:
        """Check and copy the input.

        Args:
            positions: (M, 3) [m], M >= 1.
            normals: (M, 3), or (3,) for all; of any length > 0.
            source_strength: [Pa m], > 0.

        Raises:
            ValueError: not finite, wrong shape, zero normal, strength <= 0, or two transducers in one place.
        """
        places = points_tensor("TransducerArray.positions", positions).cpu()
        require_distinct("TransducerArray.positions", places)
        object.__setattr__(self, "positions", places)
        object.__setattr__(self, "normals", _unit_normals(normals, len(places)))
        strength = positive("TransducerArray.source_strength", source_strength, "Pa m")
        object.__setattr__(self, "source_strength", strength)

    @classmethod
    def grid(
        cls,
        shape: tuple[int, int],
        pitch: float,
        center: ArrayLike,
        normal: ArrayLike = (1.0, 0.0, 0.0),
        source_strength: float = PAPER_SOURCE_STRENGTH,
    ) -> TransducerArray:
        """A flat rectangular array; transducer i * shape[1] + j is i pitches along u and j along v.

        Args:
            shape: numbers of transducers along u and v, the axes of `plane_basis(normal)`.
            pitch: distance of neighbours [m], > 0.
            center: centre of the array (3,) [m].
            normal: direction of emission (3,).
            source_strength: [Pa m], > 0.

        Raises:
            ValueError: an argument is not finite, has the wrong shape or is out of range.
        """
        count_u, count_v = positive_integers("shape", shape, 2)
        pitch = positive("pitch", pitch, "m")
        middle = torch.tensor(finite_vector("center", center), dtype=torch.float64)
        u, v = plane_basis(normal)
        along_u = pitch * (torch.arange(count_u, dtype=torch.float64) - (count_u - 1) / 2)
        along_v = pitch * (torch.arange(count_v, dtype=torch.float64) - (count_v - 1) / 2)
        positions = middle + along_u[:, None, None] * u + along_v[None, :, None] * v
        return cls(positions.reshape(-1, 3), normal, source_strength)

    def __len__(self) -> int:
        """Number of transducers M."""
        return len(self.positions)

    def __repr__(self) -> str:
        """Count, centre and strength, with units."""
        x, y, z = (1e3 * self.positions.mean(dim=0)).tolist()
        return (
            f"TransducerArray({len(self)} transducers around ({x:.4g}, {y:.4g}, {z:.4g}) mm, "
            f"source strength {self.source_strength:.4g} Pa m)"
        )


def _unit_normals(normals: ArrayLike, count: int) -> torch.Tensor:
    name = "TransducerArray.normals"
    rows = real_tensor(name, normals).detach().cpu()
    if rows.shape == (3,):
        return torch.tensor(unit_vector(name, rows), dtype=torch.float64).repeat(count, 1)
    if rows.shape != (count, 3):
        raise ValueError(f"{name}: shape {tuple(rows.shape)}; must be (3,) or ({count}, 3) as positions")
    return torch.tensor([unit_vector(f"{name}[{m}]", row) for m, row in enumerate(rows)], dtype=torch.float64)
