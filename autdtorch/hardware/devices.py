"""The devices that a link can drive: their USB chip, and how a drive becomes bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from autdtorch.hardware.frames import (
    BOARD,
    levels_of_openmpd_frame,
    levels_of_sonicsurface_frame,
    openmpd_frame,
    sonicsurface_frame,
)
from autdtorch.hardware.levels import (
    OPENMPD_PHASES,
    SONICSURFACE_PHASES,
    openmpd_drive,
    openmpd_levels,
    sonicsurface_drive,
    sonicsurface_levels,
)
from autdtorch.hardware.usb import FtdiFifo, FtdiUart, Port

SONICSURFACE_BAUD = 230_400


@dataclass(frozen=True)
class Device:
    """What a link has to know of a device.

    Attributes:
        name: of the device.
        vendor: idVendor of its USB chip.
        product: idProduct of its USB chip.
        transducers: their number N.
        open_port: opens a `usb.core.Device`.
        frame: bytes for a drive (N,), |q| <= 1, on the nearest levels. All zeros switch the outputs off.
        played: the drive (N,) that a frame has the device play.
        quantised: the device as settings of `Quantised`.
    """

    name: str
    vendor: int
    product: int
    transducers: int
    open_port: Callable[[Any], Port]
    frame: Callable[[torch.Tensor], bytes]
    played: Callable[[bytes], torch.Tensor]
    quantised: Mapping[str, Any]


def _sonicsurface(drive: torch.Tensor) -> bytes:
    return sonicsurface_frame(sonicsurface_levels(drive))


def _sonicsurface_played(frame: bytes) -> torch.Tensor:
    return sonicsurface_drive(levels_of_sonicsurface_frame(frame))


def _openmpd(drive: torch.Tensor) -> bytes:
    return openmpd_frame(openmpd_levels(drive))


def _openmpd_played(frame: bytes) -> torch.Tensor:
    return openmpd_drive(levels_of_openmpd_frame(frame))


#: 16 x 16, pitch 10.5 mm; 32 phases, no amplitude. An FT232R is the adapter on most cables.
SONICSURFACE = Device(
    name="SonicSurface",
    vendor=0x0403,
    product=0x6001,
    transducers=BOARD,
    open_port=partial(FtdiUart, baud=SONICSURFACE_BAUD),
    frame=_sonicsurface,
    played=_sonicsurface_played,
    quantised={"levels": SONICSURFACE_PHASES, "on_off": True},
)

#: 16 x 16, pitch 10.5 mm; 128 phases, 64 amplitudes. Transducers are in the order of the board's pins.
OPENMPD = Device(
    name="OpenMPD",
    vendor=0x0403,
    product=0x6014,
    transducers=BOARD,
    open_port=FtdiFifo,
    frame=_openmpd,
    played=_openmpd_played,
    quantised={"levels": OPENMPD_PHASES},
)
