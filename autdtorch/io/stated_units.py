"""Units that headers and comments of text files state: as symbols, such as mm, or as words."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence

#: Factors to SI of the accepted units, by SI unit.
FACTORS: dict[str, dict[str, float]] = {
    "": {"": 1.0},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
    "Pa m": {"Pa m": 1.0},
}
# Patterns of what people write. The case of a lone m counts: M is a number of transducers.
_SPELLED = {
    "": "",
    "Pa m": r"Pa\s?m",
    "mm": "mm|millimet(?:er|re)s?",
    "cm": "cm|centimet(?:er|re)s?",
    "m": "(?-i:m)|met(?:er|re)s?",
    "rad": "rad|radians?",
    "deg": "deg|degrees?|°",
}
_OTHERS = {  # units that are refused where they are stated
    "m": "inch(?:es)?|[µμu]m|micromet(?:er|re)s?|microns?|nm|dm|km|ft|feet|mils?|wavelengths?|lambda|λ",
    "rad": "pi|π|turns|cycles|revolutions|gon|grad|gradians?|levels?",
}
_WORD = "|".join([*filter(None, _SPELLED.values()), *_OTHERS.values()])
# Neither a part of a word nor of another unit, such as m/s or mm^2, nor the size of steps
_UNIT = rf"(?<![\w'])(?P<unit>{_WORD})(?![\w/^*·])(?!\s+(?:steps?|grid)\b)"
_ANYWHERE = re.compile(_UNIT, re.IGNORECASE)
_STATED = re.compile(
    rf"\b(?:in(?:\s+(?:units|multiples)\s+of)?|units?(?:\s+of)?)\s*[:=]?\s*{_UNIT}"
    rf"|[\[(]\s*{_UNIT.replace('?P<unit>', '?P<bracketed>')}\s*[\])]",
    re.IGNORECASE,
)
_LABEL = re.compile(r"\bunits?\s*[:=]\s*(.*)", re.IGNORECASE | re.DOTALL)


def unit_called(text: str, kind: str) -> str | None:
    """Return the unit of an SI unit's kind that a text names, None if it names none."""
    return next((unit for unit in FACTORS[kind] if re.fullmatch(_SPELLED[unit], text, re.IGNORECASE)), None)


def stated_unit(comments: Sequence[str], kind: str) -> str | None:
    """Return the unit that comments state, as in "units: mm", "in millimetres", "[mm]" or "mm" alone.

    Raises:
        ValueError: they state several units of this kind, or another one than the accepted.
    """
    stated = {unit: None for comment in comments for unit in _of_kind(_stated(comment), kind)}
    if not stated:
        return None
    if len(stated) > 1 or not stated.keys() <= FACTORS[kind].keys():
        accepted = f"must be one of {', '.join(FACTORS[kind])}"
        raise ValueError(f"the comments state the unit {' and '.join(map(repr, stated))}; {accepted}")
    return next(iter(stated))


def mentioned_units(comments: Sequence[str], kind: str) -> set[str]:
    """Return the accepted units that comments name at all; a lone m may be anything else."""
    words = [match["unit"] for comment in comments for match in _ANYWHERE.finditer(comment)]
    return FACTORS[kind].keys() & set(_of_kind([word for word in words if word != "m"], kind))


def _stated(comment: str) -> Iterator[str]:
    """Yield the words that a comment states as units, known or not."""
    if re.fullmatch(_UNIT, comment, re.IGNORECASE):
        yield comment
    for match in _STATED.finditer(comment):
        yield match["unit"] or match["bracketed"]
    if label := _LABEL.search(comment):
        yield from [match["unit"] for match in _ANYWHERE.finditer(label[1])] or label[1].split()[:1]


def _of_kind(words: Iterable[str], kind: str) -> Iterator[str]:
    """Yield units of a kind for words, and words of no other kind as they are."""
    for word in words:
        if (unit := unit_called(word, kind)) is not None:
            yield unit
        elif not any(_is_of(word, other) for other in FACTORS if other != kind):
            yield word


def _is_of(word: str, kind: str) -> bool:
    others = _OTHERS.get(kind)
    return unit_called(word, kind) is not None or (
        others is not None and re.fullmatch(others, word, re.IGNORECASE) is not None
    )
