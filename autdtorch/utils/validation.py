"""Checks made once, where a value enters the package.

Every function takes the name of the field first and returns the checked value in one canonical form. A bad
value raises a `ValueError` of one line, ``field: value unit; accepted range``.
"""

from __future__ import annotations

import cmath
import contextlib
import math
import numbers
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, TypeAlias, TypeGuard

import numpy as np
import numpy.typing as npt
import torch

from autdtorch.utils.array_types import MOST_AXES, is_dense, triple
from autdtorch.utils.hints import did_you_mean
from autdtorch.utils.text import SHOWN_ENTRIES, shown

ArrayLike: TypeAlias = torch.Tensor | npt.ArrayLike
Vector: TypeAlias = tuple[float, float, float]

LENGTH_TOLERANCE = 1e-9
"""Lengths [m] that differ by less are equal: far above rounding at metre scale, far below wavelengths."""

ON_CPU = "the CPU gives the same results, to rounding"
"""Last words of messages about a missing GPU."""

_UNIT_ROUNDING = 4 * sys.float_info.epsilon  # by which the computed length of a unit vector may differ from 1
_LARGEST = 2**63 - 1  # largest integer that NumPy and PyTorch count with


def invalid(name: str, value: object, accepted: str, unit: str = "") -> ValueError:
    """Return the error to raise for `value` of field `name`; `accepted` says what is allowed."""
    message = f"{name}: {shown(value)}{f' {unit}' if unit else ''}; {accepted}"
    return ValueError(" ".join(message.split("\n")))


@contextlib.contextmanager
def within(place: object) -> Iterator[None]:
    """Put the name of a place, such as a file, in front of the message of a `ValueError`."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def require_one_of(name: str, value: object, accepted: Collection[str]) -> str:
    """Return `value`, one of the accepted texts."""
    if not isinstance(value, str) or value not in accepted:
        raise invalid(name, value, f"must be one of {', '.join(accepted)}{did_you_mean(value, accepted)}")
    return value


def require_known(where: str, keys: Iterable[Any], allowed: Collection[str], what: str = "key") -> None:
    """Refuse keys that are not allowed."""
    for key in keys:
        if key not in allowed:
            unknown = f"unknown {what} {key!r}{did_you_mean(key, allowed)}"
            raise ValueError(f"{where}: {unknown}; allowed {what}s: {', '.join(allowed)}")


def require_kind(name: str, value: object, kind: type) -> None:
    """Check that `value` is an instance of a class or protocol."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        hint = ", which load_scene(path) makes" if kind.__name__ == "Scene" and isinstance(value, str) else ""
        raise invalid(name, value, f"must be {article} {kind.__name__}{hint}")


def members(name: str, value: object, kind: type) -> tuple[Any, ...]:
    """Return the entries of an iterable, all instances of a class, as a tuple."""
    entries = _listed(name, value, f"must be a sequence, each entry of class {kind.__name__}")
    for index, entry in enumerate(entries):
        require_kind(f"{name}[{index}]", entry, kind)
    return tuple(entries)


def _listed(name: str, value: object, accepted: str) -> list[Any]:
    """Return the entries of an iterable other than text; errors of an iterator, such as a generator, pass."""
    if isinstance(value, Iterator):
        return list(value)
    try:
        if not isinstance(value, str | bytes):
            return list(value)  # type: ignore[call-overload, no-any-return]
    except Exception as error:  # a user's class may raise anything
        raise invalid(name, value, accepted) from error
    raise invalid(name, value, accepted)


def require_callable(name: str, value: object) -> None:
    """Check that `value` can be called."""
    if not callable(value):
        raise invalid(name, value, "must be a function")


def finite_number(name: str, value: object, unit: str = "") -> float:
    """Return `value` as a finite float; text, booleans and complex numbers are refused."""
    if isinstance(value, torch.Tensor | np.ndarray) and value.ndim == 0 and _is_plain(value):
        value = value.item()
    if not _is_plain(value) or not isinstance(value, numbers.Real):
        raise invalid(name, value, f"must be a real number{_in_unit(unit)}")
    try:
        number = float(value)
    except OverflowError:  # an integer or a fraction, too large for a float
        number = math.inf
    except Exception as error:  # of a user's class
        raise invalid(name, value, f"must be a real number{_in_unit(unit)}") from error
    if not math.isfinite(number):
        raise invalid(name, value, "must be finite", unit)
    return number


def complex_number(name: str, value: object, unit: str = "") -> complex:
    """Return `value` as a finite float, or as a complex number where its imaginary part is not 0."""
    if isinstance(value, torch.Tensor | np.ndarray) and value.ndim == 0 and _is_plain(value):
        value = value.item()
    if not _is_plain(value) or not isinstance(value, numbers.Complex):
        raise invalid(name, value, f"must be a real or complex number{_in_unit(unit)}")
    if isinstance(value, numbers.Real):
        return finite_number(name, value, unit)
    number = complex(value)
    if not cmath.isfinite(number):
        raise invalid(name, value, "must be finite", unit)
    return number if number.imag else number.real


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


