"""OpenMPD: 16 x 16 transducers a board, pitch 10.5 mm, 128 phases, 64 amplitudes; a FIFO on USB.

Each board has a file (.pat), as in AcousTools, with the places and the calibration of its transducers: a
name, the number M of transducers and the number of phase levels, a line each. M positions `(x, y, z)` [m],
M pins, M phase offsets [degrees] and M gains follow, each in any number of lines.
"""

from __future__ import annotations

import cmath
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch

from autdtorch.hardware.devices.device import Device, Firmware
from autdtorch.hardware.transport.serial_chips import FT232H
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.boards import OPENMPD_SOURCE_STRENGTH, TRANSDUCER_RADIUS
from autdtorch.scene.drive import PhaseLevels, validate_drive
from autdtorch.scene.geometry import in_plane
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import path_of
from autdtorch.utils.validation import ArrayLike, complex_tensor, invalid, members, real_tensor

_BOARD = 256
_LEVELS = 128  # phase levels of a board
_FIRST = 0x80  # on the first byte of a message; on later bytes it sets lamp and rate


class _Item(NamedTuple):
    path: str | os.PathLike[str]
    line: int
    text: str

    def real(self, field: str) -> float:
        try:
            number = float(self.text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise self.wrong(field, "must be a finite number")
        return number

    def integer(self, field: str) -> int:
        try:
            return int(self.text)
        except ValueError as error:
            raise self.wrong(field, "must be an integer") from error

    def wrong(self, field: str, accepted: str) -> ValueError:
        return ValueError(f"{self.path}, line {self.line}: {field} {self.text!r}; {accepted}")


@dataclass(frozen=True, eq=False)
class OpenMPDBoard:
    """One board as its file describes it; M transducers in the order of the file.

    Attributes:
        name: first line of the file; drivers take it as the serial number of the USB chip.
        positions: (M, 3) [m], float64, in the axes of the board, which emits along z.
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

        `ValueError` with file, line and field if it describes no board, `FileNotFoundError` if there is none.
        """
        try:
            lines = path_of("path", path).read_text(encoding="utf-8-sig").splitlines()
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: {error}; must be a text file in UTF-8") from error
        head = [_Item(path, number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]
        if len(head) < 4:
            accepted = "must hold name, counts, positions, pins, offsets, gains"
            raise ValueError(f"{path}: {len(head)} lines; {accepted}")
        count = head[1].integer("number of transducers")
        if count < 1:
            raise head[1].wrong("number of transducers", "must be >= 1")
        if head[2].integer("number of phase levels") != _LEVELS:
            raise head[2].wrong("number of phase levels", f"must be {_LEVELS}")
        positions: list[list[float]] = []
        numbers: list[_Item] = []
        for item in head[3:]:
            for inside in re.findall(r"\(([^()]*)\)", item.text):
                place = [item._replace(text=part) for part in inside.split(",")]
                if len(place) != 3:
                    raise item._replace(text=inside).wrong("position", "must be (x, y, z)")
                positions.append([part.real("position") for part in place])
            outside = re.sub(r"\([^()]*\)", "", item.text)
            numbers += [item._replace(text=part) for part in re.split(r"[,\s]+", outside) if part]
        if len(positions) != count:
            raise ValueError(f"{path}: {len(positions)} positions (x, y, z); must be {count} as in line 2")
        if len(numbers) != 3 * count:
            accepted = f"must be {count} pins, {count} phase offsets and {count} gains"
            raise ValueError(f"{path}: {len(numbers)} numbers after the positions; {accepted}")
        pins: list[int] = []
        for item in numbers[:count]:
            pin = item.integer("pin")
            if pin in pins or not 0 <= pin < count:
                raise item.wrong("pin", f"must be one of 0 to {count - 1}, each once")
            pins.append(pin)
        offsets = [item.real("phase offset") for item in numbers[count : 2 * count]]
        gains: list[float] = []
        for item in numbers[2 * count :]:
            gains.append(item.real("gain"))
            if not 0 <= gains[-1] <= 1:
                raise item.wrong("gain", "must be in [0, 1]")
        places, degrees, factors = (real_tensor("board", part) for part in (positions, offsets, gains))
        return cls(head[0].text, places, tuple(pins), torch.deg2rad(degrees), factors)

    def array(
        self,
        center: ArrayLike = (0.0, 0.0, 0.0),
        normal: ArrayLike = (0.0, 0.0, 1.0),
        angle: float = 0.0,
        source_strength: float = OPENMPD_SOURCE_STRENGTH,
        radius: float | None = TRANSDUCER_RADIUS,
    ) -> TransducerArray:
        """Return the board in space; by default in its axes of the file.

        Args:
            center: place of the origin of its axes (3,) [m].
            normal: direction of emission (3,), its z.
            angle: of its x from u towards v [rad], (u, v) being `plane_basis(normal)`.
            source_strength: [Pa m], > 0; by default as AcousTools assumes.
            radius: of the discs [m]; None or 0 for point sources.

        `ValueError` if an argument is not finite, has the wrong shape or is out of range.
        """
        places = in_plane(self.positions, center, normal, angle)
        return TransducerArray(places, normal, source_strength, radius)

    def calibrated(self, drive: ArrayLike) -> torch.Tensor:
        """Return `drive` (..., M) with each transducer's gain, and less its phase offset."""
        wanted = validate_drive(drive, len(self.positions))
        return wanted * torch.polar(self.gains, -self.phase_offsets).to(wanted.device)

    def by_pin(self, drive: ArrayLike) -> torch.Tensor:
        """Return `drive` (..., M) in the order of the pins, in which the board takes it."""
        by_pin = torch.tensor(self.pins, dtype=torch.int64, device="cpu").argsort()
        return validate_drive(drive, len(self.positions))[..., by_pin]


@dataclass(frozen=True)
class _OpenMPD(Device):
    """A message to a board is 256 phases, the first of them with bit 7, then 256 duties, by pin.

    Without `files`, which describe the boards, transducers are in the order of the pins.
    """

    keys = ("boards",)
    files: tuple[OpenMPDBoard, ...] = ()

    def configured(self, section: Mapping[str, Any]) -> Device:
        paths = section.get("boards")
        if paths is None:
            return self
        if not isinstance(paths, list) or not paths:
            raise invalid("hardware.boards", paths, "must be a list of the boards' .pat files")
        for path in map(str, paths):
            if not Path(path).is_file():
                raise invalid("hardware.boards", path, "no such file; must be the .pat files of the boards")
        return openmpd_boards([OpenMPDBoard.load(str(path)) for path in paths])

    @property
    def settings(self) -> dict[str, Any]:
        names = [f"{file.name} {digest_of(file)[:16]}" for file in self.files]
        return {"boards": names} if names else {}

    def as_built(
        self, transfer_matrix: torch.Tensor, transducers: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        if not self.files:
            return transfer_matrix, transducers
        corrections = self._corrections()[transducers]
        pins = [_BOARD * number + pin for number, file in enumerate(self.files) for pin in file.pins]
        wired = torch.tensor(pins, dtype=torch.int64, device="cpu")[transducers]
        return torch.where(corrections == 0, 0, transfer_matrix / corrections), wired

    def levels(self, drive: ArrayLike) -> tuple[torch.Tensor, ...]:
        if self.files:
            parts = zip(self.files, torch.split(complex_tensor("drive", drive), _BOARD, -1), strict=True)
            drive = torch.cat([file.by_pin(file.calibrated(part)) for file, part in parts], dim=-1)
        return super().levels(drive)

    def drive(self, *levels: ArrayLike) -> torch.Tensor:
        sent = super().drive(*levels)
        if not self.files:
            return sent
        parts = zip(self.files, torch.split(sent, _BOARD, -1), strict=True)
        by_file = torch.cat([part[..., list(file.pins)] for file, part in parts], dim=-1)
        # Rounding may take it above 1.
        return torch.where(by_file == 0, by_file, by_file / self._corrections())

    def pack(self, *levels: torch.Tensor) -> bytes:
        messages = torch.cat([level.reshape(-1, _BOARD) for level in levels], dim=1).to(torch.uint8)
        messages[:, 0] |= _FIRST
        return messages.numpy().tobytes()

    def firmware(self, transducers: int) -> Firmware:
        return _OpenMPDFirmware()

    def _corrections(self) -> torch.Tensor:
        """Return the factors (N,) by which the files correct the drives of all transducers."""
        full = torch.ones(_BOARD, **COMPLEX)
        return torch.cat([file.calibrated(full) for file in self.files])


class _OpenMPDFirmware:
    """A board that emits pulses, which begin at a phase and last for a duty, both in 1/128 of a period.

    Bit 7 begins a message where one is due; bits 7 of later bytes, which set lamp and rate, are ignored.
    """

    baud: ClassVar[int | None] = None

    _BEGINNING, _VALUES = re.compile(rb"[\x80-\xff]"), bytes(byte & 127 for byte in range(256))

    def __init__(self) -> None:
        self._message = bytearray()
        self._playing = bytes(512)

    def receive(self, data: bytes) -> None:
        while data:
            if not self._message:
                beginning = self._BEGINNING.search(data)
                data = b"" if beginning is None else data[beginning.start() :]
            missing = 512 - len(self._message)
            self._message += data[:missing]
            data = data[missing:]
            if len(self._message) == 512:
                self._playing = bytes(self._message).translate(self._VALUES)
                self._message.clear()

    def drive(self) -> torch.Tensor:
        """Return the drive (256,): the fundamental of the pulses; 1 for phase 0 and duty 64."""
        pulses = zip(self._playing[:256], self._playing[256:], strict=True)
        played = [
            cmath.rect(math.sin(math.pi * duty / 128), 2 * math.pi * (phase + (duty - 64) / 2) / 128)
            for phase, duty in pulses
        ]
        return torch.tensor(played, **COMPLEX)


#: One board, by pin. OpenMPD's solver (`discretise`) has these levels too, but truncates instead of rounding.
OPENMPD = _OpenMPD(
    name="OpenMPD",
    board=_BOARD,
    phase_levels=PhaseLevels(128, 64, pulses=True),
    columns=("phase", "duty"),
    adapters=(FT232H,),
    most_rate=10_000.0,  # 40 kHz by the divider that its firmware starts with (CommandReader.vhd)
)


def openmpd_boards(boards: Sequence[OpenMPDBoard]) -> Device:
    """Return `boards` of OpenMPD as their files describe them: in the files' order, calibrated, by pin.

    A board has 256 transducers, and its name is the serial number of its chip. Boards change to a new drive
    one after the other, as their messages arrive.

    `ValueError` for no board, one of another number of transducers, or two of the same name.
    """
    boards = members("boards", boards, OpenMPDBoard)
    names = tuple(board.name for board in boards)
    if not boards or len(set(names)) < len(names):
        raise invalid("boards", names, "must be one or more, of different names")
    for board in boards:
        if len(board.pins) != _BOARD:
            raise ValueError(f"boards: {board.name} has {len(board.pins)} transducers; must be {_BOARD}")
    return replace(OPENMPD, boards=len(boards), serials=names, files=boards)
