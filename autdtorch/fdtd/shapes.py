"""Shapes that a grid can represent, also turned or as an image in a mirror."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from autdtorch.utils.array_types import Array, triple
from autdtorch.utils.mirror_images import Mirror
from autdtorch.utils.process import cached_property
from autdtorch.utils.validation import LENGTH_TOLERANCE, Vector

_SAGITTA = 1.5  # Growth of a bounding box, relative to the distance of triangles from a curved surface
# Steps from a place to another, and the distance, relative to the precision, at which a shape is reached
_STEPS, _TOUCHING = 60, 1e-3
_SLOPE = 1e-6  # Step from a point to others that tell the slope of distances [m]


class Shape(Protocol):
    """A shape."""

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""

    def signed_distance(self, points: Tensor, /) -> Tensor:
        """Return the distance (...) [m] of points (..., 3) to the surface, negative inside."""

    def surface(self) -> tuple[Tensor, Tensor]:
        """Return vertices (V, 3) [m] and triangles (F, 3), counter-clockwise as seen from outside."""


def bounds(shapes: Sequence[Shape]) -> tuple[Array, Array]:
    """Return the lower and upper corner (3,) [m] of the bounding box of shapes."""
    lower = np.array([shape.lower for shape in shapes], np.float64).min(axis=0)
    return lower, np.array([shape.upper for shape in shapes], np.float64).max(axis=0)


def distance_from(shapes: Sequence[Shape], points: Tensor) -> Tensor:
    """Return the distance (...) [m] of points (..., 3) to the nearest of shapes, negative inside."""
    return torch.stack([shape.signed_distance(points) for shape in shapes]).amin(dim=0)


def remaining(distances: Iterable[Array], solid: Sequence[bool]) -> Array:
    """Return the signed distance (...) from shapes that are `solid` (K,), from those of all (K, ...).

    Later shapes that are not solid cut into those before. The distance is infinite without solid ones.
    """
    level = np.array(math.inf)
    for distance, is_solid in zip(distances, solid, strict=True):
        level = np.minimum(level, distance) if is_solid else np.maximum(level, -distance)
    return level


@dataclass(frozen=True)
class Solids:
    """Solid shapes among others: later ones that are not solid cut into those before."""

    shapes: Sequence[Shape]
    solid: Sequence[bool]  # which of them are

    def __bool__(self) -> bool:
        return any(self.solid)

    def distance(self, points: Array) -> Array:
        """Return the signed distance (...) [m] of points (..., 3) from these; infinite without any."""
        where = torch.from_numpy(points)
        level = remaining((shape.signed_distance(where).numpy() for shape in self.shapes), self.solid)
        return np.broadcast_to(level, points.shape[:-1])

    def normals(self, points: Array) -> Array:
        """Return the normals (..., 3) of the nearest surface at points (..., 3) [m]; halfway, their mean."""
        steps = _SLOPE * np.eye(3)
        slopes = [self.distance(points + step) - self.distance(points - step) for step in steps]
        return np.stack(slopes, axis=-1) / (2 * _SLOPE)


def sees(begin: Array, end: Array, solids: Solids, precision: float) -> NDArray[np.bool_]:
    """Return whether nothing solid is between places (..., 3) and others (..., 3) [m], to a precision [m].

    Each step goes as far as the distance from the nearest.
    """
    begin, end = np.broadcast_arrays(begin, end)
    grid, (begin, end) = begin.shape[:-1], (begin.reshape(-1, 3), end.reshape(-1, 3))
    length, least = np.linalg.norm(end - begin, axis=1), _TOUCHING * precision
    gone, seen = np.zeros(len(length)), np.ones(len(length), bool)
    before = np.full(len(length), -np.inf)
    going = np.flatnonzero(length > 0)
    for _ in range(_STEPS):
        if not len(going):
            break
        share = (gone[going] / length[going])[:, None]
        distance = solids.distance((1 - share) * begin[going] + share * end[going])
        # a place on a shape looks away from it
        seen[going] = (distance >= least) | (distance > before[going])
        before[going] = distance
        on = seen[going] & (gone[going] < length[going])
        going = going[on]
        gone[going] = np.minimum(gone[going] + np.maximum(distance[on], least), length[going])
    return seen.reshape(grid)


class Bounded(ABC):
    """A shape that computes both corners of its bounding box together."""

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        return self._bounds[0]

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
        return self._bounds[1]

    @property
    @abstractmethod
    def _bounds(self) -> tuple[Vector, Vector]:
        """The lower and the upper corner."""


@dataclass(frozen=True, eq=False)
class Turned(Bounded):
    """A shape in the coordinates of other axes, or its image in a mirror."""

    shape: Shape
    axes: Array  # the axes, one a row, in the coordinates of the shape (3, 3)
    offset: Array = field(default_factory=lambda: np.zeros(3))  # place of the origin (3,) [m]

    def signed_distance(self, points: Tensor, /) -> Tensor:
        """Return the distance (...) [m] of points (..., 3) to the surface, negative inside."""
        return self.shape.signed_distance(
            (points - torch.from_numpy(self.offset)) @ torch.from_numpy(self.axes)
        )

    def surface(self) -> tuple[Tensor, Tensor]:
        """Return vertices (V, 3) [m] and triangles (F, 3), counter-clockwise as seen from outside."""
        vertices, triangles = self.shape.surface()
        if np.linalg.det(self.axes) < 0:  # an image turns the other way
            triangles = triangles.flip(1)
        return vertices @ torch.from_numpy(self.axes.T) + torch.from_numpy(self.offset), triangles

    @cached_property
    def _bounds(self) -> tuple[Vector, Vector]:
        if (np.abs(self.axes).max(axis=1) == 1).all():
            corners = np.array([self.shape.lower, self.shape.upper]) @ self.axes.T + self.offset
            return triple(corners.min(axis=0).tolist()), triple(corners.max(axis=0).tolist())
        vertices, triangles = self.surface()
        middle = self.signed_distance(vertices[triangles].mean(dim=1))
        beyond = _SAGITTA * float(middle.abs().max())
        ends = vertices.amin(dim=0) - beyond, vertices.amax(dim=0) + beyond
        return triple(ends[0].tolist()), triple(ends[1].tolist())


def turned_shape(shape: Shape, axes: Array) -> Shape:
    """Return a shape in the coordinates of other axes, one a row (3, 3)."""
    return Turned(shape, axes) if is_turned(axes) else shape


def is_turned(axes: Array) -> bool:
    """Return whether axes, one a row (3, 3), differ from those of the scene."""
    return bool((axes != np.eye(3)).any())


@dataclass(frozen=True, eq=False)
class _Doubled(Bounded):
    """A shape that touches or crosses a mirror, cut at it and joined with its image."""

    shape: Shape
    mirror: Mirror

    def signed_distance(self, points: Tensor, /) -> Tensor:
        behind = self.mirror.height(points) < 0
        return self.shape.signed_distance(
            torch.where(behind[..., None], self.mirror.image.of(points), points)
        )

    def surface(self) -> tuple[Tensor, Tensor]:
        return self._surface

    @cached_property
    def _surface(self) -> tuple[Tensor, Tensor]:
        corners = _cut(*self.shape.surface(), self.mirror)
        both = torch.cat([corners, self.mirror.image.of(corners).flip(1)])  # an image turns the other way
        return both.reshape(-1, 3), torch.arange(3 * len(both), device="cpu").reshape(-1, 3)

    @cached_property
    def _bounds(self) -> tuple[Vector, Vector]:
        image = _image_of(self.shape, self.mirror)
        lower = np.minimum(self.shape.lower, image.lower)
        upper = np.maximum(self.shape.upper, image.upper)
        normal, vertices = np.abs(np.array(self.mirror.normal)), self.surface()[0].numpy()
        if np.count_nonzero(normal) == 1:  # the part behind is gone
            axis = int(normal.argmax())
            lower[axis], upper[axis] = vertices[:, axis].min(), vertices[:, axis].max()
        return triple(lower.tolist()), triple(upper.tolist())


def with_image(shape: Shape, mirror: Mirror) -> list[Shape]:
    """Return a shape and its image in a mirror; they are one if it is on or across the mirror."""
    if float(mirror.height(shape.surface()[0]).min()) < LENGTH_TOLERANCE:
        return [_Doubled(shape, mirror)]
    return [shape, _image_of(shape, mirror)]


def _image_of(shape: Shape, mirror: Mirror) -> Turned:
    image = mirror.image
    return Turned(shape, image.matrix.numpy(), image.offset.numpy())


def _cut(vertices: Tensor, triangles: Tensor, mirror: Mirror) -> Tensor:
    """Return the corners (F, 3, 3) [m] of the part of a surface in front of a mirror."""
    corners = vertices[triangles]
    height = mirror.height(corners)
    height = torch.where(height.abs() < LENGTH_TOLERANCE, 0.0, height)
    whole = (height >= 0).all(dim=1) & (height > 0).any(dim=1)
    parts = [corners[whole]]
    for triangle, above in zip(corners[~whole], height[~whole], strict=True):
        if (above <= 0).all():
            continue
        polygon = []
        for number in range(3):
            here, there = above[number - 1], above[number]
            if here * there < 0:
                share = here / (here - there)
                polygon.append(triangle[number - 1] + share * (triangle[number] - triangle[number - 1]))
            if there >= 0:
                polygon.append(triangle[number])
        fan = [torch.stack([polygon[0], *polygon[n : n + 2]]) for n in range(1, len(polygon) - 1)]
        parts.append(torch.stack(fan))
    return torch.cat(parts)
