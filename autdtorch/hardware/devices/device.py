"""A device that a link can drive: phase levels, frames, the USB chips it hangs on, and emulated firmware."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

import torch

from autdtorch.hardware.transport.serial_chips import Adapter
from autdtorch.scene.drive import drive_tensor, validate_drive
from autdtorch.scene.phase_levels import PhaseLevels
from autdtorch.utils.validation import ArrayLike, integer_at_least, invalid

_BITS = 10  # of a byte on a serial line: start, 8, stop


class Firmware(Protocol):
    """The emulated firmware of a device, from its sources; `baud` [bits/s] of its line, None for a FIFO."""

    baud: ClassVar[int | None]

    def receive(self, data: bytes) -> None:
        """Take bytes, in pieces of any length."""

    def drive(self) -> torch.Tensor:
        """Return the drive (N,), complex128, that the transducers emit now."""


@dataclass(frozen=True)
class Device(ABC):
    """The properties of a device that a link needs; a subclass adds its frames and its firmware.

    Attributes:
        name: of the device.
        board: number of transducers of one board.
        phase_levels: phases and amplitudes that it can emit.
        columns: names of its integer levels, as files of drives have them.
        adapters: USB chips that it may hang on, for pyusb; the first is the usual one.
        baud: rate of its serial line [bits/s]; None without one.
        boot_time: time that it needs after its serial port was opened by name [s].
        most_boards: largest number of boards; None for any number.
        boards: number of boards.
        serials: serial number of each USB chip; None takes any. Several chips share a frame evenly.
    """

    name: str
    board: int
    phase_levels: PhaseLevels
    columns: tuple[str, ...]
    adapters: tuple[Adapter, ...] = ()
    baud: int | None = None
    boot_time: float = 0.0
    most_boards: int | None = 1
    boards: int = 1
    serials: tuple[str | None, ...] = (None,)

    @abstractmethod
    def pack(self, *levels: torch.Tensor) -> bytes:
        """Return the frame for levels (N,), one tensor for each of `columns`."""

    @abstractmethod
    def firmware(self, transducers: int) -> Firmware:
        """Return the emulated firmware behind one chip, with so many `transducers`."""

    @property
    def transducers(self) -> int:
        """Number N of transducers."""
        return self.board * self.boards

    def with_boards(self, boards: int) -> Self:
        """Return the device with a number of `boards`; `ValueError` if out of range."""
        boards = integer_at_least("boards", boards, 1)
        if self.most_boards is not None and boards > self.most_boards:
            raise invalid("boards", boards, f"must be 1 to {self.most_boards} for {self.name}")
        return replace(self, boards=boards)

    def levels(self, drive: ArrayLike) -> tuple[torch.Tensor, ...]:
        """Return the levels nearest to a drive (..., M), |q| <= 1: int64 (..., M) for each of `columns`.

        `ValueError` for not finite complex numbers, no axis, or an amplitude above 1.
        """
        tensor = drive if isinstance(drive, torch.Tensor) else drive_tensor(drive)
        checked = validate_drive(tensor, tensor.shape[-1] if tensor.ndim else 0)
        return self.phase_levels.nearest(checked.detach())

    def drive(self, *levels: ArrayLike) -> torch.Tensor:
        """Return the drive (..., M), complex128, that the device emits for levels as of `levels`.

        `ValueError` for another number of levels, other shapes, or not integers of their range.
        """
        most = self.phase_levels.phases - 1, self.phase_levels.amplitudes or 0
        return self.phase_levels.drive(*self._checked(levels, most))

    def quantised(self, drive: ArrayLike) -> torch.Tensor:
        """Return the drive (..., M) that the device emits for another: the nearest on its levels."""
        return self.drive(*self.levels(drive))

    def frame(self, drive: ArrayLike) -> bytes:
        """Return the bytes for a drive (N,) on the nearest levels; zeros switch all outputs off.

        `ValueError` for another shape, not finite complex numbers, or an amplitude above 1.
        """
        levels = self.levels(drive)
        if levels[0].shape != (self.transducers,):
            raise ValueError(f"drive: shape {tuple(levels[0].shape)}; must be ({self.transducers},)")
        return self.pack(*levels)

    def wire_time(self, frame: bytes) -> float:
        """Return the time [s] that a frame takes on the serial line; 0 without one."""
        return 0.0 if self.baud is None else _BITS * len(frame) / self.baud

    def _checked(self, levels: tuple[ArrayLike, ...], most: tuple[int, ...]) -> tuple[torch.Tensor, ...]:
        """Return the `levels` as int64 of one shape, each from 0 to its `most`."""
        tensors = [torch.as_tensor(level, device="cpu") for level in levels]
        for name, tensor, largest in zip(self.columns, tensors, most, strict=True):
            integer = not (tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool)
            if not integer or (tensor.numel() and (tensor.min() < 0 or tensor.max() > largest)):
                raise invalid(f"{self.name} {name}", tensor, f"must be integers from 0 to {largest}")
            if tensor.shape != tensors[0].shape:
                shapes = tuple(tensor.shape), tuple(tensors[0].shape)
                raise ValueError(f"{self.name} {name}: shape {shapes[0]}; must be {shapes[1]}")
        return tuple(tensor.long() for tensor in tensors)
