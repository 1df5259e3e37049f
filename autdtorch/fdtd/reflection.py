"""Bodies in front of mirrors: with their images they are bodies in free space.

A body next to a rigid or soft mirror, on it or cut by it, shares a grid with its image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from autdtorch.fdtd.region import Body, Region, Shape
from autdtorch.fdtd.turning import Bounded, Turned
from autdtorch.utils.array_types import Array
from autdtorch.utils.images import Image, Mirror, images_of
from autdtorch.utils.process import cached_property
from autdtorch.utils.validation import LENGTH_TOLERANCE, Vector, invalid

CLEARANCE = 4.5
"""Distance [cells] of a mirror from the box around bodies up to which they share a grid with their images.
The Huygens surface is up to 4 cells from the bodies, and must not meet its own image."""


@dataclass(frozen=True, eq=False)
class Doubled(Bounded):
    """A shape that touches or crosses a mirror, cut at it and joined with its image."""

    shape: Shape
    mirror: Mirror

    def signed_distance(self, points: Tensor, /) -> Tensor:
        """Return the distance (...) [m] of points (..., 3) to the surface, negative inside."""
        behind = self.mirror.height(points) < 0
        return self.shape.signed_distance(
            torch.where(behind[..., None], self.mirror.image.of(points), points)
        )

    def surface(self) -> tuple[Tensor, Tensor]:
        """Return vertices (V, 3) [m] and triangles (F, 3), counter-clockwise as seen from outside."""
        return self._surface

    @cached_property
    def _surface(self) -> tuple[Tensor, Tensor]:
        corners = _cut(*self.shape.surface(), self.mirror)
        both = torch.cat([corners, self.mirror.image.of(corners).flip(1)])  # an image turns the other way
        return both.reshape(-1, 3), torch.arange(3 * len(both), device="cpu").reshape(-1, 3)

    @cached_property
    def _bounds(self) -> tuple[Vector, Vector]:
        image = _image(self.shape, self.mirror)
        lower = np.minimum(self.shape.lower, image.lower)
        upper = np.maximum(self.shape.upper, image.upper)
        normal, vertices = np.abs(np.array(self.mirror.normal)), self.surface()[0].numpy()
        if np.count_nonzero(normal) == 1:  # the part behind is gone
            axis = int(normal.argmax())
            lower[axis], upper[axis] = vertices[:, axis].min(), vertices[:, axis].max()
        (x, y, z), (u, v, w) = lower.tolist(), upper.tolist()
        return (x, y, z), (u, v, w)


def _image(shape: Shape, mirror: Mirror) -> Turned:
    image = mirror.image
    return Turned(shape, image.matrix.numpy(), image.offset.numpy())


def _cut(vertices: Tensor, triangles: Tensor, mirror: Mirror) -> Tensor:
    """Return the corners (F, 3, 3) [m] of the part of a surface in front of a mirror."""
    corners = vertices[triangles]
    height = mirror.height(corners)
    height = torch.where(height.abs() < LENGTH_TOLERANCE, 0.0, height)
    whole = (height >= 0).all(dim=1) & (height > 0).any(dim=1)
    parts = [corners[whole]]
    for one, above in zip(corners[~whole], height[~whole], strict=True):
        if (above <= 0).all():
            continue
        polygon = []
        for number in range(3):
            here, there = above[number - 1], above[number]
            if here * there < 0:
                share = here / (here - there)
                polygon.append(one[number - 1] + share * (one[number] - one[number - 1]))
            if there >= 0:
                polygon.append(one[number])
        fan = [torch.stack([polygon[0], *polygon[n : n + 2]]) for n in range(1, len(polygon) - 1)]
        parts.append(torch.stack(fan))
    return torch.cat(parts)


def near_mirrors(region: Region, lower: Array, upper: Array, axes: Array, spacing: float) -> tuple[int, ...]:
    """Return the mirrors that are next to a box along `axes`, with corners (3,) [m] in their coordinates."""
    beside = CLEARANCE * spacing
    ends = np.stack([lower - beside, upper + beside])
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3) @ axes
    heights = [mirror.height(torch.from_numpy(corners)).min() for mirror in region.mirrors]
    return tuple(number for number, height in enumerate(heights) if height < 0)


def can_hold(region: Region, near: Sequence[int]) -> bool:
    """Return whether a grid can hold the images in some mirrors: rigid or soft ones, none facing another."""
    mirrors = [region.mirrors[number] for number in near]
    facing = any(one.is_parallel(other) for one, other in combinations(mirrors, 2))
    return not facing and all(mirror.reflection in (1, -1) for mirror in mirrors)


def require_sharp(region: Region, near: Sequence[int], spacing: float) -> None:
    """Refuse mirrors next to bodies whose images no grid can hold; see `can_hold`."""
    if can_hold(region, near):
        return
    beside = f"{1e3 * CLEARANCE * spacing:.3g} mm"
    for number in near:
        if region.mirrors[number].reflection not in (1, -1):
            accepted = f"must be 1 or -1 where an obstacle is within {beside}; or move the obstacle"
            raise invalid(f"reflectors[{number}].reflection", region.mirrors[number].reflection, accepted)
    accepted = f"must be {beside} or more from one of reflectors {list(near)}, of which two face each other"
    raise invalid("obstacles", "one grid next to both", accepted)


def require_domain(region: Region, name: str = "method", value: str = "full") -> None:
    """Refuse mirrors that a grid of the whole domain cannot have; the message names what asks for it."""
    for number, mirror in enumerate(region.mirrors):
        if np.abs(mirror.normal).max() < 1 or mirror.reflection not in (1, -1):
            plane = f"reflector {number}, of normal {mirror.normal} and reflection {mirror.reflection}"
            accepted = f"cannot have {plane}: it must be along an axis, and its reflection 1 or -1; take box"
            raise invalid(name, value, accepted)
        if any(mirror.is_parallel(other) for other in region.mirrors[:number]):
            raise invalid(name, value, f"cannot have parallel reflectors, such as {number}; take box")


def with_images(bodies: Sequence[Body], mirrors: Sequence[Mirror]) -> tuple[Body, ...]:
    """Return bodies with their images in mirrors; a body on or across a mirror is one with its image."""
    bodies = tuple(bodies)
    for mirror in mirrors:
        bodies = tuple(one for body in bodies for one in _doubled(body, mirror))
    return bodies


def _doubled(body: Body, mirror: Mirror) -> list[Body]:
    if float(mirror.height(body.shape.surface()[0]).min()) < LENGTH_TOLERANCE:
        return [replace(body, shape=Doubled(body.shape, mirror))]
    return [body, replace(body, shape=_image(body.shape, mirror))]


def whole_region(region: Region) -> Region:
    """Return the region with its images: the bodies in front of all mirrors and behind, in free space.

    The domain is cut at each mirror, and joined with its image.
    """
    if not region.mirrors:
        return region
    lower, upper = (np.array(corner) for corner in region.domain)
    sources = torch.from_numpy(region.sources)
    for mirror in region.mirrors:
        axis = int(np.abs(mirror.normal).argmax())
        plane = mirror.point[axis]
        half = upper[axis] - plane if mirror.normal[axis] > 0 else plane - lower[axis]
        lower[axis], upper[axis] = plane - half, plane + half
        sources = torch.cat([sources, mirror.image.of(sources)])
    (x, y, z), (u, v, w) = lower.tolist(), upper.tolist()
    bodies = with_images(region.bodies, region.mirrors)
    return replace(region, bodies=bodies, domain=((x, y, z), (u, v, w)), sources=sources.numpy(), mirrors=())


def other_images(region: Region, near: Sequence[int], images: Sequence[Image]) -> tuple[Image, ...]:
    """Return the images that a grid does not hold: one for each of its own copies in all other mirrors."""
    if not near:
        return tuple(images)
    held = [region.mirrors[number] for number in near]
    size = float(np.linalg.norm(np.subtract(*region.domain)))
    return images_of(region.mirrors, complex(region.wavenumber, region.attenuation), size, held)
