"""Layouts of commercial and open phased arrays, in the order of the device.

Positions (M, 2) [m] are along the device's x and y from its centre, as seen from the side of emission.
"""

from __future__ import annotations

import torch

TRANSDUCER_RADIUS = 4.5e-3
"""Radius of the radiating disc of a 10 mm transducer for 40 kHz [m] (AcousTools, Ultraino)."""

# Source strengths [Pa m] in programs for the devices. They differ by nearly a factor of 2 for similar
# transducers, and not all say whether peak or RMS: measure your own.
AUTD3_SOURCE_STRENGTH = 4.386  # AUTD3 SDK
OPENMPD_SOURCE_STRENGTH = 3.4  # AcousTools
SONICSURFACE_SOURCE_STRENGTH = 2.53  # Ultraino

AUTD3_TRANSDUCERS = 249
AUTD3_UNIT = 192e-3, 151.4e-3
"""Width and height of an AUTD3 unit with its rim [m]."""

_AUTD3_PLACES, _AUTD3_PITCH = (18, 14), 10.16e-3
_AUTD3_MISSING = {(1, 1), (2, 1), (16, 1)}  # grid places (x, y) of screws and connectors
_SQUARE_PLACES, _SQUARE_PITCH = 16, 10.5e-3


def autd3_places(units: tuple[int, int] = (1, 1)) -> torch.Tensor:
    """Return the positions of AUTD3 units: row by row with x fastest; of several units, y fastest.

    Source: autd3-core 0.12.
    """
    along_x, along_y = (_AUTD3_PITCH * centred(count) for count in _AUTD3_PLACES)
    unit = [
        (x, y)
        for j, y in enumerate(along_y.tolist())
        for i, x in enumerate(along_x.tolist())
        if (i, j) not in _AUTD3_MISSING
    ]
    shifts = torch.cartesian_prod(
        *(size * centred(count) for size, count in zip(AUTD3_UNIT, units, strict=True))
    )
    return (shifts[:, None] + torch.tensor(unit, dtype=torch.float64, device="cpu")).reshape(-1, 2)


def sonicsurface_places() -> torch.Tensor:
    """Return the 256 positions of a SonicSurface: row by row from the largest y down, x fastest.

    Source: the table of emitters in its Python program, before the permutation to channels.
    """
    across = _SQUARE_PITCH * centred(_SQUARE_PLACES)
    return torch.cartesian_prod(-across, across).flip(1)


def openmpd_places() -> torch.Tensor:
    """Return the 256 positions of an OpenMPD board: columns from the smallest x, each from the largest y.

    Source: the positions in the board files of OpenMPD and AcousTools.
    """
    across = _SQUARE_PITCH * centred(_SQUARE_PLACES)
    return torch.cartesian_prod(across, -across)


def centred(count: int) -> torch.Tensor:
    """Return `count` positions one apart, around 0."""
    return torch.arange(count, dtype=torch.float64, device="cpu") - (count - 1) / 2
