"""Text of values: in errors, in tables of numbers, and as HTML for Jupyter."""

from __future__ import annotations

import contextlib
import math
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from html import escape
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


def decimals_of(numbers: Iterable[float], digits: int = 3) -> int:
    """Return the decimals that give the largest of the finite numbers some digits; 0 if all are 0."""
    largest = max((abs(number) for number in numbers if math.isfinite(number)), default=0.0)
    return max(0, digits - 1 - math.floor(math.log10(largest))) if largest else 0


def in_digits(number: float, digits: int) -> str:
    """Return a finite number with some digits, without an exponent."""
    return f"{number:.{decimals_of([number], digits)}f}"


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a count with its noun, such as "1 run" or "3 runs"; irregular nouns need a `plural`."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def html_facts(title: str, facts: Sequence[tuple[str, str]]) -> str:
    """Return a table of names and values with a title."""
    rows = "".join(
        f'<tr><th scope="row" style="text-align: left">{escape(name)}</th>'
        f'<td style="text-align: left">{escape(value)}</td></tr>'
        for name, value in facts
    )
    return f"<table>{_caption(title)}{rows}</table>"


def html_table(title: str, rows: Sequence[Sequence[str]]) -> str:
    """Return a table with a title; the first row is the header."""
    head, *body = rows
    lines = [_row('th scope="col"', head), *(_row("td", row) for row in body)]
    return f"<table>{_caption(title)}{''.join(lines)}</table>"


def _caption(title: str) -> str:
    return f'<caption style="text-align: left; font-weight: bold">{escape(title)}</caption>'


def _row(tag: str, cells: Sequence[str]) -> str:
    end = tag.partition(" ")[0]
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{end}>" for cell in cells) + "</tr>"
