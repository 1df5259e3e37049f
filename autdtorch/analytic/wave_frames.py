"""Spherical harmonics along turned axes.

A turn maps the harmonics of each degree onto themselves; the map is fitted to their values at a few
directions.
"""

from __future__ import annotations

import functools

import torch

from autdtorch.analytic.spherical_waves import harmonics
from autdtorch.scene.geometry import sphere_points

_SAMPLES = 2
"""Directions for each harmonic of the highest degree, by which a turn is found."""


def turns(degree: int, turn: torch.Tensor) -> list[torch.Tensor]:
    """Return the map R (..., 2 l + 1, 2 l + 1) of the harmonics of each degree, Y' = Y R, differentiable.

    Y' are those along other axes, the columns of `turn` (..., 3, 3) in the coordinates of Y. Their
    handedness may differ.
    """
    directions, inverses = _directions(degree)
    after = harmonics(degree, directions @ turn)
    return [inverse @ after[..., n * n : (n + 1) ** 2] for n, inverse in enumerate(inverses)]


def turned(waves: torch.Tensor, maps: list[torch.Tensor]) -> torch.Tensor:
    """Return waves (..., M, N), in rows, times the map of each degree."""
    return torch.cat([waves[..., n * n : (n + 1) ** 2] @ each for n, each in enumerate(maps)], dim=-1)


@functools.lru_cache(8)
def _directions(degree: int) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return directions (n, 3), and the inverse (2 l + 1, n) of the harmonics of each degree at these."""
    directions = sphere_points((0.0, 0.0, 0.0), 1.0, _SAMPLES * (2 * degree + 1))
    values = harmonics(degree, directions)
    return directions, [torch.linalg.pinv(values[:, n * n : (n + 1) ** 2]) for n in range(degree + 1)]
