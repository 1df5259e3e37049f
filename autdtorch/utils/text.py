"""Text of values: in messages, in tables of numbers, and as HTML for Jupyter."""

from __future__ import annotations

import contextlib
import math
import reprlib
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np
import torch

from autdtorch.utils.array_types import is_dense

SHOWN_ENTRIES = 9
"""Most entries of an array that messages show."""

_SHOWN_CHARACTERS = 120
_SHOWN_BITS = 128  # of an integer; Python refuses to write out very large ones


def decimals_of(numbers: Iterable[float], digits: int = 3) -> int:
    """Return the decimals that give the largest of the finite numbers some digits; 0 if all are 0."""
    largest = max((abs(number) for number in numbers if math.isfinite(number)), default=0.0)
    return max(0, digits - 1 - math.floor(math.log10(largest))) if largest else 0


def in_digits(number: float, digits: int) -> str:
    """Return a finite number with some digits, without an exponent."""
    return f"{number:.{decimals_of([number], digits)}f}"


def in_percent(share: float) -> str:
    """Return a share > 0 in percent, rounded down, so that 100.0 is all of it."""
    tenths = math.floor(1000 * share + 1e-9)  # 0.9 is 900 of them, not 899 and a rounding error
    return f"{tenths / 10:.1f}" if tenths >= 10 else f"{100 * share:.2g}"


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


def shown(value: object) -> str:
    """Return the text of a value for a message, however large or deep the value is."""
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
    """The text of a value, cut where it gets long."""

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
