"""Checks made once, where a value enters the package.

Every function takes the name of the field first and returns the checked value in one canonical form. What is
wrong is reported as a `ValueError` of the shape ``field: value unit; accepted range``, in one line.
"""

from __future__ import annotations

import contextlib
import math
import numbers
import os
import re
import reprlib
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeGuard

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
_SHOWN_BITS = 128  # of an integer; Python refuses to write out very large ones
_DEEPEST = 16  # axes of an array, or lists in lists; not every function of PyTorch takes more than 25
_LARGEST = 2**63 - 1  # integer that NumPy and PyTorch count with

_DENSITIES = 1e-9, 1e9  # [kg/m^3]; far beyond all materials, and near enough for squares of ratios
_SOUND_SPEEDS = 1e-3, 1e6  # [m/s]


def invalid(name: str, value: object, accepted: str, unit: str = "") -> ValueError:
    """Return the error to raise for `value` of field `name`; `accepted` says what is allowed."""
    message = f"{name}: {_shown(value)}{_suffix(unit)}; {accepted}"
    return ValueError(" ".join(message.split("\n")))


def finite_number(name: str, value: object, unit: str = "") -> float:
    """Return `value` as a finite float.

    Raises:
        ValueError: not a real number (text, booleans and complex numbers are none), NaN or infinite.
    """
    if isinstance(value, torch.Tensor | np.ndarray) and value.ndim == 0 and _is_plain(value):
        value = value.item()
    if not _is_plain(value) or not isinstance(value, numbers.Real):
        raise invalid(name, value, f"must be a real number{_in_unit(unit)}")
    try:
        number = float(value)
    except OverflowError:  # an integer or a fraction, too large for a float
        number = math.inf
    except Exception as error:  # of a class of the user's own
        raise invalid(name, value, f"must be a real number{_in_unit(unit)}") from error
    if not math.isfinite(number):
        raise invalid(name, value, "must be finite", unit)
    return number


def positive(name: str, value: object, unit: str = "") -> float:
    """Return `value` as a finite float > 0.

    Raises:
        ValueError: not a finite real number, or <= 0.
    """
    number = finite_number(name, value, unit)
    if number <= 0:
        raise invalid(name, value, "must be finite and > 0", unit)
    return number


def number_between(name: str, value: object, least: float, most: float, unit: str = "") -> float:
    """Return `value` as a float in `least` to `most`, ends included.

    Raises:
        ValueError: not a real number, NaN or outside.
    """
    number = finite_number(name, value, unit)
    if not least <= number <= most:
        raise invalid(name, value, f"must be in {least:g} to {most:g}", unit)
    return number


def fluid(kind: str, density: object, sound_speed: object) -> tuple[float, float]:
    """Return the density [kg/m^3] and sound speed [m/s] of a fluid, checked; `kind` is of what, for messages.

    Raises:
        ValueError: not a number, or out of range.
    """
    rho = positive(f"{kind}.density", density, "kg/m^3")
    c = positive(f"{kind}.sound_speed", sound_speed, "m/s")
    return (
        number_between(f"{kind}.density", rho, *_DENSITIES, "kg/m^3"),
        number_between(f"{kind}.sound_speed", c, *_SOUND_SPEEDS, "m/s"),
    )


def not_negative(name: str, value: object, unit: str = "") -> float:
    """Return `value` as a finite float >= 0.

    Raises:
        ValueError: not a finite real number, or < 0.
    """
    number = finite_number(name, value, unit)
    if number < 0:
        raise invalid(name, value, "must be finite and >= 0", unit)
    return number


def integer_at_least(name: str, value: object, minimum: int) -> int:
    """Return `value` as an int >= `minimum`; floats are refused even where they are whole.

    Raises:
        ValueError: not an integer, below `minimum`, or 2^63 and more.
    """
    number = int(value) if _is_plain(value) and isinstance(value, numbers.Integral) else minimum - 1
    if not minimum <= number <= _LARGEST:
        most = " and < 2^63" if number > _LARGEST else ""
        raise invalid(name, value, f"must be an integer >= {minimum}{most}")
    return number


