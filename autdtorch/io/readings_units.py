"""Units of readings: each is stated, by a file or by the call, and numbers that belie it are refused."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

import numpy as np
import torch

from autdtorch.hardware.devices import DEVICES
from autdtorch.scene.drive import PhaseLevels
from autdtorch.utils.array_types import Array
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import invalid

_REFERENCE = 20e-6  # RMS pressure of 0 dB [Pa], the convention of sound in air
_PASCALS = {"Pa": 1.0, "kPa": 1e3, "mPa": 1e-3}
_PEAKS = {"peak": 1.0, "rms": math.sqrt(2), "peak-to-peak": 0.5}  # peak amplitude of a sine, in these
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_MOST_LEVELS = 2**16

# Spellings. The case counts in mPa, which is not MPa.
_PRESSURE_WORDS = {"pa": "Pa", "kpa": "kPa", "db": "dB", "spl": "dB", "dbspl": "dB"}
_KIND_WORDS = {"peak": "peak", "pk": "peak", "amplitude": "peak", "rms": "rms", "pp": "peak-to-peak"}
_ANGLE_WORDS = dict.fromkeys(("rad", "radian", "radians"), "rad")
_ANGLE_WORDS |= dict.fromkeys(("deg", "degree", "degrees", "°"), "deg")
_ANGLE_WORDS |= dict.fromkeys(("level", "levels"), "level")
_PEAK_TO_PEAK = re.compile(r"(?<![^\W_])(?:peak[\s_-]*to[\s_-]*peak|pk[-_]?pk|p-p)(?![^\W_])", re.IGNORECASE)
_RE_20 = re.compile(r"(?:\bre[lf]?\.?)?\s*:?\s*20\s*[uµμ]Pa\b", re.IGNORECASE)  # two letters mu

UNIT_WORDS = {*_PRESSURE_WORDS, *_KIND_WORDS, *_ANGLE_WORDS, *_LENGTHS, "mpa"}
UNIT_WORDS -= {"amplitude", "spl", "level", "levels"}
"""UNIT_WORDS: words of a column's name that are units, in lower case."""

_ATMOSPHERE = 101_325.0  # [Pa], which no peak amplitude of sound exceeds
_MANY = 10  # numbers from which their values tell a unit
_DECIBELS = 80.0, 180.0  # range and least ratio of smallest and largest, in which pressures look like levels
_ALIKE = 0.5
_TURN = 2 * math.pi + 1e-6  # [rad], with room for rounding


class Unit(NamedTuple):
    """A unit as far as it is stated.

    `unit` is Pa, kPa, mPa or dB of pressures; rad, deg, "level", "levels of 32" or a device of phases; m, cm
    or mm; % or a device of amplitudes. `kind` is peak, rms or peak-to-peak of pressures, and "arg" of phases
    that are arg q.
    """

    unit: str | None = None
    kind: str | None = None

    def __str__(self) -> str:
        parts = self[::-1] if self.kind == "arg" and self.unit in ("rad", "deg") else self
        return " ".join(filter(None, parts))


UNSTATED = Unit()
"""UNSTATED: no unit."""


def pressure_unit(name: str, text: object) -> Unit:
    """Return the unit and kind that a text states, such as "kPa rms", "rms" or "dB re 20 uPa"."""
    accepted = (
        "must be Pa, kPa or mPa with peak, rms or peak-to-peak, as in 'Pa rms', or dB (re 20 uPa, RMS); "
        "divide volts by the sensor's V/Pa"
    )
    if not isinstance(text, str):
        raise invalid(name, text, accepted)
    words = re.split(r"[\s_,()]+", _RE_20.sub(" ", peak_to_peak_as_word(text)).strip())
    units = {unit for word in words if (unit := _pressure_word(word)) is not None}
    kinds = {_KIND_WORDS[word.casefold()] for word in words if word.casefold() in _KIND_WORDS}
    known = all(_pressure_word(word) or word.casefold() in _KIND_WORDS for word in words)
    if not known or len(units) > 1 or len(kinds) > 1:
        raise invalid(name, text, accepted)
    unit, kind = next(iter(units), None), next(iter(kinds), None)
    if unit == "dB" and kind not in (None, "rms"):
        raise invalid(name, text, "must be dB alone: its 20 uPa are an RMS pressure")
    return Unit(unit, "rms" if unit == "dB" else kind)


