"""Obstacles that are shifted and turned, all as one body."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles import KINDS
from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.utils.array_types import REAL, triple
from autdtorch.utils.validation import Vector, invalid

# Decimals of a position [m], and of an angle [rad] or direction: far above rounding, far below what an
# element can show. Fewer at rest, after two turns
_DIGITS, _ANGLE_DIGITS = 14, 12
_DIGITS_AT_REST, _ANGLE_DIGITS_AT_REST = 12, 10


def moved(obstacles: Sequence[Obstacle], offset: torch.Tensor, rotation: Vector) -> tuple[Obstacle, ...]:
    """Return obstacles turned about the centre of their circumscribed sphere and shifted by offset (3,) [m].

    Raises:
        ValueError: an obstacle that cannot be moved or turned.
    """
    if fixed := [obstacle for obstacle in obstacles if not is_movable(obstacle)]:
        raise invalid(
            "obstacles",
            type(fixed[0]).__name__,
            "must be of a kind in autdtorch.scene.obstacles.KINDS to be moved",
        )
    if obstacles and any(rotation):
        (center, _), turn = circumscribed(obstacles), rotation_matrix(rotation)
        obstacles = [turned(obstacle, turn, center) for obstacle in obstacles]
    return tuple(shifted(obstacle, offset) for obstacle in obstacles)


def circumscribed(obstacles: Sequence[Obstacle]) -> tuple[torch.Tensor, float]:
    """Return centre (3,) and radius [m] of a sphere around all obstacles, which moves along with them.

    The centre is the middle of their bounding box when they are `at_rest`.
    """
    still, turn = at_rest(obstacles)
    lower, upper = (
        torch.tensor([getattr(obstacle, side) for obstacle in still], **REAL) for side in ("lower", "upper")
    )
    center = (lower.amin(dim=0) + upper.amax(dim=0)) / 2
    return turn @ center, max(obstacle.farthest(center) for obstacle in still)


def is_movable(obstacle: object) -> bool:
    """Return whether an obstacle can be shifted."""
    return (
        isinstance(obstacle, Obstacle) and type(obstacle) in KINDS.values() and bool(obstacle.position_field)
    )


def is_turnable(obstacle: object) -> bool:
    """Return whether turning an obstacle changes it; a sphere stays what it is."""
    return isinstance(obstacle, Obstacle) and is_movable(obstacle) and bool(obstacle.orientation_field)


def shifted(obstacle: Obstacle, offset: torch.Tensor, digits: int = _DIGITS) -> Obstacle:
    """Return an obstacle shifted by an offset (3,) [m], its position rounded to decimals."""
    return obstacle.at(_rounded(_position(obstacle, offset) + offset, digits))


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
    if not is_movable(obstacle) or obstacle.orientation_field is None:
        accepted = "must be (0, 0, 0): this kind of obstacle cannot be turned"
        raise invalid("rotation", type(obstacle).__name__, accepted)
    position = pivot + turn @ (_position(obstacle, turn) - pivot)
    fields: dict[str, Any] = {obstacle.position_field: _rounded(position, digits)}
    if field := obstacle.orientation_field:
        before = getattr(obstacle, field)
        after = (
            turn @ turn.new_tensor(before) if field == "axis" else angles_of(turn @ rotation_matrix(before))
        )
        fields[field] = _rounded(after, angle_digits)
    return replace(obstacle, **fields)


def at_rest(obstacles: Sequence[Obstacle]) -> tuple[tuple[Obstacle, ...], torch.Tensor]:
    """Return obstacles turned back so that the first box or mesh has no rotation, and the turn (3, 3).

    Without these, the axis of the first cylinder becomes z. Obstacles that are shifted and turned as one body
    come to rest in one orientation.
    """
    turn = _first_turn(obstacles)
    if torch.equal(turn, torch.eye(3, **REAL)):
        return tuple(obstacles), turn
    if not all(is_movable(obstacle) and obstacle.orientation_field is not None for obstacle in obstacles):
        return tuple(obstacles), torch.eye(3, **REAL)
    digits = _DIGITS_AT_REST, _ANGLE_DIGITS_AT_REST
    return tuple(
        turned(obstacle, turn.mT, torch.zeros_like(turn[0]), *digits) for obstacle in obstacles
    ), turn


def _first_turn(obstacles: Sequence[Obstacle]) -> torch.Tensor:
    """Return the turn (3, 3) of the first box or mesh, or from z to the axis of the first cylinder."""
    turnable = [obstacle for obstacle in obstacles if is_turnable(obstacle)]
    for obstacle in sorted(turnable, key=lambda obstacle: obstacle.orientation_field == "axis"):
        orientation: Vector = getattr(obstacle, str(obstacle.orientation_field))
        if obstacle.orientation_field != "axis":
            return rotation_matrix(orientation)
        x, y, z = orientation
        return rotation_matrix((0.0, math.acos(max(-1.0, min(1.0, z))), math.atan2(y, x)))
    return torch.eye(3, **REAL)


def angles_of(turn: torch.Tensor) -> torch.Tensor:
    """Return the angles (3,) [rad] of a rotation matrix (3, 3), as of `rotation_matrix`."""
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # where the angles are not unique, any will do
        return torch.from_numpy(Rotation.from_matrix(turn.numpy()).as_euler("xyz"))


def _position(obstacle: Obstacle, like: torch.Tensor) -> torch.Tensor:
    return like.new_tensor(getattr(obstacle, obstacle.position_field))


def _rounded(vector: torch.Tensor, digits: int) -> Vector:
    return triple((vector.round(decimals=digits) + 0.0).tolist())  # no -0, whose digest differs
