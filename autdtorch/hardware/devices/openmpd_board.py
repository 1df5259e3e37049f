"""The board file (.pat) of OpenMPD and AcousTools: where one board's transducers are, and their calibration.

The file holds a name, the number M of transducers and that of phase levels, a line each; then M positions
`(x, y, z)` [m], M pins, M phase offsets [degrees] and M gains, each in any number of lines.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch

from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.device_layouts import OPENMPD_SOURCE_STRENGTH, TRANSDUCER_RADIUS
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.geometry import in_plane
from autdtorch.utils.validation import ArrayLike, path_of

#: Phase levels that the boards have, and `hardware.levels` makes.
_LEVELS = 128


class _Item(NamedTuple):
    line: int
    text: str


@dataclass(frozen=True, eq=False)
class OpenMPDBoard:
    """One board as its file describes it; M transducers in the order of the file.

    Attributes:
        name: first line of the file; drivers take it as the serial number of the USB chip.
        positions: (M, 3) [m], float64, in the board's own axes; it emits along z.
        pins: place of each transducer in a message to the board, a permutation of 0 to M - 1.
        phase_offsets: (M,) [rad], float64, by which each transducer is ahead in arg q.
            That the file counts them in degrees is inferred from its values.
        gains: (M,), float64, 0 to 1, by which amplitudes are multiplied.
    """

    name: str
    positions: torch.Tensor
    pins: tuple[int, ...]
    phase_offsets: torch.Tensor
    gains: torch.Tensor

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> OpenMPDBoard:
        """Read a .pat file.

        Args:
            path: of the file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is none of a board. The message names the file, the line and what is wrong.
        """
        try:
            lines = path_of("path", path).read_text(encoding="utf-8-sig").splitlines()
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: {error}; must be a text file in UTF-8") from error
        head = [_Item(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]
        if len(head) < 4:
            raise ValueError(
                f"{path}: {len(head)} lines; must hold name, counts, positions, pins, offsets, gains"
            )
        name, count, levels = head[:3]
        transducers = _integer(path, "number of transducers", count)
        if transducers < 1:
            raise _wrong(path, "number of transducers", count, "must be >= 1")
        if _integer(path, "number of phase levels", levels) != _LEVELS:
            raise _wrong(path, "number of phase levels", levels, f"must be {_LEVELS}")
        body = head[3:]
        positions = [_position(path, item) for item in _tuples(body)]
        if len(positions) != transducers:
            raise ValueError(
                f"{path}: {len(positions)} positions (x, y, z); must be {transducers} as in line 2"
            )
        numbers = list(_numbers(body))
        if len(numbers) != 3 * transducers:
            raise ValueError(
                f"{path}: {len(numbers)} numbers after the positions; must be {transducers} pins, "
                f"{transducers} phase offsets and {transducers} gains"
            )
        pins, offsets, gains = (numbers[part * transducers :][:transducers] for part in range(3))
        return cls(
            name.text,
            torch.tensor(positions, dtype=torch.float64, device="cpu"),
            _pins(path, pins),
            torch.deg2rad(_floats(path, "phase offset", offsets)),
            torch.tensor([_gain(path, item) for item in gains], dtype=torch.float64, device="cpu"),
        )

    def array(
        self,
        center: ArrayLike = (0.0, 0.0, 0.0),
        normal: ArrayLike = (0.0, 0.0, 1.0),
        angle: float = 0.0,
        source_strength: float = OPENMPD_SOURCE_STRENGTH,
        radius: float | None = TRANSDUCER_RADIUS,
    ) -> TransducerArray:
        """The board in space; by default in its own axes.

        Args:
            center: where the origin of its axes goes (3,) [m].
            normal: direction of emission (3,), its z.
            angle: of its x from u towards v [rad], (u, v) being `plane_basis(normal)`.
            source_strength: [Pa m], > 0; by default as AcousTools assumes.
            radius: of the discs [m]; None or 0 for point sources.

        Raises:
            ValueError: an argument is not finite, has the wrong shape or is out of range.
        """
        return TransducerArray(
            in_plane(self.positions, center, normal, angle), normal, source_strength, radius
        )

    def calibrated(self, drive: ArrayLike) -> torch.Tensor:
        """What to send so that the transducers play `drive` (..., M): each with its gain, less its offset.

        Raises:
            ValueError: not a drive of M transducers.
        """
        wanted = validate_drive(drive, len(self.positions))
        return wanted * torch.polar(self.gains, -self.phase_offsets).to(wanted.device)

    def by_pin(self, drive: ArrayLike) -> torch.Tensor:
        """The `drive` (..., M) in the order of the pins, in which the board takes it.

        Raises:
            ValueError: not a drive of M transducers.
        """
        return validate_drive(drive, len(self.positions))[
            ..., torch.tensor(self.pins, dtype=torch.int64, device="cpu").argsort()
        ]


def _tuples(items: list[_Item]) -> Iterator[_Item]:
    for line, text in items:
        for inside in re.findall(r"\(([^()]*)\)", text):
            yield _Item(line, inside)


def _numbers(items: list[_Item]) -> Iterator[_Item]:
    """What stands outside of the parentheses."""
    for line, text in items:
        for part in re.split(r"[,\s]+", re.sub(r"\([^()]*\)", "", text)):
            if part:
                yield _Item(line, part)


def _position(path: str | os.PathLike[str], item: _Item) -> list[float]:
    parts = item.text.split(",")
    if len(parts) != 3:
        raise _wrong(path, "position", item, "must be (x, y, z)")
    return [_float(path, "position", _Item(item.line, part)) for part in parts]


def _pins(path: str | os.PathLike[str], items: list[_Item]) -> tuple[int, ...]:
    pins: list[int] = []
    seen: set[int] = set()
    for item in items:
        pin = _integer(path, "pin", item)
        if pin in seen or not 0 <= pin < len(items):
            raise _wrong(path, "pin", item, f"must be one of 0 to {len(items) - 1}, each once")
        seen.add(pin)
        pins.append(pin)
    return tuple(pins)


def _floats(path: str | os.PathLike[str], field: str, items: list[_Item]) -> torch.Tensor:
    return torch.tensor([_float(path, field, item) for item in items], dtype=torch.float64, device="cpu")


def _gain(path: str | os.PathLike[str], item: _Item) -> float:
    gain = _float(path, "gain", item)
    if not 0 <= gain <= 1:
        raise _wrong(path, "gain", item, "must be in [0, 1]")
    return gain


def _float(path: str | os.PathLike[str], field: str, item: _Item) -> float:
    try:
        number = float(item.text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise _wrong(path, field, item, "must be a finite number")
    return number


def _integer(path: str | os.PathLike[str], field: str, item: _Item) -> int:
    try:
        return int(item.text)
    except ValueError as error:
        raise _wrong(path, field, item, "must be an integer") from error


def _wrong(path: str | os.PathLike[str], field: str, item: _Item, accepted: str) -> ValueError:
    return ValueError(f"{path}, line {item.line}: {field} {item.text!r}; {accepted}")
