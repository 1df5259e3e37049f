"""The orientation of a picture: corners that were marked in another order turn or mirror it."""

from __future__ import annotations

from collections.abc import Callable

import torch

from autdtorch.hardware.camera.picture import Picture

_BETTER = 0.2  # by which a turned picture must correlate better with the expected one

_TURNS: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], bool]] = {  # true: swaps the axes
    "turned by half": (lambda map_: map_.rot90(2), False),
    "mirrored along u": (lambda map_: map_.flip(0), False),
    "mirrored along v": (lambda map_: map_.flip(1), False),
    "turned by a quarter": (lambda map_: map_.rot90(1), True),
    "turned by three quarters": (lambda map_: map_.rot90(3), True),
    "mirrored along a diagonal": (lambda map_: map_.T, True),
    "mirrored along the other diagonal": (lambda map_: map_.rot90(2).T, True),
}


def turned(picture: Picture, expected: torch.Tensor) -> str | None:
    """Return how a picture is turned against the expected pressure (Nu, Nv) [Pa]; None if it is not.

    A symmetric field does not show it.
    """
    seen, square = picture.pressure.square(), expected.square()
    is_square = seen.shape[0] == seen.shape[1]
    alike = {
        name: _correlation(turn(seen), square)
        for name, (turn, swaps) in _TURNS.items()
        if is_square or not swaps
    }
    best = max(alike, key=lambda name: alike[name])
    return best if alike[best] > _correlation(seen, square) + _BETTER else None


def _correlation(one: torch.Tensor, other: torch.Tensor) -> float:
    return float(torch.corrcoef(torch.stack([one.reshape(-1), other.reshape(-1)]))[0, 1])
