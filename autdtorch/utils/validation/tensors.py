"""Arrays of numbers as float64 or complex128 tensors: vectors, points and arrays of any shape."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, TypeAlias, TypeGuard

import numpy as np
import numpy.typing as npt
import torch

from autdtorch.utils.validation.values import DEEPEST, SHOWN_ENTRIES, in_unit, invalid, is_plain

ArrayLike: TypeAlias = torch.Tensor | npt.ArrayLike
Vector: TypeAlias = tuple[float, float, float]

LENGTH_TOLERANCE = 1e-9
"""Lengths that differ by less are taken to be equal [m]: far above rounding at metre scale, and far below
any wavelength."""


def finite_vector(name: str, value: object, unit: str = "m") -> Vector:
    """Return `value` as three finite floats."""
    x, y, z = _entries(name, value, 3, unit)
    return x, y, z


def positive_entries(name: str, value: object, count: int, unit: str = "m") -> tuple[float, ...]:
    """Return `value` as `count` finite floats > 0."""
    entries = _entries(name, value, count, unit)
    if min(entries) <= 0:
        raise invalid(name, value, "every entry must be finite and > 0", unit)
    return entries


def unit_vector(name: str, value: object) -> Vector:
    """Return `value`, three finite floats, scaled to length 1."""
    vector = finite_vector(name, value, unit="")
    length = math.hypot(*vector)
    # A shorter vector may be the rounding error of a difference of metres, whose direction is noise.
    if not LENGTH_TOLERANCE < length < math.inf:
        raise invalid(name, value, f"must be a vector of finite length > {LENGTH_TOLERANCE:g}")
    x, y, z = (entry / length for entry in vector)
    return x, y, z


def real_tensor(name: str, value: object, unit: str = "") -> torch.Tensor:
    """Return `value` as a finite float64 tensor of any shape; a tensor keeps its device and its gradient."""
    accepted = f"must be an array of real numbers{in_unit(unit)}"
    tensor = _tensor(name, value, accepted)
    if tensor.is_complex():
        raise invalid(name, value, accepted)
    tensor = tensor.to(torch.float64)
    _require_finite(name, tensor, unit)
    return tensor


def complex_tensor(name: str, value: object) -> torch.Tensor:
    """Return `value` as a finite complex128 tensor of any shape; a tensor keeps its device and its gradient.

    A lazy conjugate is resolved, because not every PyTorch function takes one.
    """
    accepted = "must be an array of complex numbers"
    tensor = _tensor(name, value, accepted)
    if not tensor.is_complex():
        raise invalid(name, value, accepted)
    tensor = tensor.to(torch.complex128).resolve_conj()
    _require_finite(name, tensor)
    return tensor


def magnitude_tensor(name: str, value: object, unit: str = "") -> torch.Tensor:
    """Return |value| as a float64 tensor of any shape; complex numbers, NaN and infinity are accepted."""
    tensor = _tensor(name, value, f"must be an array of numbers{in_unit(unit)}")
    return tensor.to(torch.complex128 if tensor.is_complex() else torch.float64).abs()


def points_tensor(name: str, value: object) -> torch.Tensor:
    """Return a float64 copy of `value`, points (P, 3) [m], P >= 1, on its device and without gradient."""
    points = real_tensor(name, value, "m")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"{name}: shape {tuple(points.shape)}; must be (P, 3) with P >= 1")
    return points.detach().clone()


def points_grid(name: str, value: object) -> tuple[torch.Tensor, torch.Size]:
    """Return points on a grid (..., 3) [m] as `points_tensor` does, and the shape (...) of the grid."""
    points = real_tensor(name, value, "m")
    if points.ndim < 2 or points.shape[-1] != 3 or points.numel() == 0:
        raise ValueError(f"{name}: shape {tuple(points.shape)}; must be (P, 3) or (..., P, 3) with P >= 1")
    return points_tensor(name, points.reshape(-1, 3)), points.shape[:-1]


def _entries(name: str, value: object, count: int, unit: str) -> tuple[float, ...]:
    tensor = real_tensor(name, value, unit)
    if tensor.shape != (count,):
        raise invalid(name, value, f"must be {count} real numbers{in_unit(unit)}")
    return tuple(float(entry) for entry in tensor.detach())


def _tensor(name: str, value: object, accepted: str) -> torch.Tensor:
    try:
        numeric = _holds_numbers(value)
        if numeric and isinstance(value, torch.Tensor):
            return value.as_subclass(torch.Tensor)  # a subclass may override functions
        array = np.asarray(value if numeric else None)
    except Exception as error:  # a class of the user's own may raise anything
        raise invalid(name, value, accepted) from error
    if array.dtype.kind not in "iufc":
        raise invalid(name, value, accepted)
    # A copy: the caller's array may be read-only, or may change later.
    with np.errstate(over="ignore"):  # an overflow becomes infinite, which is refused
        array = array.astype(np.complex128 if array.dtype.kind == "c" else np.float64)
    return torch.from_numpy(array)


def _holds_numbers(value: object) -> bool:
    """Check nested lists before NumPy converts them.

    NumPy takes a boolean among numbers as 0 or 1, drops masks, and never ends on a list that contains itself
    twice.
    """
    entries = [value]
    for _ in range(DEEPEST):
        if not all(map(is_plain, entries)):
            return False
        lists = {id(entry): entry for entry in entries if _is_list(entry)}
        if not lists:
            return True
        entries = [entry for one in lists.values() for entry in one]
    return False


def _is_list(value: object) -> TypeGuard[Iterable[Any]]:
    """Check that NumPy would iterate over `value`; it does so for any class with length and index."""
    kind = type(value)
    if issubclass(kind, str | bytes | memoryview) or hasattr(kind, "__array__"):
        return False
    return hasattr(kind, "__getitem__") and hasattr(kind, "__len__")


def _require_finite(name: str, tensor: torch.Tensor, unit: str = "") -> None:
    bad = ~torch.isfinite(tensor.detach())
    if not bad.any():
        return
    if tensor.numel() <= SHOWN_ENTRIES:
        raise invalid(name, tensor, "every entry must be finite", unit)
    index = torch.nonzero(bad)[0].tolist()
    raise invalid(f"{name}{index}", tensor[tuple(index)].item(), "every entry must be finite", unit)