def require_name(field: str, name: object) -> None:
    """Check a name that becomes part of the names of files and of groups in them.

    Raises:
        ValueError: no text, other characters than letters, digits and _ . + -, dots alone, or more than 100
            bytes.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name) or len(name.encode()) > _LONGEST_NAME:
        accepted = "a name must be text, consist of letters, digits and _ . + -, not of dots alone"
        raise invalid(field, name, f"{accepted}, and have at most {_LONGEST_NAME} bytes")


def boolean(name: str, value: object) -> bool:
    """Return `value`, which must be true or false itself, as a bool.

    Raises:
        ValueError: another kind of value, numbers included.
    """
    if not isinstance(value, bool | np.bool_):
        raise invalid(name, value, "must be true or false")
    return bool(value)


def path_of(name: str, value: object, what: str = "a file") -> Path:
    """Return `value` as the path of `what`, which need not be there.

    Raises:
        ValueError: neither text nor a path, empty, or with a character that no path has.
    """
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str) or not text or "\0" in text:
        raise invalid(name, value, f"must be the path of {what}")
    return Path(text)


def require_one_of(name: str, value: object, accepted: Iterable[str]) -> None:
    """Check that `value` is one of the texts accepted.

    Raises:
        ValueError: it is not.
    """
    accepted = tuple(accepted)
    if not isinstance(value, str) or value not in accepted:
        raise invalid(name, value, f"must be one of {', '.join(accepted)}")


def require_known(where: str, given: Iterable[Any], allowed: Collection[str]) -> None:
    """Refuse keys that are not allowed.

    Raises:
        ValueError: names the first such key.
    """
    for key in given:
        if key not in allowed:
            raise ValueError(f"{where}: unknown key {key!r}; allowed keys: {', '.join(allowed)}")


def require_kind(name: str, value: object, kind: type) -> None:
    """Check that `value` is of a class or protocol.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise invalid(name, value, f"must be {article} {kind.__name__}")


def members(name: str, value: object, kind: type) -> tuple[Any, ...]:
    """Return `value`, an iterable, as a tuple of members of a class.

    Raises:
        ValueError: text, no iterable, or a member of another class.
    """
    accepted = f"must be a sequence, each entry of class {kind.__name__}"
    if isinstance(value, str | bytes):
        raise invalid(name, value, accepted)
    try:
        entries: tuple[Any, ...] = tuple(value)  # type: ignore[arg-type]
    except Exception as error:  # of a class of the user's own, too
        raise invalid(name, value, accepted) from error
    for index, entry in enumerate(entries):
        require_kind(f"{name}[{index}]", entry, kind)
    return entries


def require_callable(name: str, value: object) -> None:
    """Check that `value` can be called.

    Raises:
        ValueError: it cannot.
    """
    if not callable(value):
        raise invalid(name, value, "must be a function")


def integers(name: str, value: object, minimum: int, accepted: str) -> list[int]:
    """Return `value`, a sequence or an array with one axis, as integers >= `minimum`.

    Raises:
        ValueError: another kind of value, of which `accepted` says what is allowed, or an entry out of range.
    """
    if isinstance(value, torch.Tensor | np.ndarray) and is_dense(value):  # their entries are no Integral
        value = value.tolist()
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        raise invalid(name, value, accepted)
    try:
        entries = list(value)
    except Exception as error:  # of a class of the user's own
        raise invalid(name, value, accepted) from error
    return [integer_at_least(f"{name}[{place}]", entry, minimum) for place, entry in enumerate(entries)]


def positive_integers(name: str, value: object, count: int) -> tuple[int, ...]:
    """Return `value` as `count` integers >= 1.

    Raises:
        ValueError: another number of entries, or an entry that is not an integer >= 1.
    """
    accepted = f"must be {count} integers >= 1"
    entries = integers(name, value, 1, accepted)
    if len(entries) != count:
        raise invalid(name, entries, accepted)
    return tuple(entries)


def indices(name: str, value: object, count: int) -> list[int]:
    """Return `value` as indices from 0 to `count` - 1: at least one, each once.

    Raises:
        ValueError: it is not.
    """
    chosen = integers(name, value, 0, f"must be indices from 0 to {count - 1}")
    if not chosen or len(set(chosen)) < len(chosen) or max(chosen) >= count:
        raise invalid(name, chosen, f"must be indices from 0 to {count - 1}, each once")
    return chosen


def finite_vector(name: str, value: object, unit: str = "m") -> Vector:
    """Return `value` as three finite floats.

    Raises:
        ValueError: not three real numbers, NaN or infinite.
    """
    x, y, z = _entries(name, value, 3, unit)
    return x, y, z


