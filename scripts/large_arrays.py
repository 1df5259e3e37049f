"""Scenes with arrays of AUTD3s, each 249 transducers, in place of the paper's 16."""

from __future__ import annotations

import dataclasses

import torch

import autdtorch as at

PITCH = 10.16e-3
PLACES = 18, 14
MISSING = {(1, 1), (2, 1), (16, 1)}
"""Places without a transducer."""
SIZE = 192e-3, 151.4e-3
"""Of a unit [m], its rim included."""
MIDDLE = (1e-3, 50e-3, 50e-3)
"""Where the middle of the paper's array is [m]."""


def autd3_array(units: tuple[int, int] = (1, 1)) -> at.TransducerArray:
    """Units side by side along y and z, around the middle of the paper's array."""
    unit = at.TransducerArray.grid(PLACES, PITCH, MIDDLE)
    kept = unit.positions[[i for i in range(len(unit)) if divmod(i, PLACES[1]) not in MISSING]]
    y, z = (
        size * (torch.arange(count, dtype=torch.float64) - (count - 1) / 2)
        for size, count in zip(SIZE, units, strict=True)
    )
    shifts = torch.cartesian_prod(torch.zeros(1, dtype=torch.float64), y, z)
    positions = (shifts[:, None] + kept).reshape(-1, 3)
    return at.TransducerArray(positions, (1, 0, 0))


def with_array(scene: at.Scene, array: at.TransducerArray) -> at.Scene:
    """The scene with another array, in a domain that holds both."""
    corners = torch.cat((array.positions, torch.tensor(scene.domain, dtype=torch.float64)))
    domain = torch.stack((corners.amin(0) - 3e-3, corners.amax(0) + 3e-3))
    return dataclasses.replace(scene, array=array, domain=domain, observation_plane=None)
