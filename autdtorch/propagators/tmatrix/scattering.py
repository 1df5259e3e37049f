"""The field that bodies with known T-matrices scatter, from an array to points.

It is a product, W (1 - T S)^-1 T D: incoming waves D of the transducers, translations S between the bodies,
and outgoing waves W at the points. It is computed from the side with fewer columns or rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from autdtorch.analytic.spherical_waves import degrees, mirrored, outgoing_waves
from autdtorch.propagators.tmatrix.body_matrix import BodyMatrix
from autdtorch.propagators.tmatrix.coupling import Ways, received, solved, ways_between
from autdtorch.propagators.tmatrix.incoming import IncomingWaves, incoming_waves
from autdtorch.scene.arrays import TransducerArray
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.mirror_images import NO_MIRRORS, Image

_AT_ONCE = 200_000
"""Waves at points that are computed at once: 3 MB, which fit into a cache."""


def scattered_field(
    bodies: Sequence[BodyMatrix],
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
    few = max(1, _AT_ONCE // (points[0].numel() // 3 * len(scattered)))
    return torch.cat([waves_at(bodies, part, images) @ scattered for part in torch.split(points, few)])


def _weights(bodies: Sequence[BodyMatrix], waves: torch.Tensor, images: Sequence[Image]) -> torch.Tensor:
    """Return the weights (..., P, N) of incoming waves in what waves (..., P, N) bring to points.

    By reciprocity they are scattered by bodies with transposed maps, as waves of opposite orders.
    """
    signs = [mirrored(body.degree) for body in bodies]
    maps = [
        sign[:, None] * body.matrix.mT[place][:, place] * sign
        for body, (place, sign) in zip(bodies, signs, strict=True)
    ]
    parts = torch.split(waves.mT, [len(each) for each in maps], dim=-2)

    def opposite(each: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        return [sign[:, None] * part[..., place, :] for part, (place, sign) in zip(each, signs, strict=True)]

    weights = _scattered(maps, ways_between(bodies, images), opposite(parts))
    return torch.cat(opposite(weights), dim=-2).mT


def _scattered(
    maps: Sequence[torch.Tensor], ways: Ways, incident: Sequence[torch.Tensor]
) -> list[torch.Tensor]:
    """Return the outgoing waves (..., n, R) of all bodies under incident ones (..., n, R); see `solved`."""
    poses = incident[0].shape[:-2]
    return [_in_poses(waves, poses) for waves in solved(maps, ways, [_flat(waves) for waves in incident])]


def _flat(waves: torch.Tensor) -> torch.Tensor:
    """Return waves (N, B, R) of waves (..., N, R)."""
    return waves.reshape(waves.shape[:-2].numel(), *waves.shape[-2:]).movedim(1, 0).contiguous()


def _in_poses(waves: torch.Tensor, poses: Sequence[int]) -> torch.Tensor:
    """Return waves (..., N, R) of waves (N, B, R)."""
    return waves.movedim(0, 1).reshape(*poses, len(waves), waves.shape[-1])


def joined(bodies: Sequence[BodyMatrix], images: Sequence[Image]) -> torch.Tensor:
    """Return the map (N, N) from the regular waves on all bodies to the outgoing waves of all."""
    maps = [body.matrix for body in bodies]
    sizes = [len(matrix) for matrix in maps]
    identity = torch.split(torch.eye(sum(sizes), **COMPLEX), sizes)
    return torch.cat(_scattered(maps, ways_between(bodies, images), identity))


def waves_of_body(
    bodies: Sequence[BodyMatrix],
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
    raised = [body.with_next_degree() if index == number else body for index, body in enumerate(bodies)]
    if drive is None:
        incident = [IncomingWaves.of(body, array, images).matrix for body in raised]
    else:
        incident = [incoming_waves(body, array, images, drive) for body in raised]
    if together is not None:
        waves = torch.cat(incident, dim=-2).mT
        flat = waves.reshape(-1, waves.shape[-1])  # one product for all poses
        regular, outgoing = ((flat @ part.mT).reshape(*waves.shape[:-1], len(part)).mT for part in together)
        return regular, outgoing
    order = [number, *(index for index in range(len(bodies)) if index != number)]  # the first is quickest
    maps = [bodies[index].matrix for index in order]
    bodies, poses = [bodies[index] for index in order], incident[0].shape[:-2]
    first, *others = (_flat(incident[index]) for index in order)
    sent = solved(maps, ways_between(bodies, images), [first[: len(maps[0])], *others])
    echoes = received(ways_between(bodies, images, 1)[0], sent)
    regular = first if echoes is None else first + echoes
    outgoing = torch.nn.functional.pad(sent[0], (0, 0, 0, 0, 0, len(regular) - len(sent[0])))
    return _in_poses(regular, poses), _in_poses(outgoing, poses)


def joined_on(
    bodies: Sequence[BodyMatrix], number: int, every: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the maps (n, N) from the array's waves on all bodies to the regular and outgoing waves of one.

    `every` is what `joined` returns. As in `waves_of_body`, one degree more of this body counts.
    """
    more, sizes = 2 * bodies[number].degree + 3, [len(body.matrix) for body in bodies]
    end = sum(sizes[: number + 1])
    columns = torch.cat([every[:, :end], every.new_zeros(len(every), more), every[:, end:]], dim=1)
    sent = [part[:, None] for part in torch.split(columns, sizes)]
    echoes = received(ways_between(bodies, NO_MIRRORS, 1)[number], sent)
    sizes[number] += more
    direct = torch.split(torch.eye(sum(sizes), **COMPLEX), sizes)[number]
    outgoing = torch.nn.functional.pad(sent[number][:, 0], (0, 0, 0, more))
    return direct if echoes is None else direct + echoes[:, 0], outgoing


def waves_at(bodies: Sequence[BodyMatrix], points: torch.Tensor, images: Sequence[Image]) -> torch.Tensor:
    """Return the outgoing waves (..., P, N) of all bodies and their images at points (..., P, 3) [m].

    A mirrored wave at a point is the wave at the mirrored point.
    """
    none = torch.zeros((), **COMPLEX)
    parts = []
    for body in bodies:
        offsets = (body.offsets("points", image.of(points)) for image in images)
        waves = [
            image.weight * outgoing_waves(body.degree, body.wavenumber, each)
            for image, each in zip(images, offsets, strict=True)
        ]
        parts.append(sum(waves, start=none))
    return torch.cat(parts, dim=-1)


def scattered_waves(
    bodies: Sequence[BodyMatrix],
    array: TransducerArray,
    images: Sequence[Image],
    left_out: Sequence[int] = (0,),
) -> list[torch.Tensor]:
    """Return the coefficients (..., N, M) [Pa] of all bodies' outgoing waves under unit drives of an array.

    Once for each number of highest degrees that are left out, whose coefficients are 0. Images of a body add
    no unknowns: their waves are its own, mirrored.
    """
    incident = [IncomingWaves.of(body, array, images).matrix for body in bodies]
    ways = ways_between(bodies, images)
    maps = ([_without_highest(body, fewer) for body in bodies] for fewer in left_out)
    return [torch.cat(_scattered(each, ways, incident), dim=-2) for each in maps]


def _without_highest(body: BodyMatrix, fewer: int) -> torch.Tensor:
    """Return T (N, N) with 0 in place of its `fewer` highest degrees."""
    low = degrees(body.degree) <= body.degree - fewer
    return torch.where(low[:, None] & low, body.matrix, 0) if fewer else body.matrix
