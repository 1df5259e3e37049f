"""Numbers in texts and tables: their digits, and counts with their noun."""

from __future__ import annotations

import math
from collections.abc import Iterable


def decimals_of(numbers: Iterable[float], digits: int = 3) -> int:
    """Return the decimals that give the largest of the finite numbers some digits; 0 if all are 0."""
    largest = max((abs(number) for number in numbers if math.isfinite(number)), default=0.0)
    return max(0, digits - 1 - math.floor(math.log10(largest))) if largest else 0


def in_digits(number: float, digits: int) -> str:
    """Return a finite number with some digits, without an exponent."""
    return f"{number:.{decimals_of([number], digits)}f}"


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a count with its noun, such as "1 run" or "3 runs"; `plural` is that of an irregular noun."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"
