"""Scenes with arrays of AUTD3s, each 249 transducers, in place of the paper's 16."""

from __future__ import annotations

import dataclasses

import torch

import autdtorch as at

MIDDLE = (1e-3, 50e-3, 50e-3)
"""Where the middle of the paper's array is [m]."""


def autd3_array(units: tuple[int, int] = (1, 1)) -> at.TransducerArray:
    """Units side by side along y and z, around the middle of the paper's array; points of its strength."""
    return at.TransducerArray.autd3(
        MIDDLE, units=units, source_strength=at.PAPER_SOURCE_STRENGTH, radius=None
    )


def with_array(scene: at.Scene, array: at.TransducerArray) -> at.Scene:
    """The scene with another array, in a domain that holds both."""
    corners = torch.cat((array.positions, torch.tensor(scene.domain, dtype=torch.float64)))
    domain = torch.stack((corners.amin(0) - 3e-3, corners.amax(0) + 3e-3))
    return dataclasses.replace(scene, array=array, domain=domain, observation_plane=None)
