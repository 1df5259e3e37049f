"""The field that bodies with known T-matrices scatter, from an array to points.

It is a product, W (1 - T S)^-1 T D: incoming waves D of the transducers, translations S between the bodies,
and outgoing waves W at the points. It is computed from the side with fewer columns or rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from autdtorch.analytic.spherical_waves import degrees, outgoing_waves
from autdtorch.analytic.wave_frames import translation
from autdtorch.propagators.multiple_scattering import solved
from autdtorch.propagators.tmatrix.incoming import IncomingWaves, incoming_waves, offsets_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.images import NO_MIRRORS, Image
from autdtorch.utils.process import require_memory

if TYPE_CHECKING:
    from autdtorch.propagators.tmatrix.tmatrix import TMatrix

_AT_ONCE = 200_000
"""Waves at points that are computed at once: 3 MB, which fit into a cache."""

_ENTRY_BYTES = 48.0
"""Memory of a pair of waves in the system of equations [bytes]."""


def parts_of(points: torch.Tensor, waves: int) -> tuple[torch.Tensor, ...]:
    """Return points (P, ..., 3) in parts, so that few of so many waves at them are in memory at once."""
    each = points[0].numel() // 3
    return torch.split(points, max(1, _AT_ONCE // (each * waves)))


def scattered_field(
    bodies: Sequence[TMatrix],
    array: TransducerArray,
    points: torch.Tensor,
    images: Sequence[Image],
    together: torch.Tensor | None = None,
) -> torch.Tensor:
    """Return the field (..., P, M) [Pa] that bodies scatter to points (..., P, 3) [m], of unit drives.

    Leading dimensions are those of the bodies' poses. `together` is what `joined` returns, if it is known.
    """
    if points.shape[-2] < len(array):  # the transposed product
        incident = [IncomingWaves.of(body, array, images) for body in bodies]
        waves, sizes = waves_at(bodies, points, images), [len(body.matrix) for body in bodies]
        weights = _weights(bodies, waves, images) if together is None else waves @ together
        parts = zip(incident, torch.split(weights, sizes, dim=-1), strict=True)
        return torch.stack([each.weighted(part) for each, part in parts]).sum(dim=0)
    if together is None:
        (scattered,) = scattered_waves(bodies, array, images)
    else:
        each = [IncomingWaves.of(body, array, images).matrix for body in bodies]
        scattered = together @ torch.cat(each, dim=-2)
    if scattered.ndim > 2:
        return waves_at(bodies, points, images) @ scattered
    return torch.cat(
        [waves_at(bodies, part, images) @ scattered for part in parts_of(points, len(scattered))]
    )


def _weights(bodies: Sequence[TMatrix], waves: torch.Tensor, images: Sequence[Image]) -> torch.Tensor:
    """Return the weights (..., P, N) of incoming waves in what waves (..., P, N) bring to points."""
    maps = [body.matrix.mT for body in bodies]
    between = [
        [None if each is None else each.mT for each in column]
        for column in zip(*_between(bodies, images), strict=True)
    ]
    return solved(maps, between, torch.split(waves.mT, [len(matrix) for matrix in maps], dim=-2)).mT


def joined(bodies: Sequence[TMatrix], images: Sequence[Image]) -> torch.Tensor:
    """Return the map (N, N) from the regular waves on all bodies to the outgoing waves of all."""
    maps = [body.matrix for body in bodies]
    sizes = [len(matrix) for matrix in maps]
    return solved(maps, _between(bodies, images), torch.split(torch.eye(sum(sizes), **COMPLEX), sizes))


def waves_of_body(
    bodies: Sequence[TMatrix],
    number: int,
    array: TransducerArray,
    images: Sequence[Image],
    drive: torch.Tensor | None = None,
    together: tuple[torch.Tensor, torch.Tensor] | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the coefficients (..., n, R) [Pa] of all regular waves on a body and of its outgoing waves.

    The array, its images and all other bodies send the regular ones. R drives are (..., R, M), or one of each
    transducer alone. Both have one degree more than T, up to which regular waves exchange momentum with the
    outgoing ones. `together` maps the array's waves on all bodies to both, if it is known; see `joined_on`.
    """
    bodies = _with_next_degree(bodies, number)
    if drive is None:
        incident = [IncomingWaves.of(body, array, images).matrix for body in bodies]
    else:
        incident = [incoming_waves(body, array, images, drive) for body in bodies]
    if together is not None:
        waves = torch.cat(incident, dim=-2).mT
        flat = waves.reshape(-1, waves.shape[-1])  # one product for all poses
        regular, outgoing = ((flat @ part.mT).reshape(*waves.shape[:-1], -1).mT for part in together)
        return regular, outgoing
    between, sizes = _between(bodies, images), [len(body.matrix) for body in bodies]
    scattered = torch.split(solved([body.matrix for body in bodies], between, incident), sizes, dim=-2)
    return incident[number] + _echoes(between[number], scattered), scattered[number]