def boolean(name: str, value: object) -> bool:
    """Return `value`, True or False, as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise invalid(name, value, "must be true or false")
    return bool(value)


def integer_at_least(name: str, value: object, minimum: int) -> int:
    """Return `value` as an int >= `minimum`; whole floats are refused too."""
    number = int(value) if _is_plain(value) and isinstance(value, numbers.Integral) else minimum - 1
    if not minimum <= number <= _LARGEST:
        most = " and < 2^63" if number > _LARGEST else ""
        raise invalid(name, value, f"must be an integer >= {minimum}{most}")
    return number


def integers(name: str, value: object, minimum: int, accepted: str) -> list[int]:
    """Return `value`, a sequence or an array with one axis, as integers >= `minimum`."""
    if isinstance(value, torch.Tensor | np.ndarray) and is_dense(value):  # entries need not be Integral
        value = value.tolist()
    if not isinstance(value, Sequence):
        raise invalid(name, value, accepted)
    entries = _listed(name, value, accepted)
    return [integer_at_least(f"{name}[{place}]", entry, minimum) for place, entry in enumerate(entries)]


def positive_integers(name: str, value: object, count: int) -> tuple[int, ...]:
    """Return `value` as `count` integers >= 1."""
    accepted = f"must be {count} integers >= 1"
    entries = integers(name, value, 1, accepted)
    if len(entries) != count:
        raise invalid(name, entries, accepted)
    return tuple(entries)


def indices(name: str, value: object, count: int, what: str = "indices") -> list[int]:
    """Return `value` as indices from 0 to `count` - 1, named by `what`: at least one, each once."""
    accepted = f"must be {what} from 0 to {count - 1}"
    chosen = integers(name, value, 0, accepted)
    if not chosen or len(set(chosen)) < len(chosen) or max(chosen) >= count:
        raise invalid(name, chosen, f"{accepted}, each once")
    return chosen


def device_type(name: str, value: object) -> str | None:
    """Return "cpu" or "cuda", the type of a device as text or `torch.device`, or None for None."""
    if value is None:
        return None
    device = None
    if isinstance(value, str | torch.device):
        with contextlib.suppress(RuntimeError):  # of text that PyTorch does not know
            device = torch.device(value)
    if device is None or device.type not in ("cpu", "cuda"):
        raise invalid(name, value, "must be 'cpu', 'cuda' or a torch.device of these")
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise invalid(name, str(device), no_cuda())
        current = torch.cuda.current_device()
        if device.index not in (None, current):
            accepted = f"must be the current one, cuda:{current}; torch.cuda.set_device chooses it"
            raise invalid(name, str(device), accepted)
    return device.type


def no_cuda() -> str:
    """Return for messages why PyTorch finds no CUDA device, and what to do."""
    built = torch.version.cuda is not None
    why = "it finds no GPU or driver" if built else "it is built for the CPU; pytorch.org has builds for CUDA"
    return (
        f"needs an NVIDIA GPU that PyTorch can use, but {why} (torch.cuda.is_available() is false); {ON_CPU}"
    )


def finite_vector(name: str, value: object, unit: str = "m") -> Vector:
    """Return `value` as three finite floats."""
    return triple(_entries(name, value, 3, unit))


def positive_entries(name: str, value: object, count: int) -> tuple[float, ...]:
    """Return `value` as `count` finite lengths > 0 [m]."""
    entries = _entries(name, value, count, "m")
    if min(entries) <= 0:
        raise invalid(name, value, "every entry must be finite and > 0", "m")
    return entries


def unit_vector(name: str, value: object) -> Vector:
    """Return `value`, three finite floats, scaled to length 1."""
    vector = finite_vector(name, value, unit="")
    length = math.hypot(*vector)
    # A shorter vector may be the rounding error of a difference of metres, whose direction is noise.
    if not LENGTH_TOLERANCE < length < math.inf:
        raise invalid(name, value, f"must be a vector of finite length > {LENGTH_TOLERANCE:g}")
    if abs(length - 1) < _UNIT_ROUNDING:  # so that a unit vector stays what it is, in files and their digests
        return vector
    return triple(entry / length for entry in vector)


def real_tensor(name: str, value: object, unit: str = "") -> torch.Tensor:
    """Return `value` as a finite float64 tensor of any shape; a tensor keeps its device and its gradient."""
    return _real(name, value, f"must be an array of real numbers{_in_unit(unit)}", unit)


def gappy_tensor(name: str, value: object, unit: str = "") -> torch.Tensor:
    """Return `value` as a float64 tensor of any shape, as `real_tensor` does, where NaN is a gap."""
    accepted = f"must be an array of real numbers{_in_unit(unit)}, NaN for a gap"
    return _real(name, value, accepted, unit, gaps=True)


def complex_tensor(
    name: str, value: object, accepted: str = "must be an array of complex numbers"
) -> torch.Tensor:
    """Return `value` as a finite complex128 tensor of any shape; a tensor keeps its device and its gradient.

    A lazy conjugate is resolved, because not every PyTorch function takes one.
    """
    tensor = _tensor(name, value, accepted)
    if not tensor.is_complex():
        raise invalid(name, value, accepted)
    tensor = tensor.to(torch.complex128).resolve_conj()
    _require_finite(name, tensor)
    return tensor


def magnitude_tensor(name: str, value: object, unit: str = "") -> torch.Tensor:
    """Return |value| as a float64 tensor of any shape; complex numbers, NaN and infinity are accepted."""
    tensor = _tensor(name, value, f"must be an array of numbers{_in_unit(unit)}")
    return tensor.to(torch.complex128 if tensor.is_complex() else torch.float64).abs()


def points_tensor(name: str, value: object) -> torch.Tensor:
    """Return a float64 copy of `value`, points (P, 3) [m], P >= 1, on its device and without gradient."""
    return differentiable_points(name, value).detach().clone()


def differentiable_points(name: str, value: object) -> torch.Tensor:
    """Return points (P, 3) [m], P >= 1, as float64; a tensor keeps its device and its gradient."""
    points = real_tensor(name, value, "m")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"{name}: shape {tuple(points.shape)}; must be (P, 3) with P >= 1")
    return points


def points_grid(name: str, value: object) -> tuple[torch.Tensor, torch.Size]:
    """Return points on a grid (..., 3) [m] as (P, 3) with their gradient, and the grid's shape (...)."""
    points = real_tensor(name, value, "m")
    if points.ndim < 2 or points.shape[-1] != 3 or points.numel() == 0:
        raise ValueError(f"{name}: shape {tuple(points.shape)}; must be (P, 3) or (..., P, 3) with P >= 1")
    return points.reshape(-1, 3), points.shape[:-1]


