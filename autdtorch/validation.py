"""Checks made once, where a value enters the package.

Every function takes the name of the field first and returns the checked value in one canonical form. What is
wrong is reported as a `ValueError` of the shape ``field: value unit; accepted range``.
"""

from __future__ import annotations

import numbers
import re
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch

ArrayLike: TypeAlias = torch.Tensor | npt.ArrayLike
Vector: TypeAlias = tuple[float, float, float]

#: Lengths that differ by less are the same [m]: far above rounding at metre scale, far below any wavelength.
LENGTH_TOLERANCE = 1e-9

_NAME = re.compile(r"(?!\.+$)[\w.+-]+")
_LONGEST_NAME = 100

_SHOWN_ENTRIES = 9
_SHOWN_CHARACTERS = 120


def invalid(name: str, value: object, accepted: str, unit: str = "") -> ValueError:
    """The error to raise for `value` of field `name`; `accepted` says what is allowed."""
    return ValueError(f"{name}: {_shown(value)}{_suffix(unit)}; {accepted}")


def finite_number(name: str, value: object, unit: str = "") -> float:
    """`value` as a finite float.

    Raises:
        ValueError: not a real number (text, booleans and complex numbers are none), NaN or infinite.
    """
    if isinstance(value, torch.Tensor | np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise invalid(name, value, f"must be a real number{_in_unit(unit)}")
    if not np.isfinite(float(value)):
        raise invalid(name, value, "must be finite", unit)
    return float(value)


def positive(name: str, value: object, unit: str = "") -> float:
    """`value` as a finite float > 0.

    Raises:
        ValueError: not a finite real number, or <= 0.
    """
    number = finite_number(name, value, unit)
    if number <= 0:
        raise invalid(name, value, "must be finite and > 0", unit)
    return number


def number_between(name: str, value: object, least: float, most: float, unit: str = "") -> float:
    """`value` as a float in `least` to `most`, ends included.

    Raises:
        ValueError: not a real number, NaN or outside.
    """
    number = finite_number(name, value, unit)
    if not least <= number <= most:
        raise invalid(name, value, f"must be in {least:g} to {most:g}", unit)
    return number


def not_negative(name: str, value: object, unit: str = "") -> float:
    """`value` as a finite float >= 0.

    Raises:
        ValueError: not a finite real number, or < 0.
    """
    number = finite_number(name, value, unit)
    if number < 0:
        raise invalid(name, value, "must be finite and >= 0", unit)
    return number


def integer_at_least(name: str, value: object, minimum: int) -> int:
    """`value` as an int >= `minimum`; floats are refused even where they are whole.

    Raises:
        ValueError: not an integer, or below `minimum`.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < minimum:
        raise invalid(name, value, f"must be an integer >= {minimum}")
    return int(value)


def require_name(field: str, name: str) -> None:
    """Check a name that becomes part of the names of files and of groups in them.

    Raises:
        ValueError: other characters than letters, digits and _ . + -, dots alone, or more than 100 bytes.
    """
    if not _NAME.fullmatch(name) or len(name.encode()) > _LONGEST_NAME:
        accepted = "a name must consist of letters, digits and _ . + -, not of dots alone"
        raise invalid(field, name, f"{accepted}, and have at most {_LONGEST_NAME} bytes")


def require_one_of(name: str, value: object, accepted: tuple[str, ...]) -> None:
    """Check that `value` is one of the texts accepted.

    Raises:
        ValueError: it is not.
    """
    if value not in accepted:
        raise invalid(name, value, f"must be one of {', '.join(accepted)}")


def require_kind(name: str, value: object, kind: type) -> None:
    """Check that `value` is of a class of ours.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise invalid(name, value, f"must be {article} {kind.__name__}")


def positive_integers(name: str, value: object, count: int) -> tuple[int, ...]:
    """`value` as `count` integers >= 1.

    Raises:
        ValueError: another number of entries, or an entry that is not an integer >= 1.
    """
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != count:
        raise invalid(name, value, f"must be {count} integers >= 1")
    return tuple(integer_at_least(f"{name}[{index}]", entry, 1) for index, entry in enumerate(value))


def indices(name: str, value: object, count: int) -> list[int]:
    """`value` as indices from 0 to `count` - 1: at least one, each once.

    Raises:
        ValueError: it is not.
    """
    if isinstance(value, torch.Tensor | np.ndarray):  # their entries are no Integral
        value = value.tolist()
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise invalid(name, value, f"must be indices from 0 to {count - 1}")
    chosen = [integer_at_least(f"{name}[{place}]", one, 0) for place, one in enumerate(value)]
    if not chosen or len(set(chosen)) < len(chosen) or max(chosen) >= count:
        raise invalid(name, chosen, f"must be indices from 0 to {count - 1}, each once")
    return chosen


def finite_vector(name: str, value: object, unit: str = "m") -> Vector:
    """`value` as three finite floats.

    Raises:
        ValueError: not three real numbers, NaN or infinite.
    """
    x, y, z = _entries(name, value, 3, unit)
    return x, y, z


def positive_entries(name: str, value: object, count: int, unit: str = "m") -> tuple[float, ...]:
    """`value` as `count` finite floats > 0.

    Raises:
        ValueError: not `count` real numbers, or an entry that is NaN, infinite or <= 0.
    """
    entries = _entries(name, value, count, unit)
    if min(entries) <= 0:
        raise invalid(name, value, "every entry must be finite and > 0", unit)
    return entries


def unit_vector(name: str, value: object) -> Vector:
    """`value`, three finite floats, scaled to length 1.

    Raises:
        ValueError: not three finite real numbers, or too short to have a direction.
    """
    vector = np.array(finite_vector(name, value, unit=""))
    length = float(np.linalg.norm(vector))
    # A direction is what rounding leaves of it: below this length it is noise of a difference of metres.
    if not LENGTH_TOLERANCE < length < np.inf:
        raise invalid(name, value, f"must be a vector of finite length > {LENGTH_TOLERANCE:g}")
    x, y, z = (vector / length).tolist()
    return x, y, z


def real_tensor(name: str, value: object, unit: str = "") -> torch.Tensor:
    """`value` as a finite float64 tensor of any shape; a tensor keeps its device and its gradient.

    Raises:
        ValueError: ragged, not real numbers, NaN or infinite.
    """
    accepted = f"must be an array of real numbers{_in_unit(unit)}"
    tensor = _tensor(name, value, accepted)
    if tensor.is_complex():
        raise invalid(name, value, accepted)
    tensor = tensor.to(torch.float64)
    _require_finite(name, tensor, unit)
    return tensor


def complex_tensor(name: str, value: object) -> torch.Tensor:
    """`value` as a finite complex128 tensor of any shape; a tensor keeps its device and its gradient.

    A conjugate that PyTorch has only marked is carried out: not every function takes a marked one.

    Raises:
        ValueError: ragged, real (a drive is not its phases), NaN or infinite.
    """
    accepted = "must be an array of complex numbers"
    tensor = _tensor(name, value, accepted)
    if not tensor.is_complex():
        raise invalid(name, value, accepted)
    tensor = tensor.to(torch.complex128).resolve_conj()
    _require_finite(name, tensor)
    return tensor


def points_tensor(name: str, value: object) -> torch.Tensor:
    """`value` as points (P, 3) [m], P >= 1: a float64 copy without gradient, on the device of `value`.

    Raises:
        ValueError: another shape, no point, not real numbers, NaN or infinite.
    """
    points = real_tensor(name, value, "m")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"{name}: shape {tuple(points.shape)}; must be (P, 3) with P >= 1")
    return points.detach().clone()