def joined_on(
    bodies: Sequence[TMatrix], number: int, every: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the maps (n, N) from the array's waves on all bodies to the regular and outgoing waves of one.

    `every` is what `joined` returns. As in `waves_of_body`, one degree more of this body counts.
    """
    end, before = sum(len(body.matrix) for body in bodies[: number + 1]), len(every)
    bodies = _with_next_degree(bodies, number)
    sizes = [len(body.matrix) for body in bodies]
    more = sum(sizes) - before
    every = _with_zeros(_with_zeros(every, end, more).mT, end, more).mT
    parts = torch.split(every, sizes)
    direct = torch.split(torch.eye(len(every), **COMPLEX), sizes)[number]
    return direct + _echoes(_between(bodies, NO_MIRRORS)[number], parts), parts[number]


def _with_next_degree(bodies: Sequence[TMatrix], number: int) -> list[TMatrix]:
    """Return bodies, one of them with a degree more, which it does not scatter."""
    body = bodies[number]
    more = 2 * body.degree + 3
    raised = replace(body, matrix=torch.nn.functional.pad(body.matrix, (0, more, 0, more)))
    return [*bodies[:number], raised, *bodies[number + 1 :]]


def _with_zeros(rows: torch.Tensor, place: int, count: int) -> torch.Tensor:
    """Return rows (N + count, K) with so many of zeros at a place."""
    return torch.cat([rows[:place], rows.new_zeros(count, rows.shape[1]), rows[place:]])


def _echoes(between: Sequence[torch.Tensor | None], scattered: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return the regular waves on a body that the outgoing waves of all bodies bring to it."""
    pairs = zip(between, scattered, strict=True)
    parts = [part @ waves for part, waves in pairs if part is not None]
    return torch.stack(parts).sum(dim=0) if parts else torch.zeros((), **COMPLEX)


def waves_at(bodies: Sequence[TMatrix], points: torch.Tensor, images: Sequence[Image]) -> torch.Tensor:
    """Return the outgoing waves (..., P, N) of all bodies and their images at points (..., P, 3) [m].

    A mirrored wave at a point is the wave at the mirrored point.
    """
    none = torch.zeros((), **COMPLEX)
    parts = []
    for body in bodies:
        offsets = (offsets_of(body, "points", image.of(points)) for image in images)
        waves = [
            image.weight * outgoing_waves(body.degree, body.wavenumber, each)
            for image, each in zip(images, offsets, strict=True)
        ]
        parts.append(sum(waves, start=none))
    return torch.cat(parts, dim=-1)


def scattered_waves(
    bodies: Sequence[TMatrix], array: TransducerArray, images: Sequence[Image], left_out: Sequence[int] = (0,)
) -> list[torch.Tensor]:
    """Return the coefficients (..., N, M) [Pa] of all bodies' outgoing waves under unit drives of an array.

    Once for each number of highest degrees that are left out, whose coefficients are 0. Images of a body add
    no unknowns: their waves are its own, mirrored.
    """
    incident = [IncomingWaves.of(body, array, images).matrix for body in bodies]
    between = _between(bodies, images)
    return [
        solved([_without_highest(body, fewer) for body in bodies], between, incident) for fewer in left_out
    ]


def _between(bodies: Sequence[TMatrix], images: Sequence[Image]) -> list[list[torch.Tensor | None]]:
    """Return S_ij (..., n, n): waves of body j's images as regular waves around body i; None without any."""
    if len(bodies) > 1 or len(images) > 1:
        count = sum(len(body.matrix) for body in bodies)
        poses = max(math.prod(body.center.shape[:-1]) for body in bodies)
        require_memory("bodies", f"{count} waves", _ENTRY_BYTES * poses * count**2)
    return [
        [_regular_waves(body, other, images[1:] if other is body else images) for other in bodies]
        for body in bodies
    ]


def _regular_waves(body: TMatrix, other: TMatrix, images: Sequence[Image]) -> torch.Tensor | None:
    """Return S (..., N, K): outgoing waves of another body's images as regular waves around this one."""
    waves: torch.Tensor | None = None
    for image in images:
        center = (other.center - image.offset) @ image.matrix
        axes = image.matrix.mT @ other.axes
        shift = body.center - center
        part = translation(body.wavenumber, shift, (body.degree, body.axes), (other.degree, axes))
        waves = image.weight * part if waves is None else waves + image.weight * part
    return waves


def _without_highest(body: TMatrix, fewer: int) -> torch.Tensor:
    """Return T (N, N) with 0 in place of its `fewer` highest degrees."""
    low = degrees(body.degree) <= body.degree - fewer
    return torch.where(low[:, None] & low, body.matrix, 0) if fewer else body.matrix
