"""Columns of tables of readings: their titles, or the call, say what they hold."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from autdtorch.hardware.devices import DEVICES
from autdtorch.io.readings_units import (
    UNIT_WORDS,
    UNSTATED,
    Unit,
    angle_unit,
    length_unit,
    peak_to_peak_as_word,
    phase_unit,
    pressure_unit,
)
from autdtorch.utils.text import counted
from autdtorch.utils.validation import integer_at_least, invalid, require_known, within

QUANTITIES = ("x", "y", "z", "phase", "amplitude", "pressure", "pressure phase")
"""QUANTITIES: what a column may hold."""

SKIP = "skip"
"""SKIP: columns that the call counts, but that are not read."""

_TITLE = re.compile(r"(.*?)\s*[\[(](.*)[\])]\s*(.*)", re.DOTALL)
_WORD = re.compile(r"[^\W\d_]+|\d+")

# Words of names, in lower case
_OF_PRESSURE = {"pressure", "pressures", "p", "mic", "microphone", "spl"}
_OF_PHASE = {"phase", "phases", "phi", "φ", "arg", "level", "levels"}
_LEVELS = {"intensity", "duty"}  # of amplitudes, as devices have them
_OF_AMPLITUDE = {"amplitude", "amplitudes", "amp", "a", *_LEVELS}
_OF_DRIVE = {"q", "drive", "transducer", "channel", "ch"}
_BESIDE_PRESSURE = {*_OF_PHASE, "sound", "magnitude", "magnitudes", "amplitude", "abs"}

_EXAMPLE = "'phase 0 [deg]', 'amplitude 0', 'x [mm]' or 'pressure 0 [Pa rms]'"
_NAMES = "columns={'phase': 'ch*', 'pressure': ['mic1', 'mic2']}"
_COUNTS = "columns={'phase': 16, 'pressure': 4}"


@dataclass(frozen=True)
class ReadingColumn:
    """A column: index and title, its quantity of `QUANTITIES`, its number, and its stated unit."""

    index: int
    title: str
    what: str
    number: int | None = None
    unit: Unit = UNSTATED


Columns: TypeAlias = dict[str, list[ReadingColumn]]
"""Columns of each quantity, in order."""

Named: TypeAlias = Mapping[str, int | str | Sequence[str]]
"""Columns as a call names them: by quantity their number, or their titles, where * stands for anything."""


def checked_names(columns: object) -> Named | None:
    """Return the argument `columns` after checking it."""
    if columns is None:
        return None
    accepted = f"must be numbers of columns or their titles by quantity, as {_COUNTS} or {_NAMES}"
    if not isinstance(columns, Mapping) or not columns:
        raise invalid("columns", columns, accepted)
    require_known("columns", columns, (*QUANTITIES, SKIP), "quantity")
    titled = [isinstance(names, str | list | tuple) for names in columns.values()]
    if any(titled) != all(titled):
        raise invalid("columns", columns, accepted)
    for what, names in columns.items():
        if not isinstance(names, str | list | tuple):
            integer_at_least(f"columns[{what!r}]", names, 1)
        elif not names or not all(isinstance(name, str) for name in names):
            raise invalid(f"columns[{what!r}]", names, "must be titles of columns")
    return columns


def counted_quantities(named: Named | None) -> list[str]:
    """Return the quantity of each column that the call counts; empty where it counts none."""
    counts = {what: count for what, count in (named or {}).items() if isinstance(count, int)}
    return [what for what, count in counts.items() for _ in range(count)]


def columns_of(place: str, header: list[str] | None, width: int, named: Named | None) -> Columns:
    """Return the columns of a table at a `place` with a `header`, if any, and so many columns."""
    if named is None:
        columns = list(_of_header(place, header, width))
    elif kinds := counted_quantities(named):
        columns = list(_counted(place, header, width, kinds))
    else:
        columns = list(_titled(place, header, named))
    by_quantity = {what: [column for column in columns if column.what == what] for what in QUANTITIES}
    if not by_quantity["pressure"]:
        raise ValueError(f"{place}: no column of pressures; must have one, such as 'pressure 0 [Pa rms]'")
    for what, other in (("pressure phase", "pressure"), ("amplitude", "phase")):
        counts = len(by_quantity[what]), len(by_quantity[other])
        if counts[0] not in (0, counts[1]):
            numbers = f"{counts[0]} of {what} and {counts[1]} of {other}"
            raise ValueError(f"{place}: columns, {numbers}; must be as many, or none of {what}")
    return by_quantity


def _of_header(place: str, header: list[str] | None, width: int) -> Iterator[ReadingColumn]:
    """Yield the columns of a table whose titles say what they hold, those of a quantity by their numbers."""
    if header is None:
        raise ValueError(
            f"{place}: {counted(width, 'column')} without names; must be counted, as in {_COUNTS}"
        )
    columns: Columns = {}
    for index, title in enumerate(header):
        with within(place):
            column = _column(index, title)
        if column is None:
            accepted = f"must be as {_EXAMPLE}, or the call must name all that is to be read, as in {_NAMES}"
            raise ValueError(f"{place}: unknown column {title!r}; {accepted}")
        columns.setdefault(column.what, []).append(column)
    for what, members in columns.items():
        numbers = sorted(-1 if column.number is None else column.number for column in members)
        if len(numbers) > 1 and numbers not in (list(range(len(numbers))), list(range(1, len(numbers) + 1))):
            titles = [column.title for column in members]
            twice = next((f"{title!r} twice" for title in titles if titles.count(title) > 1), None)
            gaps = [str(n) for n in range(min(1, max(numbers[0], 0)), numbers[-1]) if n not in numbers]
            among = f"{titles[0]!r} to {titles[-1]!r}"
            which = twice or (f"{among} without {', '.join(gaps[:3])}" if gaps else among)
            raise ValueError(
                f"{place}: columns of {what}, {which}; must have the numbers from 0 or 1, each once"
            )
        yield from sorted(members, key=lambda column: column.number or 0)


def _counted(place: str, header: list[str] | None, width: int, kinds: list[str]) -> Iterator[ReadingColumn]:
    """Yield the columns of a table whose quantities the call counts, in their order."""
    if len(kinds) != width:
        raise ValueError(f"columns: {len(kinds)} in all; must be {width}, as {place} has")
    for index, what in enumerate(kinds):
        if what == SKIP:
            continue
        with within(place):
            column = _column(index, header[index], what) if header else None
        yield column or ReadingColumn(index, str(index + 1), what)


def _titled(place: str, header: list[str] | None, named: Named) -> Iterator[ReadingColumn]:
    """Yield the columns of a table whose titles the call names, each once.

    Columns of a pattern follow each other by their numbers, if these differ: ch2 comes before ch10.
    """
    titles, taken = header or [], set[int]()
    for what, names in named.items():
        for name in [names] if isinstance(names, str) else names if not isinstance(names, int) else []:
            matching = [index for index, title in enumerate(titles) if title == name]
            matching = matching or [i for i, title in enumerate(titles) if fnmatch.fnmatchcase(title, name)]
            if not matching:
                shown = (
                    ", ".join(titles[:9]) + (", ..." if len(titles) > 9 else "") if titles else "no titles"
                )
                raise ValueError(
                    f"columns[{what!r}]: {name!r}; must be a title in {place}, which has {shown}"
                )
            if twice := taken & {*matching}:
                accepted = "must be of one quantity, and named once"
                raise ValueError(f"columns: {titles[min(twice)]!r} in {place} twice; {accepted}")
            taken |= {*matching}
            with within(place):
                named_columns = (_column(index, titles[index], what) for index in matching)
                yield from _by_number([column for column in named_columns if column is not None])


def _by_number(columns: list[ReadingColumn]) -> list[ReadingColumn]:
    """Return columns in the order of their numbers, or as they are where some have none or one number."""
    numbers = [column.number for column in columns if column.number is not None]
    if len({*numbers}) < len(columns):
        return columns
    return sorted(columns, key=lambda column: column.number or 0)


def _column(index: int, title: str, what: str | None = None) -> ReadingColumn | None:
    """Return the column that a title names, None if it names none; the call may know what it holds.

    Titles are such as `phase 3 [deg]`, `autd3 phase 3`, `arg q 3 [rad]`, `amplitude_3`, `p3_rms (kPa)`,
    `SPL 1`, `mic 2 phase [deg]` and `x [mm]`.
    """
    match = _TITLE.fullmatch(title.strip())
    name, stated = (f"{match[1]} {match[3]}", match[2]) if match else (title, "")
    device = next((known for known in DEVICES if name.casefold().startswith(f"{known} ")), "")
    words = _WORD.findall(peak_to_peak_as_word(name[len(device) :]))
    numbers = [int(word) for word in words if word.isdecimal()]
    texts = [word for word in words if not word.isdecimal()]
    names = {word.casefold() for word in texts if word.casefold() not in UNIT_WORDS}
    units = [word for word in texts if word.casefold() in UNIT_WORDS]
    quantity = what or _quantity(names)
    if quantity is None or (what is None and len(numbers) > 1):
        return None
    unit = _unit(f"column {title!r}", quantity, names, " ".join([*units, stated]).strip(), device)
    return ReadingColumn(index, title, quantity, numbers[0] if numbers else None, unit)


def _quantity(names: set[str]) -> str | None:
    axes = names & {"x", "y", "z"}
    if len(axes) == 1 and names <= {*axes, "point", "position", "pos"}:
        return axes.pop()
    if names & _OF_PRESSURE and names <= _OF_PRESSURE | _BESIDE_PRESSURE:
        return "pressure phase" if names & (_OF_PHASE - {"level", "levels"}) else "pressure"
    if names & _OF_PHASE and names <= _OF_PHASE | _OF_DRIVE:
        return "phase"
    return "amplitude" if names & _OF_AMPLITUDE and names <= _OF_AMPLITUDE | _OF_DRIVE else None


def _unit(field: str, what: str, names: set[str], text: str, device: str) -> Unit:
    """Return the unit that a title states, by words of its name, in brackets, or by a device."""
    if what == "pressure":
        text += " dB" if "spl" in names and "db" not in text.casefold() else ""
        text += " peak" if "amplitude" in names else ""
        return pressure_unit(field, text) if text.strip() else UNSTATED
    if what == "pressure phase":
        return angle_unit(field, text) if text else UNSTATED
    if what == "phase":
        text = device or text or ("level" if names & {"level", "levels"} else "")
        unit = phase_unit(field, text) if text else UNSTATED
        return unit._replace(kind="arg") if "arg" in names else unit
    if what == "amplitude":
        if text not in ("", "%"):
            raise invalid(field, text, "must be without unit, or in %")
        return Unit(device or ("level" if names & _LEVELS else text or None))
    return length_unit(field, text) if text else UNSTATED