def positive_entries(name: str, value: object, count: int, unit: str = "m") -> tuple[float, ...]:
    """Return `value` as `count` finite floats > 0.

    Raises:
        ValueError: not `count` real numbers, or an entry that is NaN, infinite or <= 0.
    """
    entries = _entries(name, value, count, unit)
    if min(entries) <= 0:
        raise invalid(name, value, "every entry must be finite and > 0", unit)
    return entries


def unit_vector(name: str, value: object) -> Vector:
    """Return `value`, three finite floats, scaled to length 1.

    Raises:
        ValueError: not three finite real numbers, or too short to have a direction.
    """
    vector = finite_vector(name, value, unit="")
    length = math.hypot(*vector)
    # A direction is what rounding leaves of it: below this length it is noise of a difference of metres.
    if not LENGTH_TOLERANCE < length < math.inf:
        raise invalid(name, value, f"must be a vector of finite length > {LENGTH_TOLERANCE:g}")
    x, y, z = (entry / length for entry in vector)
    return x, y, z


def real_tensor(name: str, value: object, unit: str = "") -> torch.Tensor:
    """Return `value` as a finite float64 tensor of any shape; a tensor keeps its device and its gradient.

    Raises:
        ValueError: ragged, not real numbers, masked, not dense, NaN or infinite.
    """
    accepted = f"must be an array of real numbers{_in_unit(unit)}"
    tensor = _tensor(name, value, accepted)
    if tensor.is_complex():
        raise invalid(name, value, accepted)
    tensor = tensor.to(torch.float64)
    _require_finite(name, tensor, unit)
    return tensor


def complex_tensor(name: str, value: object) -> torch.Tensor:
    """Return `value` as a finite complex128 tensor of any shape; a tensor keeps its device and its gradient.

    A conjugate that PyTorch has only marked is carried out: not every function takes a marked one.

    Raises:
        ValueError: ragged, real (a drive is not its phases), masked, not dense, NaN or infinite.
    """
    accepted = "must be an array of complex numbers"
    tensor = _tensor(name, value, accepted)
    if not tensor.is_complex():
        raise invalid(name, value, accepted)
    tensor = tensor.to(torch.complex128).resolve_conj()
    _require_finite(name, tensor)
    return tensor


def magnitude_tensor(name: str, value: object, unit: str = "") -> torch.Tensor:
    """Return |value|, of real or complex numbers, as a float64 tensor of any shape; NaN and infinity stay.

    Raises:
        ValueError: ragged, not numbers, masked or not dense.
    """
    tensor = _tensor(name, value, f"must be an array of numbers{_in_unit(unit)}")
    return tensor.to(torch.complex128 if tensor.is_complex() else torch.float64).abs()


def is_dense(value: torch.Tensor | npt.NDArray[Any] | np.generic) -> bool:
    """Check that an array of few axes holds numbers or booleans, all of them in memory and none masked."""
    if isinstance(value, torch.Tensor):
        plain = value.layout == torch.strided and not (value.is_quantized or value.is_nested or value.is_meta)
    else:
        plain = value.dtype.kind in "biufc" and not np.ma.is_masked(value)
    return plain and value.ndim <= _DEEPEST


def points_tensor(name: str, value: object) -> torch.Tensor:
    """Return `value` as points (P, 3) [m], P >= 1: a float64 copy without gradient, on the device of `value`.

    Raises:
        ValueError: another shape, no point, not real numbers, NaN or infinite.
    """
    points = real_tensor(name, value, "m")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"{name}: shape {tuple(points.shape)}; must be (P, 3) with P >= 1")
    return points.detach().clone()


def points_grid(name: str, value: object) -> tuple[torch.Tensor, torch.Size]:
    """Return `value` as points (P, 3) [m], as of `points_tensor`, and the shape (...) of their grid (..., 3).

    Raises:
        ValueError: another shape, no point, not real numbers, NaN or infinite.
    """
    points = real_tensor(name, value, "m")
    if points.ndim < 2 or points.shape[-1] != 3 or points.numel() == 0:
        raise ValueError(f"{name}: shape {tuple(points.shape)}; must be (P, 3) or (..., P, 3) with P >= 1")
    return points_tensor(name, points.reshape(-1, 3)), points.shape[:-1]


