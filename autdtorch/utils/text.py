"""Text of values: in tables of numbers, and as HTML for Jupyter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape


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
