"""The power that obstacles and reflectors absorb."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from autdtorch.analytic.green import directivity
from autdtorch.scene.arrays import apertures_of, complex_strengths_of
from autdtorch.scene.scene import Scene
from autdtorch.utils.apertures import Discs, centers_of, image_of
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.images import Mirror, images_of
from autdtorch.utils.validation import invalid

_MORE = 20
"""Degrees of a far field beyond wavenumber times radius: those that are left out are below 1e-6."""

_AT_ONCE = 4_000_000
"""Pairs of a direction and a source whose waves are in memory at once."""


class AbsorbedPower(NamedTuple):
    """The power [W] that each obstacle (..., K) and each reflector (..., J) absorbs, float64."""

    obstacles: torch.Tensor
    reflectors: torch.Tensor


class Radiators(NamedTuple):
    """Points or discs that radiate as an array, or as the bodies in front of mirrors, without images."""

    places: torch.Tensor | Discs  # points (n, 3) [m]
    amplitude: torch.Tensor  # (n, R) [Pa m] in R runs
    mirrors: tuple[int, ...] = ()  # numbers of those whose images they hold


def radiators_of_array(scene: Scene, drive: torch.Tensor) -> Radiators:
    """Return the transducers of a scene, for drives (R, M)."""
    return Radiators(apertures_of(scene.array).places, (complex_strengths_of(scene.array) * drive).mT)


def power_into_reflectors(scene: Scene, parts: Sequence[Radiators], runs: int) -> torch.Tensor:
    """Return the power (R, J) [W] that reflectors absorb in R runs, from all that radiates without images.

    With the field u of radiators and their images in all other planes, a plane of reflection R adds R times
    the image of u. It then absorbs (1 - R^2) times the power that u sends to its far side.

    Raises:
        ValueError: a reflector that absorbs has a complex reflection, or another that faces it.
    """
    mirrors = [reflector.mirror for reflector in scene.reflectors]
    power = torch.zeros((runs, len(mirrors)), **REAL)
    for number, mirror in enumerate(mirrors):
        if abs(mirror.reflection) >= 1:
            continue
        others = {index: other for index, other in enumerate(mirrors) if index != number}
        if mirror.reflection.imag or any(mirror.is_parallel(other) for other in others.values()):
            accepted = "absorbs a known power only if it is real and no other reflector faces it"
            raise invalid(f"reflectors[{number}].reflection", mirror.reflection, accepted)
        share = 1 - mirror.reflection.real**2
        power[:, number] = share * _power_behind(scene, mirror, others, parts)
    return power


def _power_behind(
    scene: Scene, mirror: Mirror, others: Mapping[int, Mirror], parts: Sequence[Radiators]
) -> torch.Tensor:
    """Return the power (R,) [W] that radiators and their images in other mirrors send behind a mirror."""
    everything: list[tuple[torch.Tensor | Discs, torch.Tensor]] = []
    for part in parts:
        missing = [other for number, other in others.items() if number not in part.mirrors]
        for image in images_of(missing, scene.complex_wavenumber, 1.0):
            everything.append((image_of(part.places, image), image.weight * part.amplitude.to(**COMPLEX)))
    centers = torch.cat([centers_of(each) for each, _ in everything])
    middle = (centers.amax(dim=0) + centers.amin(dim=0)) / 2
    radii = [float(each.radii.max()) for each, _ in everything if isinstance(each, Discs)]
    reach = float((centers - middle).norm(dim=1).max()) + max(radii, default=0.0)
    total = torch.zeros(everything[0][1].shape[1], **REAL)
    for directions, area in _half_sphere(math.ceil(scene.wavenumber * reach) + _MORE, mirror, len(centers)):
        parts_of = [
            _far_waves(directions, each, middle, scene.wavenumber) @ part for each, part in everything
        ]
        total += area @ torch.stack(parts_of).sum(dim=0).abs().square()
    return total / (2 * scene.medium.density * scene.medium.sound_speed)


def _far_waves(
    directions: torch.Tensor, places: torch.Tensor | Discs, middle: torch.Tensor, wavenumber: float
) -> torch.Tensor:
    """Return the far field (n, N) of points or discs in directions (n, 3); at the middle the phase is 0."""
    turn = -wavenumber * directions @ (centers_of(places) - middle).mT
    waves = torch.polar(torch.ones((), **REAL), turn)
    if not isinstance(places, Discs):
        return waves
    sine = (1 - (directions @ places.normals.mT) ** 2).clamp(min=0).sqrt()
    return waves * directivity(wavenumber * places.radii * sine)


def _half_sphere(degree: int, mirror: Mirror, count: int) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield directions (n, 3) behind a mirror and their solid angles (n,), a few at a time."""
    heights, weights = np.polynomial.legendre.leggauss(degree + 1)
    heights, weights = (heights + 1) / 2, weights / 2  # products of two waves, over half of the sphere
    turns = 2 * math.pi * torch.arange(2 * degree + 1, **REAL) / (2 * degree + 1)
    normal = torch.tensor(mirror.normal, **REAL)
    _, _, basis = torch.linalg.svd(normal[None])
    around = torch.cos(turns)[:, None] * basis[1] + torch.sin(turns)[:, None] * basis[2]
    rows = max(1, _AT_ONCE // (count * len(turns)))
    for first in range(0, len(heights), rows):
        height = torch.from_numpy(heights[first : first + rows])[:, None, None]
        directions = (1 - height**2).sqrt() * around - height * normal
        area = torch.from_numpy(weights[first : first + rows]).repeat_interleave(len(turns))
        yield directions.reshape(-1, 3), area * 2 * math.pi / len(turns)