def _entries(name: str, value: object, count: int, unit: str) -> tuple[float, ...]:
    tensor = real_tensor(name, value, unit)
    if tensor.shape != (count,):
        raise invalid(name, value, f"must be {count} real numbers{_in_unit(unit)}")
    return tuple(float(entry) for entry in tensor.detach())


def _tensor(name: str, value: object, accepted: str) -> torch.Tensor:
    try:
        numeric = _holds_numbers(value)
        if numeric and isinstance(value, torch.Tensor):
            return value.as_subclass(torch.Tensor)  # free of what a class of its own does
        array = np.asarray(value if numeric else None)
    except Exception as error:  # of a class of the user's own, too
        raise invalid(name, value, accepted) from error
    if array.dtype.kind not in "iufc":
        raise invalid(name, value, accepted)
    # A copy: the caller's array may be read-only, or may change later.
    with np.errstate(over="ignore"):  # more than a double holds becomes infinite, which is refused
        array = array.astype(np.complex128 if array.dtype.kind == "c" else np.float64)
    return torch.from_numpy(array)


def _holds_numbers(value: object) -> bool:
    """Check that NumPy neither alters what it converts nor goes on for ever.

    It takes a boolean among numbers as 0 or 1, and drops masks. A list that holds itself twice keeps it busy
    for ever, of whatever class it is.
    """
    entries = [value]
    for _ in range(_DEEPEST):
        if not all(map(_is_plain, entries)):
            return False
        lists = {id(entry): entry for entry in entries if _is_list(entry)}
        if not lists:
            return True
        entries = [entry for one in lists.values() for entry in one]
    return False


def _is_list(value: object) -> TypeGuard[Iterable[Any]]:
    """Check that NumPy goes through the entries of `value`: for that it needs to be of no class."""
    kind = type(value)
    if issubclass(kind, str | bytes | memoryview) or hasattr(kind, "__array__"):
        return False
    return hasattr(kind, "__getitem__") and hasattr(kind, "__len__")


def _is_plain(value: object) -> bool:
    """Check that `value` is no boolean and, if it is an array, a dense one of numbers."""
    if isinstance(value, torch.Tensor):
        return is_dense(value) and value.dtype != torch.bool
    if isinstance(value, np.ndarray | np.generic):
        return is_dense(value) and value.dtype != np.bool_
    return not isinstance(value, bool)


def _require_finite(name: str, tensor: torch.Tensor, unit: str = "") -> None:
    bad = ~torch.isfinite(tensor.detach())
    if not bad.any():
        return
    if tensor.numel() <= _SHOWN_ENTRIES:
        raise invalid(name, tensor, "every entry must be finite", unit)
    index = torch.nonzero(bad)[0].tolist()
    raise invalid(f"{name}{index}", tensor[tuple(index)].item(), "every entry must be finite", unit)


class _Short(reprlib.Repr):
    """The text of a value, however large or deep the value is."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxtuple, self.maxlist = 3, _SHOWN_ENTRIES, _SHOWN_ENTRIES
        self.maxstring = self.maxother = _SHOWN_CHARACTERS

    def repr_int(self, value: int, level: int) -> str:
        bits = value.bit_length()
        return repr(value) if bits <= _SHOWN_BITS else f"integer of {bits} bits"

    def repr_instance(self, value: Any, level: int) -> str:
        with contextlib.suppress(Exception):  # of a class of the user's own
            if isinstance(value, Sequence) and not isinstance(value, memoryview):
                return self.repr_list(value, level)  # type: ignore[arg-type]
        return super().repr_instance(value, level)


def _shown(value: object) -> str:
    if isinstance(value, torch.Tensor) and not is_dense(value):
        return f"tensor of {value.dtype}, {value.layout}, on {value.device}"
    if isinstance(value, np.ma.MaskedArray):
        return f"masked array of shape {value.shape}"
    if isinstance(value, torch.Tensor | np.ndarray):
        if math.prod(value.shape) > _SHOWN_ENTRIES:
            return f"array of shape {tuple(value.shape)}"
        value = value.tolist()
    if isinstance(value, list):
        value = tuple(value)
    text = _Short().repr(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}..."


def _suffix(unit: str) -> str:
    return f" {unit}" if unit else ""


def _in_unit(unit: str) -> str:
    return f" [{unit}]" if unit else ""