def peak_to_peak_as_word(text: str) -> str:
    """Return a text with "peak to peak" and the like as one word, pp."""
    return _PEAK_TO_PEAK.sub(" pp ", text)


def phase_unit(name: str, text: object) -> Unit:
    """Return the unit of phases that a text states, such as "deg", "arg rad", "levels of 32" or "autd3".

    A whole number is a number of levels. Levels are arg q, as in `PhaseLevels`.
    """
    accepted = "must be 'rad', 'deg' (of arg q: 'arg deg'), a number of levels as 32, or one of "
    accepted += ", ".join(DEVICES)
    if isinstance(text, int) and not isinstance(text, bool) and 2 <= text <= _MOST_LEVELS:
        return Unit(f"levels of {text}", "arg")
    if not isinstance(text, str):
        raise invalid(name, text, accepted)
    words = " ".join(text.casefold().split())
    word = words.removeprefix("arg ").removeprefix("q ")
    if word in DEVICES:
        return Unit(word, "arg")
    if (levels := re.fullmatch(r"levels of (\d{1,5})", word)) is not None:
        return phase_unit(name, int(levels[1]))
    if (unit := _ANGLE_WORDS.get(word)) is None:
        raise invalid(name, text, accepted)
    return Unit(unit, "arg" if unit == "level" or word != words else None)


def angle_unit(name: str, text: object) -> Unit:
    """Return the unit of a pressure's phase that a text states: rad or deg."""
    unit = _ANGLE_WORDS.get(text.strip().casefold()) if isinstance(text, str) else None
    if unit not in ("rad", "deg"):
        raise invalid(name, text, "must be 'rad' or 'deg'")
    return Unit(unit)


def length_unit(name: str, text: str) -> Unit:
    """Return the unit of a length that a text states."""
    if text not in _LENGTHS:
        raise invalid(name, text, f"must be {', '.join(_LENGTHS)}")
    return Unit(text)


def merged(field: str, said: Unit | None, stated: Unit, place: str) -> Unit:
    """Return the unit that the call said and a place stated together; refuse two that differ."""
    if said is None:
        return stated
    levels = stated.unit == "level" and said.unit not in (None, "rad", "deg", "level")
    unit = said.unit if levels else stated.unit or said.unit
    kind = stated.kind or said.kind
    if said.unit not in (None, unit) or said.kind not in (None, kind):
        raise invalid(field, str(said), f"must agree with {place}, which states {stated}")
    return Unit(unit, kind)


def peak_amplitudes(values: Array, unit: Unit, in_header: bool) -> Array:
    """Return the peak amplitudes [Pa] of numbers >= 0, or of levels, NaN at gaps.

    `in_header`: a title of the numbers states the unit, which is then not doubted.
    """
    if unit.unit is None or unit.kind is None:
        lacking = "unit (Pa, kPa, mPa or dB)" if unit.unit is None else "kind (peak, rms or peak-to-peak)"
        example = f"{unit.unit or 'Pa'} {unit.kind or 'rms'}"
        raise ValueError(
            f"no {lacking} of the pressures; must be stated, in titles as 'pressure 0 [{example}]', or in "
            f"the call as pressure={example!r}"
        )
    numbers = values[~np.isnan(values)]
    if unit.unit == "dB":
        peak = _PEAKS["rms"] * _REFERENCE * 10 ** (values / 20)
    else:
        peak = values * (_PASCALS[unit.unit] * _PEAKS[unit.kind])
        alike = len(numbers) >= _MANY and numbers.min() > max(_DECIBELS[0], _ALIKE * numbers.max())
        if alike and numbers.max() < _DECIBELS[1] and not in_header:
            raise ValueError(
                f"pressures from {numbers.min():g} to {numbers.max():g} look like dB; must be pressure='dB', "
                f"or have {unit.unit} in their titles, as 'pressure 0 [{unit.unit} {unit.kind}]'"
            )
    if len(numbers) and np.nanmedian(peak) > _ATMOSPHERE:
        raise ValueError(
            f"pressures from {numbers.min():g} to {numbers.max():g} {unit}, most above {_ATMOSPHERE:g} Pa, "
            "which no sound in air reaches; must be in the unit that is stated"
        )
    return peak


