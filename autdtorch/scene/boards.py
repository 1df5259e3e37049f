"""The boards of devices: places of their transducers in the plane, source strengths and sizes."""

from __future__ import annotations

import torch

from autdtorch.utils.array_types import REAL

# Source strengths [Pa m] in programs for the devices. They differ by nearly a factor of 2 for similar
# transducers, and not all say whether they are peak or RMS values: measure yours.
AUTD3_SOURCE_STRENGTH = 4.386  # AUTD3 SDK
OPENMPD_SOURCE_STRENGTH = 3.4  # AcousTools
SONICSURFACE_SOURCE_STRENGTH = 2.53  # Ultraino

TRANSDUCER_RADIUS = 4.5e-3
"""Radius of the radiating disc of a 10 mm transducer for 40 kHz [m] (AcousTools, Ultraino)."""

AUTD3_TRANSDUCERS = 249
AUTD3_UNIT = 192e-3, 151.4e-3
"""Width and height of an AUTD3 unit with its rim [m]."""

_AUTD3_PLACES, _AUTD3_PITCH = (18, 14), 10.16e-3
_AUTD3_MISSING = {(1, 1), (2, 1), (16, 1)}  # grid places (x, y) of screws and connectors
_SQUARE_PLACES, _SQUARE_PITCH = 16, 10.5e-3


def grid_places(count_u: int, count_v: int, pitch: float) -> torch.Tensor:
    """Return positions (M, 2) of a grid around 0, the last axis fastest; in the unit of the pitch."""
    return torch.cartesian_prod(pitch * _centred(count_u), pitch * _centred(count_v)).reshape(-1, 2)


def autd3_places(count_x: int, count_y: int) -> torch.Tensor:
    """Return positions (M, 2) [m] along x and y of AUTD3 units, as in autd3-core 0.12.

    A unit is row by row with x fastest; of several units, y is fastest.
    """
    along_x, along_y = (_AUTD3_PITCH * _centred(count) for count in _AUTD3_PLACES)
    unit = [
        (x, y)
        for j, y in enumerate(along_y.tolist())
        for i, x in enumerate(along_x.tolist())
        if (i, j) not in _AUTD3_MISSING
    ]
    width, height = AUTD3_UNIT
    shifts = torch.cartesian_prod(width * _centred(count_x), height * _centred(count_y))
    return (shifts[:, None] + torch.tensor(unit, **REAL)).reshape(-1, 2)


def square_places() -> torch.Tensor:
    """Return positions (16, 16, 2) [m] along x and y of a square board, by columns from the largest y."""
    across = _SQUARE_PITCH * _centred(_SQUARE_PLACES)
    return torch.stack(torch.meshgrid(across, -across, indexing="ij"), dim=-1)


def _centred(count: int) -> torch.Tensor:
    """Return `count` positions one apart, around 0."""
    return torch.arange(count, **REAL) - (count - 1) / 2
