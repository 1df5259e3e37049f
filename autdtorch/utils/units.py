"""Angles, and warnings of quantities that seem to be in another unit."""

from __future__ import annotations

import contextlib
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextvars import ContextVar

import torch

from autdtorch.utils.array_types import triple
from autdtorch.utils.validation import (
    ArrayLike,
    Vector,
    finite_number,
    finite_vector,
    invalid,
    positive,
    real_tensor,
)

DECIBELS = 20 / math.log(10)
"""Decibels in a neper."""

_PREFIXES = ("", 1.0), ("m", 1e3), ("µ", 1e6), ("n", 1e9)

_place: ContextVar[str] = ContextVar("place of what is warned of", default="")
_LEAST_DEGREES = 10.0  # beyond a turn in rad, so that whole numbers of rad, as a loop over turns has, are few
_BETWEEN = {"autdtorch", "contextlib", "dataclasses", "functools"}  # call for the user, as `replace` does


class ScaleWarning(UserWarning):
    """A quantity seems to be in another unit or of another frequency, or its unit was guessed."""


def warn_user(text: str, category: type[Warning] = ScaleWarning) -> None:
    """Warn at the line of the user that led here, however deep the call is."""
    depth, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _BETWEEN:
        depth, frame = depth + 1, frame.f_back
    warnings.warn(_place.get() + text, category, stacklevel=depth)


def prefixed(size: float, unit: str) -> tuple[float, str]:
    """Return the factor and the unit, with a prefix from m to n if it needs one, that show a size >= 1."""
    fitting = ((factor, f"{prefix}{unit}") for prefix, factor in _PREFIXES if factor * size >= 1)
    prefix, factor = _PREFIXES[-1]
    return next(fitting, (factor, f"{prefix}{unit}"))


def angle(name: str, value: object) -> float:
    """Return `value` as an angle [rad]; warn of one that seems to be in degrees."""
    number = finite_number(name, value, "rad")
    _warn_of_degrees(name, (number,), f"math.radians({number:g})")
    return number


def angles(name: str, value: object, degrees: object = None) -> Vector:
    """Return `value`, three angles [rad], or `degrees`, the three in degrees, as radians within half a turn.

    A `value` that seems to be in degrees brings a warning; both at once are refused.
    """
    turn = finite_vector(name, value, "rad")
    if degrees is None:
        shown = ", ".join(f"{angle:g}" for angle in turn)
        _warn_of_degrees(name, turn, f"{name.rpartition('.')[2]}_degrees=({shown})")
        return turn
    if any(turn):
        raise invalid(f"{name}_degrees", degrees, f"must not be given beside {name}, {turn} rad", "degrees")
    return triple(
        math.radians(math.remainder(angle, 360))
        for angle in finite_vector(f"{name}_degrees", degrees, "degrees")
    )


def turn_tensor(value: ArrayLike, degrees: ArrayLike | None) -> torch.Tensor:
    """Return the angles `rotation` (..., 3) [rad], as of `angles`, as a tensor with its gradient."""
    if degrees is None:
        turns = real_tensor("rotation", value, "rad")
        angles("rotation", _largest("rotation", turns))
        return turns
    turns = real_tensor("rotation_degrees", degrees, "degrees")
    angles("rotation", value, _largest("rotation_degrees", turns))
    return torch.deg2rad(turns)


def _largest(name: str, turns: torch.Tensor) -> torch.Tensor:
    """Return the row (3,) of turns (..., 3) with the largest angle."""
    if turns.ndim == 0 or turns.shape[-1] != 3 or not turns.numel():
        raise ValueError(f"{name}: shape {tuple(turns.shape)}; must be (3,), or (..., 3) for many poses")
    rows = turns.detach().reshape(-1, 3)
    return rows[rows.abs().amax(dim=1).argmax()]


def real_wavenumber(value: object) -> float:
    """Return a wavenumber [rad/m] > 0; one with an attenuation is refused, which few solutions have."""
    if isinstance(value, complex) and value.imag == 0:  # of a scene without absorption
        value = value.real
    if isinstance(value, complex):
        accepted = "must be real, such as scene.wavenumber: of exact solutions, green alone has attenuation"
        raise invalid("wavenumber", value, accepted, "rad/m")
    return positive("wavenumber", value, "rad/m")


@contextlib.contextmanager
def warned_within(place: str) -> Iterator[None]:
    """Put the name of a place, such as a file, in front of the warnings of `warn_user`."""
    token = _place.set(f"{_place.get()}{place}: ")
    try:
        yield
    finally:
        _place.reset(token)


def _warn_of_degrees(name: str, turn: Sequence[float], fix: str) -> None:
    """Warn of an angle beyond a turn in whole or half numbers; one that is counted on in rad is seldom so."""
    if any(abs(angle) >= _LEAST_DEGREES and (2 * angle).is_integer() for angle in turn):
        shown = turn[0] if len(turn) == 1 else turn
        warn_user(f"{name}: {shown} rad is more than a turn; are these degrees? Then take {fix}")
