"""Obstacles that are shifted and turned, all as one body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.mesh import Mesh
from autdtorch.scene.obstacles.primitives import Box, Cylinder, Sphere
from autdtorch.scene.obstacles.voxel_mask import VoxelMask
from autdtorch.utils.validation import Vector, invalid

# The fields that place and turn an obstacle. A class of the user's own may have others, and is not moved
_PLACES = {Box: "center", Sphere: "center", Cylinder: "center", Mesh: "offset", VoxelMask: "origin"}
_TURNS = {Box: "rotation", Mesh: "rotation", Cylinder: "axis", Sphere: ""}

# Decimals of a place [m], and of an angle [rad] or direction: far above rounding, far below what an element
# can show. Fewer at rest, after two turns
_DIGITS, _ANGLE_DIGITS = 14, 12
_DIGITS_AT_REST, _ANGLE_DIGITS_AT_REST = 12, 10
_SIDES = "lower", "upper"


def moved(obstacles: Sequence[Obstacle], offset: torch.Tensor, rotation: Vector) -> tuple[Obstacle, ...]:
    """Return obstacles turned about the middle of their bounding box and shifted by an offset (3,) [m].

    Raises:
        ValueError: an obstacle that cannot be moved or turned.
    """
    if fixed := [one for one in obstacles if not is_movable(one)]:
        raise invalid("obstacles", type(fixed[0]).__name__, "must be of autdtorch's own kinds to be moved")
    if any(rotation):
        lower, upper = (offset.new_tensor([getattr(one, side) for one in obstacles]) for side in _SIDES)
        middle, turn = (lower.amin(dim=0) + upper.amax(dim=0)) / 2, rotation_matrix(rotation)
        obstacles = [turned(one, turn, middle) for one in obstacles]
    return tuple(shifted(one, offset) for one in obstacles)


def is_movable(obstacle: object) -> bool:
    """Return whether an obstacle can be shifted."""
    return type(obstacle) in _PLACES


def shifted(obstacle: Obstacle, offset: torch.Tensor, digits: int = _DIGITS) -> Obstacle:
    """Return an obstacle shifted by an offset (3,) [m], its place rounded to decimals."""
    name = _PLACES[type(obstacle)]
    place: dict[str, Any] = {name: _rounded(offset.new_tensor(getattr(obstacle, name)) + offset, digits)}
    return replace(obstacle, **place)


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
        found = _angles(turn @ rotation_matrix(own)) if name == "rotation" else turn @ turn.new_tensor(own)
        fields[name] = _rounded(found, angle_digits)
    return replace(obstacle, **fields)


def at_rest(obstacles: Sequence[Obstacle]) -> tuple[tuple[Obstacle, ...], torch.Tensor]:
    """Return obstacles turned back so that the first that has a rotation has none, and the turn (3, 3).

    Obstacles that are shifted and turned as one body are at rest as before, but for the shift.
    """
    none = torch.eye(3, dtype=torch.float64, device="cpu")
    rotations = [body.rotation for body in obstacles if isinstance(body, Box | Mesh)]
    turn = rotation_matrix(rotations[0]) if rotations else none
    if torch.equal(turn, none) or any(type(body) not in _TURNS for body in obstacles):
        return tuple(obstacles), none
    digits = _DIGITS_AT_REST, _ANGLE_DIGITS_AT_REST
    return tuple(turned(body, turn.mT, torch.zeros_like(none[0]), *digits) for body in obstacles), turn


def _angles(turn: torch.Tensor) -> torch.Tensor:
    """Return the angles (3,) [rad] of a rotation, as of `rotation_matrix`."""
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.from_matrix(turn.numpy()).as_euler("xyz"))


def _rounded(vector: torch.Tensor, digits: int) -> Vector:
    x, y, z = (vector.round(decimals=digits) + 0.0).tolist()  # no -0, which has a digest of its own
    return x, y, z
