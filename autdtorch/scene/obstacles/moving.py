"""Obstacles that are shifted and turned, all as one body."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.mesh import Mesh
from autdtorch.scene.obstacles.primitives import Box, Cylinder, Sphere
from autdtorch.scene.obstacles.voxel_mask import VoxelMask
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import Vector, invalid

# The fields that place and turn an obstacle. A class of the user's own may have others, and is not moved
_PLACES = {Box: "center", Sphere: "center", Cylinder: "center", Mesh: "offset", VoxelMask: "origin"}
_TURNS = {Box: "rotation", Mesh: "rotation", Cylinder: "axis", Sphere: ""}

# Decimals of a place [m], and of an angle [rad] or direction: far above rounding, far below what an element
# can show. Fewer at rest, after two turns
_DIGITS, _ANGLE_DIGITS = 14, 12
_DIGITS_AT_REST, _ANGLE_DIGITS_AT_REST = 12, 10


def moved(obstacles: Sequence[Obstacle], offset: torch.Tensor, rotation: Vector) -> tuple[Obstacle, ...]:
    """Return obstacles turned about the centre of their circumscribed sphere and shifted by offset (3,) [m].

    Raises:
        ValueError: an obstacle that cannot be moved or turned.
    """
    if fixed := [one for one in obstacles if not is_movable(one)]:
        raise invalid("obstacles", type(fixed[0]).__name__, "must be of autdtorch's own kinds to be moved")
    if obstacles and any(rotation):
        (center, _), turn = circumscribed(obstacles), rotation_matrix(rotation)
        obstacles = [turned(one, turn, center) for one in obstacles]
    return tuple(shifted(one, offset) for one in obstacles)


def circumscribed(obstacles: Sequence[Obstacle]) -> tuple[torch.Tensor, float]:
    """Return centre (3,) and radius [m] of a sphere around all obstacles, which moves along with them.

    The centre is the middle of their bounding box when they are `at_rest`.
    """
    still, turn = at_rest(obstacles)
    lower, upper = (
        torch.tensor([getattr(one, side) for one in still], **REAL) for side in ("lower", "upper")
    )
    center = (lower.amin(dim=0) + upper.amax(dim=0)) / 2
    reach = [
        float((center - center.new_tensor(one.center)).norm()) + one.radius
        if isinstance(one, Sphere)
        else float((one.surface()[0] - center).norm(dim=1).max())
        for one in still
    ]
    return turn @ center, max(reach)


def is_movable(obstacle: object) -> bool:
    """Return whether an obstacle can be shifted."""
    return type(obstacle) in _PLACES


def is_turnable(obstacle: object) -> bool:
    """Return whether turning an obstacle changes it; a sphere stays what it is."""
    return bool(_TURNS.get(type(obstacle)))  # type: ignore[call-overload]


def shifted(obstacle: Obstacle, offset: torch.Tensor, digits: int = _DIGITS) -> Obstacle:
    """Return an obstacle shifted by an offset (3,) [m], its place rounded to decimals."""
    name = _PLACES[type(obstacle)]
    place = _rounded(offset.new_tensor(getattr(obstacle, name)) + offset, digits)
    if isinstance(obstacle, VoxelMask):
        return obstacle.at(place)
    there: dict[str, Any] = {name: place}
    return replace(obstacle, **there)


def turned(
    obstacle: Obstacle,
    turn: torch.Tensor,
    pivot: torch.Tensor,
    digits: int = _DIGITS,
    angle_digits: int = _ANGLE_DIGITS,
) -> Obstacle:
    """Return an obstacle turned by a matrix (3, 3) about a point (3,) [m], rounded to decimals.

    Raises:
        ValueError: an obstacle that cannot be turned, such as a `VoxelMask`.
    """
    if (kind := type(obstacle)) not in _TURNS:
        raise invalid("rotation", kind.__name__, "must be (0, 0, 0): this kind of obstacle cannot be turned")
    place = turn.new_tensor(getattr(obstacle, _PLACES[kind]))
    fields: dict[str, Any] = {_PLACES[kind]: _rounded(pivot + turn @ (place - pivot), digits)}
    if name := _TURNS[kind]:
        own = getattr(obstacle, name)
        found = angles_of(turn @ rotation_matrix(own)) if name == "rotation" else turn @ turn.new_tensor(own)
        fields[name] = _rounded(found, angle_digits)
    return replace(obstacle, **fields)


def at_rest(obstacles: Sequence[Obstacle]) -> tuple[tuple[Obstacle, ...], torch.Tensor]:
    """Return obstacles turned back so that the first box or mesh has no rotation, and the turn (3, 3).

    Without these, the axis of the first cylinder becomes z. Obstacles that are shifted and turned as one body
    come to rest in one orientation.
    """
    turn = _first_turn(obstacles)
    if torch.equal(turn, torch.eye(3, **REAL)):
        return tuple(obstacles), turn
    if any(type(one) not in _TURNS for one in obstacles):
        return tuple(obstacles), torch.eye(3, **REAL)
    digits = _DIGITS_AT_REST, _ANGLE_DIGITS_AT_REST
    return tuple(turned(one, turn.mT, torch.zeros_like(turn[0]), *digits) for one in obstacles), turn


def _first_turn(obstacles: Sequence[Obstacle]) -> torch.Tensor:
    """Return the turn (3, 3) of the first box or mesh, or from z to the axis of the first cylinder."""
    for one in obstacles:
        if isinstance(one, Box | Mesh):
            return rotation_matrix(one.rotation)
    for one in obstacles:
        if isinstance(one, Cylinder):
            x, y, z = one.axis
            return rotation_matrix((0.0, math.acos(max(-1.0, min(1.0, z))), math.atan2(y, x)))
    return torch.eye(3, **REAL)


def angles_of(turn: torch.Tensor) -> torch.Tensor:
    """Return the angles (3,) [rad] of a rotation matrix (3, 3), as of `rotation_matrix`."""
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # where the angles are not unique, any will do
        return torch.from_numpy(Rotation.from_matrix(turn.numpy()).as_euler("xyz"))


def _rounded(vector: torch.Tensor, digits: int) -> Vector:
    x, y, z = (vector.round(decimals=digits) + 0.0).tolist()  # no -0, which has a digest of its own
    return x, y, z
