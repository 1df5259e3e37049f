"""The board file (.pat) of OpenMPD and AcousTools: places and calibration of one board's transducers.

The file holds a name, the number M of transducers and the number of phase levels, a line each. M positions
`(x, y, z)` [m], M pins, M phase offsets [degrees] and M gains follow, each in any number of lines.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from typing import NamedTuple

import torch

from autdtorch.scene.arrays import OPENMPD_SOURCE_STRENGTH, TRANSDUCER_RADIUS, TransducerArray
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.geometry import in_plane
from autdtorch.utils.validation import ArrayLike, path_of, real_tensor

_LEVELS = 128  # phase levels of the boards


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
        pins: dict[int, None] = {}
        for item in numbers[:count]:
            pin = item.integer("pin")
            if pin in pins or not 0 <= pin < count:
                raise item.wrong("pin", f"must be one of 0 to {count - 1}, each once")
            pins[pin] = None
        offsets = [item.real("phase offset") for item in numbers[count : 2 * count]]
        gains = [item.real("gain") for item in numbers[2 * count :]]
        for item, gain in zip(numbers[2 * count :], gains, strict=True):
            if not 0 <= gain <= 1:
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
        """Return the board in space; by default in its own axes.

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
