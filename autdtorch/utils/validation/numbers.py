"""Numbers: finite, positive, in a range, whole."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence

import numpy as np
import torch

from autdtorch.utils.validation.values import in_unit, invalid, is_dense, is_plain

_LARGEST = 2**63 - 1  # largest integer that NumPy and PyTorch count with

_DENSITIES = 1e-9, 1e9  # [kg/m^3]; far beyond all materials, and squares of their ratios do not overflow
_SOUND_SPEEDS = 1e-3, 1e6  # [m/s]


def finite_number(name: str, value: object, unit: str = "") -> float:
    """Return `value` as a finite float; text, booleans and complex numbers are refused."""
    if isinstance(value, torch.Tensor | np.ndarray) and value.ndim == 0 and is_plain(value):
        value = value.item()
    if not is_plain(value) or not isinstance(value, numbers.Real):
        raise invalid(name, value, f"must be a real number{in_unit(unit)}")
    try:
        number = float(value)
    except OverflowError:  # an integer or a fraction, too large for a float
        number = math.inf
    except Exception as error:  # of a class of the user's own
        raise invalid(name, value, f"must be a real number{in_unit(unit)}") from error
    if not math.isfinite(number):
        raise invalid(name, value, "must be finite", unit)
    return number


def positive(name: str, value: object, unit: str = "") -> float:
    """Return `value` as a finite float > 0."""
    number = finite_number(name, value, unit)
    if number <= 0:
        raise invalid(name, value, "must be finite and > 0", unit)
    return number


def not_negative(name: str, value: object, unit: str = "") -> float:
    """Return `value` as a finite float >= 0."""
    number = finite_number(name, value, unit)
    if number < 0:
        raise invalid(name, value, "must be finite and >= 0", unit)
    return number


def number_between(name: str, value: object, least: float, most: float, unit: str = "") -> float:
    """Return `value` as a float in `least` to `most`, ends included."""
    number = finite_number(name, value, unit)
    if not least <= number <= most:
        raise invalid(name, value, f"must be in {least:g} to {most:g}", unit)
    return number


def fluid(kind: str, density: object, sound_speed: object) -> tuple[float, float]:
    """Return density [kg/m^3] and sound speed [m/s] of a fluid, checked as fields of `kind`."""
    rho = positive(f"{kind}.density", density, "kg/m^3")
    c = positive(f"{kind}.sound_speed", sound_speed, "m/s")
    return (
        number_between(f"{kind}.density", rho, *_DENSITIES, "kg/m^3"),
        number_between(f"{kind}.sound_speed", c, *_SOUND_SPEEDS, "m/s"),
    )


def boolean(name: str, value: object) -> bool:
    """Return `value`, True or False, as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise invalid(name, value, "must be true or false")
    return bool(value)


def integer_at_least(name: str, value: object, minimum: int) -> int:
    """Return `value` as an int >= `minimum`; whole floats are refused too."""
    number = int(value) if is_plain(value) and isinstance(value, numbers.Integral) else minimum - 1
    if not minimum <= number <= _LARGEST:
        most = " and < 2^63" if number > _LARGEST else ""
        raise invalid(name, value, f"must be an integer >= {minimum}{most}")
    return number


def integers(name: str, value: object, minimum: int, accepted: str) -> list[int]:
    """Return `value`, a sequence or an array with one axis, as integers >= `minimum`."""
    if isinstance(value, torch.Tensor | np.ndarray) and is_dense(value):  # entries need not be Integral
        value = value.tolist()
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        raise invalid(name, value, accepted)
    try:
        entries = list(value)
    except Exception as error:  # of a class of the user's own
        raise invalid(name, value, accepted) from error
    return [integer_at_least(f"{name}[{place}]", entry, minimum) for place, entry in enumerate(entries)]


def positive_integers(name: str, value: object, count: int) -> tuple[int, ...]:
    """Return `value` as `count` integers >= 1."""
    accepted = f"must be {count} integers >= 1"
    entries = integers(name, value, 1, accepted)
    if len(entries) != count:
        raise invalid(name, entries, accepted)
    return tuple(entries)


def indices(name: str, value: object, count: int) -> list[int]:
    """Return `value` as indices from 0 to `count` - 1: at least one, without repetition."""
    chosen = integers(name, value, 0, f"must be indices from 0 to {count - 1}")
    if not chosen or len(set(chosen)) < len(chosen) or max(chosen) >= count:
        raise invalid(name, chosen, f"must be indices from 0 to {count - 1}, each once")
    return chosen
