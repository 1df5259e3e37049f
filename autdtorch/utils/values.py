"""The error of a bad value, the text of values in messages, and checks that a value is plain."""

from __future__ import annotations

import contextlib
import math
import reprlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

DEEPEST = 16  # most axes of an array, or levels of nested lists; some functions of PyTorch take at most 25
SHOWN_ENTRIES = 9
_SHOWN_CHARACTERS = 120
_SHOWN_BITS = 128  # of an integer; Python refuses to write out very large ones


def invalid(name: str, value: object, accepted: str, unit: str = "") -> ValueError:
    """Return the error to raise for `value` of field `name`; `accepted` says what is allowed."""
    message = f"{name}: {_shown(value)}{f' {unit}' if unit else ''}; {accepted}"
    return ValueError(" ".join(message.split("\n")))


@contextlib.contextmanager
def within(place: object) -> Iterator[None]:
    """Put the name of a place, such as a file, in front of the message of a `ValueError`."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def is_dense(value: torch.Tensor | npt.NDArray[Any] | np.generic) -> bool:
    """Check that an array has few axes and holds unmasked numbers or booleans in memory."""
    if isinstance(value, torch.Tensor):
        plain = value.layout == torch.strided and not (value.is_quantized or value.is_nested or value.is_meta)
    else:
        plain = value.dtype.kind in "biufc" and not np.ma.is_masked(value)
    return plain and value.ndim <= DEEPEST


def is_plain(value: object) -> bool:
    """Check that `value` is no boolean and, if it is an array, a dense array of numbers."""
    if isinstance(value, torch.Tensor):
        return is_dense(value) and value.dtype != torch.bool
    if isinstance(value, np.ndarray | np.generic):
        return is_dense(value) and value.dtype != np.bool_
    return not isinstance(value, bool)


def _shown(value: object) -> str:
    if isinstance(value, torch.Tensor) and not is_dense(value):
        return f"tensor of {value.dtype}, {value.layout}, on {value.device}"
    if isinstance(value, np.ma.MaskedArray):
        return f"masked array of shape {value.shape}"
    if isinstance(value, torch.Tensor | np.ndarray):
        if math.prod(value.shape) > SHOWN_ENTRIES:
            return f"array of shape {tuple(value.shape)}"
        value = value.tolist()
    if isinstance(value, list):
        value = tuple(value)
    text = _Short().repr(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}..."


class _Short(reprlib.Repr):
    """The text of a value, however large or deep the value is."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxtuple, self.maxlist = 3, SHOWN_ENTRIES, SHOWN_ENTRIES
        self.maxstring = self.maxother = _SHOWN_CHARACTERS

    def repr_int(self, value: int, level: int) -> str:
        bits = value.bit_length()
        return repr(value) if bits <= _SHOWN_BITS else f"integer of {bits} bits"

    def repr_instance(self, value: Any, level: int) -> str:
        with contextlib.suppress(Exception):  # of a user's class
            if isinstance(value, Sequence) and not isinstance(value, memoryview):
                return self.repr_list(value, level)  # type: ignore[arg-type]
        return super().repr_instance(value, level)
