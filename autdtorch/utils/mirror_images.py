"""Mirror images in planes that reflect: copies of the space, each with a weight for its waves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import LENGTH_TOLERANCE, Vector

_RIGHT_ANGLE = 1e-6
"""Largest cosine between the normals of perpendicular planes; of parallel ones, the sine."""

_FEWEST, _MOST = 10, 400
"""Range of the number of images on each side of two parallel planes."""

_CYCLES = 14.0
"""Turns of the phase of successive images over the series of two parallel planes. With 14, what is left out
is below 1e-4 of the field of 200 drawn scenes, as the tail fades out smoothly; with 10 up to 1.5e-4, with 5
up to 1e-3 (`docs/decisions/room.md`)."""

_NEGLIGIBLE = 1e-6
"""Weight of an image, relative to the first, that ends the series of two planes that absorb."""

_REACH = 1.5
"""Distance up to which the images of two parallel planes have their full weights. The unit is the distance of
the images that send the steepest guided wave across the scene."""

_PLATEAU = 0.3
"""Share of the images of two parallel planes before the tail begins to fade out."""


class Image(NamedTuple):
    """A copy of the space: places x go to `matrix` x + `offset`, and `weight` multiplies their waves."""

    matrix: torch.Tensor  # orthogonal (3, 3)
    offset: torch.Tensor  # (3,) [m]
    weight: complex

    def of(self, places: torch.Tensor) -> torch.Tensor:
        """Return the images (..., 3) of places (..., 3) [m]."""
        return places @ self.matrix.mT + self.offset

    def after(self, other: Image) -> Image:
        """Return the image of an image: first `other`, then this one."""
        return Image(self.matrix @ other.matrix, self.of(other.offset), self.weight * other.weight)


SPACE_ITSELF = Image(torch.eye(3, **REAL), torch.zeros(3, **REAL), 1.0)
"""The identity, which is the first of all images."""

NO_MIRRORS = (SPACE_ITSELF,)
"""The images of a space without mirrors."""


@dataclass(frozen=True)
class Mirror:
    """A plane with a reflection factor; its unit normal points into the space in front of it."""

    point: Vector  # [m]
    normal: Vector
    reflection: complex

    @property
    def image(self) -> Image:
        """The image of the space in front of it."""
        normal = torch.tensor(self.normal, **REAL)
        matrix = torch.eye(3, **REAL) - 2 * normal[:, None] * normal
        return Image(matrix, 2 * torch.tensor(self.point, **REAL) @ normal * normal, self.reflection)

    def height(self, places: torch.Tensor) -> torch.Tensor:
        """Return the distance (...) [m] of places (..., 3) in front of it, negative behind."""
        return (places - places.new_tensor(self.point)) @ places.new_tensor(self.normal)

    def is_parallel(self, other: Mirror) -> bool:
        """Return whether another plane is parallel."""
        return bool(np.linalg.norm(np.cross(self.normal, other.normal)) < _RIGHT_ANGLE)

    def is_perpendicular(self, other: Mirror) -> bool:
        """Return whether another plane is at a right angle."""
        return abs(float(np.dot(self.normal, other.normal))) < _RIGHT_ANGLE


def images_of(
    mirrors: Sequence[Mirror], wavenumber: complex, size: float, held: Sequence[Mirror] = ()
) -> tuple[Image, ...]:
    """Return the images of a space in mirrors, the space itself first.

    Mirrors are perpendicular, or pairs of parallel ones that face each other. Those have an infinite series
    of images; what is left out is below 1e-4 of the field, except next to a resonance (`series_phase`).

    Args:
        mirrors: the mirrors.
        wavenumber: k + i alpha of the medium [rad/m].
        size: diameter of the scene [m].
        held: mirrors, never two that face each other, in which the places are with their images already. Of
            each pair of images that differ by these, there is one. The inverse of each is among them, so that
            echoes are reciprocal although a grid along tilted faces is not its own image.
    """
    images, rest = [SPACE_ITSELF], list(mirrors)
    while rest:
        first = rest.pop(0)
        facing = next((other for other in rest if first.is_parallel(other)), None)
        if facing is None:
            copies = [SPACE_ITSELF] if first in held else [SPACE_ITSELF, first.image]
        else:
            rest.remove(facing)
            copies = _between(first, facing, wavenumber, size, held)
        images = [copy.after(other) for other in images for copy in copies]
    return tuple(images)


def resonates(first: Mirror, second: Mirror, wavenumber: complex) -> bool:
    """Return whether the series of images in two facing planes ends before it has converged to 1e-4."""
    fading = _decay(first, second, wavenumber) ** _MOST > _NEGLIGIBLE
    return fading and _MOST * series_phase(first, second, wavenumber) < _CYCLES


def series_phase(first: Mirror, second: Mirror, wavenumber: complex) -> float:
    """Return the phase [turns, 0 to 0.5] by which a round trip between two facing planes misses a resonance.

    At zero the space between them resonates across, and its field grows without limit.
    """
    turns = _turns(first, second, wavenumber)
    return abs(turns - round(turns))


def _turns(first: Mirror, second: Mirror, wavenumber: complex) -> float:
    """Return the phase [turns] of a round trip between two facing planes."""
    turns = (wavenumber.real * 2 * _gap(first, second)) / (2 * math.pi)
    return turns + float(np.angle(first.reflection * second.reflection)) / (2 * math.pi)


def _steepest(first: Mirror, second: Mirror, wavenumber: complex) -> float:
    """Return the slope of the steepest wave guided between two facing planes: its rise for each run.

    Around the images in its direction, whose phases agree, the series gives its amplitude.
    """
    turns = _turns(first, second, wavenumber)
    cosine = 1 - (turns - math.floor(turns)) / (wavenumber.real * _gap(first, second) / math.pi)
    return cosine / math.sqrt(max(1 - cosine**2, 1 / _MOST**2))


def _gap(first: Mirror, second: Mirror) -> float:
    return abs(float(first.height(torch.tensor(second.point, **REAL))))


def _decay(first: Mirror, second: Mirror, wavenumber: complex) -> float:
    """Return the ratio of pressures before and after a round trip between two facing planes."""
    return abs(first.reflection * second.reflection) * math.exp(-2 * wavenumber.imag * _gap(first, second))


def _between(
    first: Mirror, second: Mirror, wavenumber: complex, size: float, held: Sequence[Mirror]
) -> list[Image]:
    """Return the images of the space between two parallel planes, whose weights fade out; see `images_of`."""
    gap = _gap(first, second)
    decay = _decay(first, second, wavenumber)
    trips = _CYCLES / max(series_phase(first, second, wavenumber), _CYCLES / _MOST)
    trips = max(trips, _REACH * size * _steepest(first, second, wavenumber) / (2 * gap * _PLATEAU))
    if decay < 1:
        trips = min(trips, math.log(_NEGLIGIBLE) / math.log(max(decay, _NEGLIGIBLE)))
    count = min(max(math.ceil(trips), _FEWEST), _MOST)
    images, whole_trips = [SPACE_ITSELF], first in held or second in held
    for mirrors in ((first, second), (second, first)):
        image = SPACE_ITSELF
        for number in range(1, 2 * count):
            image = mirrors[(number - 1) % 2].image.after(image)
            if whole_trips and number % 2:  # the held mirror makes this one of a translation
                continue
            fading = _fading(number / (2 * count)) if image.weight else 0.0
            if fading:
                images.append(image._replace(weight=fading * image.weight))
    return images


def _fading(share: float) -> float:
    """Return a smooth factor that falls from 1 at the plateau's end to 0 at a share of 1."""
    u = (share - _PLATEAU) / (1 - _PLATEAU)
    if u <= 0:
        return 1.0
    return 0.5 * (1 - math.tanh((1 / (1 - u) - 1 / u) / 2)) if u < 1 else 0.0


def distinct(images: Sequence[Image], places: torch.Tensor) -> tuple[Image, ...]:
    """Return the images that differ at places (..., 3) [m]; those that agree are one, of all their weight.

    Places in a plane are their own image in it.
    """
    if len(images) == 1:
        return tuple(images)
    flat = places.reshape(-1, 3)
    middle = flat.mean(dim=0)
    _, sizes, directions = torch.linalg.svd(flat - middle, full_matrices=False)
    spanned = directions[sizes > LENGTH_TOLERANCE * math.sqrt(len(flat))] * flat.sub(middle).norm(dim=1).max()
    frame = torch.cat([middle[None], middle + spanned])
    moved = torch.stack([image.of(frame) for image in images]).reshape(len(images), -1)
    rounded = (moved.numpy() / (2 * LENGTH_TOLERANCE)).round()
    _, first, kind = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    weights = np.array([image.weight for image in images])
    return tuple(
        images[index]._replace(weight=weights[kind.reshape(-1) == kind.reshape(-1)[index]].sum().item())
        for index in np.sort(first).tolist()
    )
