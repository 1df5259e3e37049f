"""A device that a link can drive: phase levels, frames, keys of its config, port and emulated firmware."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import torch

from autdtorch.hardware.transport.port import HeldSequence, Port, SerialPort, SharedPort, closed_on_error
from autdtorch.hardware.transport.serial_chips import Adapter
from autdtorch.hardware.transport.usb import find_device
from autdtorch.scene.drive import PhaseLevels, drive_tensor, validate_drive
from autdtorch.utils.array_types import COMPLEX, Bytes
from autdtorch.utils.validation import ArrayLike, integer_at_least, invalid

_BITS = 10  # of a byte on a serial line: start, 8, stop


class Firmware(Protocol):
    """Emulated firmware, written from a device's sources.

    `baud` [bits/s] is the rate of its serial line; None for a FIFO.
    """

    baud: ClassVar[int | None]

    def receive(self, data: bytes) -> None:
        """Take bytes, in pieces of any length."""

    def drive(self) -> torch.Tensor:
        """Return the drive (N,), complex128, that the transducers emit now."""


class EmulatedBoards(Protocol):
    """Emulated boards of a device, as the device sees them; `EmulatedBench` describes them.

    `bus` is a backend of pyusb, and `firmware` belongs to the first board.
    """

    bus: Any
    firmware: Firmware

    def receive(self, frame: bytes) -> None:
        """Take a frame without USB."""

    def port(self) -> Port:
        """Return a port without USB."""


@dataclass(frozen=True)
class Device(ABC):
    """The properties of a device that a link needs; a subclass adds its frames and its firmware.

    In the section `hardware` of a config, `keys` describe the device, for `configured`, and `port_keys` say
    where a real one is, for `open_port`.

    Attributes:
        name: of the device.
        board: number of transducers of one board.
        phase_levels: phases and amplitudes that it can emit.
        columns: names of its integer levels, as files of drives have them.
        adapters: USB chips that it may be connected by, for pyusb; the first is the usual one.
        baud: rate of its serial line [bits/s]; None without one.
        most_rate: frames per second that it takes without a serial line [Hz].
        boot_time: time that it needs after its serial port was opened by name [s].
        most_boards: largest number of boards; None for any number.
        boards: number of boards.
        serials: serial number of each USB chip; None takes any. Several chips share a frame evenly.
    """

    keys: ClassVar[tuple[str, ...]] = ()
    port_keys: ClassVar[tuple[str, ...]] = ("serial", "port")

    name: str
    board: int
    phase_levels: PhaseLevels
    columns: tuple[str, ...]
    adapters: tuple[Adapter, ...] = ()
    baud: int | None = None
    most_rate: float = math.inf
    boot_time: float = 0.0
    most_boards: int | None = 1
    boards: int = 1
    serials: tuple[str | None, ...] = (None,)

    @abstractmethod
    def pack(self, *levels: torch.Tensor) -> bytes:
        """Return the frame for levels (N,), or frames for levels (T, N), one after the other.

        There is a tensor of levels for each of `columns`.
        """

    @abstractmethod
    def firmware(self, transducers: int) -> Firmware:
        """Return the emulated firmware behind one chip, with so many `transducers`."""

    def configured(self, section: Mapping[str, Any]) -> Device:
        """Return the device that a section `hardware` describes; by default with its number of `boards`."""
        boards = section.get("boards")
        return self if boards is None else self.with_boards(integer_at_least("hardware.boards", boards, 1))

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that identify a trial, beside the device's name and transducers; values of JSON."""
        return {}

    def as_built(
        self, transfer_matrix: torch.Tensor, transducers: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return matrix (P, M) [Pa] and `transducers` (M,) for an emulated bench.

        A device whose files correct deviations of its transducers has these deviations there.
        """
        return transfer_matrix, transducers

    def open_port(self, place: Mapping[str, Any], backend: Any = None) -> Port:
        """Return the port of the real device at a `place`, by `port_keys`; `backend` is pyusb's.

        `LinkError` if none or several are there; `ValueError` if the device cannot be at such a place.
        """
        serial, name = place.get("serial"), place.get("port")
        if name is not None:
            if self.baud is None:
                raise invalid("port", name, f"must be None, as {self.name} has no serial line")
            port = SerialPort(name, self.baud)
            with closed_on_error(port.close):
                time.sleep(self.boot_time)
            return port
        if serial is not None and len(self.serials) > 1:
            raise invalid("serial", serial, f"must be None, as {self.name} has {len(self.serials)} boards")
        openers = {(vendor, product): open_chip for vendor, product, open_chip in self.adapters}
        ports: list[Port] = []
        with closed_on_error(SharedPort(ports).close):
            for number in self.serials if serial is None else (serial,):
                chip = find_device(openers, number, backend)
                ports.append(openers[chip.idVendor, chip.idProduct](chip))
        return ports[0] if len(ports) == 1 else SharedPort(ports)

    def emulated_port(self, bench: EmulatedBoards) -> Port:
        """Return the port of the emulated device on a bench: its chip's, or one without USB."""
        return self.open_port({}, bench.bus) if self.adapters else bench.port()

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
        return self.phase_levels.nearest(checked.detach().cpu())

    def drive(self, *levels: ArrayLike) -> torch.Tensor:
        """Return the drive (..., M), complex128, that the device emits for integer levels, by column.

        `ValueError` for another number of levels, other shapes, or not integers of their range.
        """
        most = self.phase_levels.phases - 1, self.phase_levels.amplitudes or 0
        return self.phase_levels.drive(*self._checked(levels, most))

    def quantised(self, drive: ArrayLike) -> torch.Tensor:
        """Return the nearest drive (..., M) that the device can emit."""
        return self.drive(*self.levels(drive))

    def frame(self, drive: ArrayLike) -> bytes:
        """Return the bytes for a drive (N,) on the nearest levels; zeros switch all outputs off.

        `ValueError` for another shape, not finite complex numbers, or an amplitude above 1.
        """
        levels = self.levels(drive)
        if levels[0].shape != (self.transducers,):
            raise ValueError(f"drive: shape {tuple(levels[0].shape)}; must be ({self.transducers},)")
        return self.pack(*levels)

    def frames(self, drives: torch.Tensor) -> Bytes:
        """Return the bytes (T, B) of frames for drives (T, N) on the nearest levels; errors as `frame`."""
        levels = self.levels(drives)
        if levels[0].shape != (len(drives), self.transducers):
            raise ValueError(f"drives: shape {tuple(drives.shape)}; must be (T, {self.transducers})")
        return np.frombuffer(self.pack(*levels), np.uint8).reshape(len(drives), -1)

    def wire_time(self, frame: bytes) -> float:
        """Return the time [s] that a frame takes on the serial line; 0 without one."""
        return 0.0 if self.baud is None else _BITS * len(frame) / self.baud

    @property
    def highest_rate(self) -> float:
        """Frames per second that it can play [Hz]."""
        if self.baud is None:
            return self.most_rate
        return 1 / self.wire_time(self.frame(torch.zeros(self.transducers, **COMPLEX)))

    def require_rate(self, rate: float) -> None:
        """Refuse frames per second [Hz] that it cannot play."""
        if rate > self.highest_rate:
            raise invalid("rate", rate, f"must be at most {self.highest_rate:.4g} for {self.name}", "Hz")

    def held(self, drives: torch.Tensor, rate: float, loop: bool) -> HeldSequence | None:
        """Return the sequence of drives (T, N) for the device's memory; None if frames are sent one by one.

        `ValueError` if it does not fit in the memory.
        """
        return None

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
