"""Values on the command line of a hardware trial, and what is accepted."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


def number(accepted: str, fits: Callable[[float], bool], kind: type = float) -> Callable[[str], float]:
    """A type of options: a number that fits."""

    def parse(text: str) -> float:
        try:
            value: float = kind(text)
        except ValueError:
            value = math.nan
        if not fits(value):
            raise argparse.ArgumentTypeError(f"{text!r}; must be {accepted}")
        return value

    return parse


ABOVE_ZERO = number("a number > 0", lambda value: 0 < value < math.inf)
SHARE = number("a number > 0 and <= 1", lambda value: 0 < value <= 1)
DECIBELS = number("a finite number", math.isfinite)
COUNT = number("an integer >= 1", lambda value: value >= 1, int)
SEED = number("an integer >= 0", lambda value: value >= 0, int)
NOT_NEGATIVE = number("a number >= 0", lambda value: 0 <= value < math.inf)

_MOST = 100_000  # transducers; a slip of the finger must not fill the memory


def indices(text: str) -> list[int]:
    """Numbers of transducers: `3,7-9` is 3, 7, 8, 9."""
    try:
        parts = [part.partition("-") for part in text.split(",")]
        ranges = [range(int(low), int(high or low) + 1) for low, _, high in parts]
    except ValueError:
        ranges = []
    if not ranges or not all(ranges) or sum(map(len, ranges)) > _MOST:
        raise argparse.ArgumentTypeError(
            f"{text!r}; must be at most {_MOST} numbers, and ranges that go up, as 3,7-9"
        )
    return [one for some in ranges for one in some]


def chip(text: str) -> tuple[int, int]:
    """IdVendor and idProduct of `2a8d:1770`."""
    try:
        vendor, product = (int(part, 16) for part in text.split(":"))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}; must be VID:PID, as 2a8d:1770") from error
    if not (0 <= vendor < 2**16 and 0 <= product < 2**16):
        raise argparse.ArgumentTypeError(f"{text!r}; must be VID:PID with four digits each, as 2a8d:1770")
    return vendor, product


def network(text: str) -> str | int:
    """Name of an interface, or the port of `server:PORT`."""
    kind, separator, port = text.partition(":")
    if (kind, separator) != ("server", ":"):
        return text
    if not (port.isdecimal() and 0 < int(port) < 2**16):
        raise argparse.ArgumentTypeError(f"{text!r}; must be server:PORT with a port from 1 to 65535")
    return int(port)