def _in_unit(unit: str) -> str:
    """Return the unit as messages name it after what they accept."""
    return f" [{unit}]" if unit else ""


def _entries(name: str, value: object, count: int, unit: str) -> tuple[float, ...]:
    accepted = f"must be {count} real numbers{_in_unit(unit)}"
    tensor = _real(name, value, accepted, unit)
    if tensor.shape != (count,):
        raise invalid(name, value, accepted)
    return tuple(float(entry) for entry in tensor.detach())


def _real(name: str, value: object, accepted: str, unit: str, gaps: bool = False) -> torch.Tensor:
    tensor = _tensor(name, value, accepted)
    if tensor.is_complex():
        raise invalid(name, value, accepted)
    tensor = tensor.to(torch.float64)
    _require_finite(name, torch.where(tensor.isnan(), 0.0, tensor) if gaps else tensor, unit)
    return tensor


def _tensor(name: str, value: object, accepted: str) -> torch.Tensor:
    try:
        numeric = _holds_numbers(value)
        if numeric and isinstance(value, torch.Tensor):
            return value.as_subclass(torch.Tensor)  # a subclass may override functions
        array = np.asarray(value if numeric else None)
    except Exception as error:  # a user's class may raise anything
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
    for _ in range(MOST_AXES):
        entries = [entry for entry in entries if type(entry) is not float]  # nearly all of long lists
        if not all(map(_is_plain, entries)):
            return False
        lists = {id(entry): entry for entry in entries if _is_list(entry)}
        if not lists:
            return True
        entries = [entry for listed in lists.values() for entry in listed]
    return False


def _is_list(value: object) -> TypeGuard[Iterable[Any]]:
    """Check that NumPy would iterate over `value`; it does so for any class with length and index."""
    kind = type(value)
    if issubclass(kind, str | bytes | memoryview) or hasattr(kind, "__array__"):
        return False
    return hasattr(kind, "__getitem__") and hasattr(kind, "__len__")


def _require_finite(name: str, tensor: torch.Tensor, unit: str = "") -> None:
    values = tensor.detach()
    # Of complex numbers, `isfinite` takes three times as long.
    if torch.isfinite(torch.view_as_real(values) if values.is_complex() else values).all():
        return
    if tensor.numel() <= SHOWN_ENTRIES:
        raise invalid(name, tensor, "every entry must be finite", unit)
    index = torch.nonzero(~torch.isfinite(values))[0].tolist()
    raise invalid(f"{name}{index}", tensor[tuple(index)].item(), "every entry must be finite", unit)


def _is_plain(value: object) -> bool:
    """Check that `value` is no boolean and, if it is an array, a dense array of numbers."""
    if isinstance(value, torch.Tensor | np.ndarray | np.generic):
        return is_dense(value) and "bool" not in str(value.dtype)
    return not isinstance(value, bool)