def points_grid(name: str, value: object) -> tuple[torch.Tensor, torch.Size]:
    """`value` as points (P, 3) [m], as of `points_tensor`, and the shape (...) of their grid (..., 3).

    Raises:
        ValueError: another shape, no point, not real numbers, NaN or infinite.
    """
    points = real_tensor(name, value, "m")
    if points.ndim < 2 or points.shape[-1] != 3 or points.numel() == 0:
        raise ValueError(f"{name}: shape {tuple(points.shape)}; must be (P, 3) or (..., P, 3) with P >= 1")
    return points_tensor(name, points.reshape(-1, 3)), points.shape[:-1]


def require_distinct(name: str, points: torch.Tensor) -> None:
    """Check that no two of the `points` (P, 3) [m] coincide.

    Raises:
        ValueError: two points closer than `LENGTH_TOLERANCE`.
    """
    distance = distances(points, points).fill_diagonal_(torch.inf)
    first, second = divmod(int(distance.argmin()), len(points))
    if distance[first, second] < LENGTH_TOLERANCE:
        raise ValueError(
            f"{name}: points {first} and {second} coincide at {_shown(points[first])} m; "
            f"they must be at least {LENGTH_TOLERANCE:g} m apart"
        )


def distances(points: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Distances (P, M) [m] between `points` (P, 3) and `others` (M, 3)."""
    # The default of cdist expands the square, which loses half the digits of short distances.
    return torch.cdist(points, others, compute_mode="donot_use_mm_for_euclid_dist")


def _entries(name: str, value: object, count: int, unit: str) -> tuple[float, ...]:
    tensor = real_tensor(name, value, unit)
    if tensor.shape != (count,):
        raise invalid(name, value, f"must be {count} real numbers{_in_unit(unit)}")
    return tuple(float(entry) for entry in tensor.detach())


def _tensor(name: str, value: object, accepted: str) -> torch.Tensor:
    if not isinstance(value, torch.Tensor):
        # numpy would take a boolean among numbers as 0 or 1.
        if _has_boolean(value):
            raise invalid(name, value, accepted)
        try:
            array = np.asarray(value)
        except (ValueError, TypeError, RuntimeError) as error:
            raise invalid(name, value, accepted) from error
        if array.dtype.kind not in "iufc":
            raise invalid(name, value, accepted)
        # A copy: the caller's array may be read-only, or may change later.
        value = torch.from_numpy(array.astype(np.complex128 if array.dtype.kind == "c" else np.float64))
    if value.dtype == torch.bool:
        raise invalid(name, value, accepted)
    return value


def _has_boolean(value: object) -> bool:
    if isinstance(value, list | tuple):
        return any(_has_boolean(entry) for entry in value)
    return isinstance(value, bool | np.bool_)


def _require_finite(name: str, tensor: torch.Tensor, unit: str = "") -> None:
    bad = ~torch.isfinite(tensor.detach())
    if not bad.any():
        return
    if tensor.numel() <= _SHOWN_ENTRIES:
        raise invalid(name, tensor, "every entry must be finite", unit)
    index = torch.nonzero(bad)[0].tolist()
    raise invalid(f"{name}{index}", tensor[tuple(index)].item(), "every entry must be finite", unit)


def _shown(value: object) -> str:
    if isinstance(value, torch.Tensor | np.ndarray):
        if value.size > _SHOWN_ENTRIES if isinstance(value, np.ndarray) else value.numel() > _SHOWN_ENTRIES:
            return f"array of shape {tuple(value.shape)}"
        value = value.tolist()
    if isinstance(value, list):
        value = tuple(value)
    text = repr(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}..."


def _suffix(unit: str) -> str:
    return f" {unit}" if unit else ""


def _in_unit(unit: str) -> str:
    return f" [{unit}]" if unit else ""