def in_metres(values: Array, unit: Unit) -> Array:
    """Return lengths in m."""
    if unit.unit is None:
        raise ValueError("no unit of x, y, z; must be stated in their titles, as in 'x [mm]'")
    return values * _LENGTHS[unit.unit]


def radians(values: Array, unit: Unit, what: str) -> Array:
    """Return phases [rad] of numbers in rad or deg, NaN at gaps; refuse or warn of what belies the unit."""
    if unit.unit not in ("rad", "deg"):
        keyword = "phases" if what == "phase" else "phase"
        levels = " or, of 32 levels, phases=32" if what == "phase" else ""
        raise ValueError(
            f"no {'number of levels' if unit.unit == 'level' else 'unit'} of the {what}s; must be stated, in "
            f"titles as '{what} 0 [deg]', or in the call as {keyword}='deg'{levels}"
        )
    numbers = values[~np.isnan(values)]
    if len(numbers) >= _MANY:
        span = f"{what}s from {numbers.min():g} to {numbers.max():g} {unit.unit}"
        if unit.unit == "rad" and np.abs(numbers).max() > _TURN and (numbers == numbers.round()).all():
            raise ValueError(f"{span}, all whole numbers; must be rad, and these are degrees or levels")
        if unit.unit == "rad" and (np.ptp(numbers) > 300 and np.abs(numbers).max() <= 360):
            warn_user(f"{span}; are these degrees?")
        if unit.unit == "deg" and 3 < np.ptp(numbers) <= _TURN and not (numbers == numbers.round()).all():
            warn_user(f"{span}; are these rad?")
    return values if unit.unit == "rad" else np.radians(values)


def range_of(what: str, unit: Unit) -> tuple[float, float, bool]:
    """Return the least and largest number that a quantity may have in a unit, and whether it is whole."""
    device = DEVICES.get(unit.unit or "")
    if what == "phase" and device is not None:
        # A device with one level for both has one more, which is off.
        return 0, device.phase_levels.phases - (len(device.columns) > 1), True
    if what == "phase" and (levels := _levels_of(unit)):
        return 0, levels - 1, True
    if what == "amplitude":
        if unit.unit == "level" or device is not None:
            return 0, math.inf if device is None else device.phase_levels.amplitudes or 1, True
        return 0, 100 if unit.unit == "%" else 1, False
    bounded = what == "pressure" and unit.unit != "dB"
    return (0 if bounded else -math.inf), math.inf, False


def drives_of(phases: Array, amplitudes: Array | None, unit: Unit, of_amplitudes: Unit) -> torch.Tensor:
    """Return the drives (R, M) of phases and amplitudes within the ranges of their units."""
    if unit.unit in DEVICES:
        device = DEVICES[unit.unit]
        stated = np.full_like(phases, device.phase_levels.amplitudes) if amplitudes is None else amplitudes
        if (amplitudes is not None) and (of_amplitudes.unit != unit.unit or len(device.columns) < 2):
            needed = f"levels of {unit.unit}, as in '{unit.unit} {device.columns[-1]} 0'"
            raise ValueError(f"amplitudes beside phase levels of {unit.unit}; must be {needed}")
        levels = [torch.from_numpy(values).long() for values in (phases, stated)]
        return device.drive(*levels[: len(device.columns)])
    if of_amplitudes.unit == "level" or of_amplitudes.unit in DEVICES:
        raise ValueError(
            f"amplitudes in levels beside phases in {unit}; must be beside phase levels of a device"
        )
    scale = 0.01 if of_amplitudes.unit == "%" else 1
    share = np.ones_like(phases) if amplitudes is None else amplitudes * scale
    if (count := _levels_of(unit)) is not None:
        return PhaseLevels(count).drive(torch.from_numpy(phases).long(), torch.from_numpy(share))
    argument = radians(phases, unit, "phase") * (1 if unit.kind == "arg" else -1)
    return torch.from_numpy(share * np.exp(1j * argument))


def _levels_of(unit: Unit) -> int | None:
    match = re.fullmatch(r"levels of (\d+)", unit.unit or "")
    return int(match[1]) if match else None


def _pressure_word(word: str) -> str | None:
    return "mPa" if word == "mPa" else _PRESSURE_WORDS.get(word.casefold())
