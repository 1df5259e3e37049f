"""The devices that a link can drive: their USB chip, and how a drive becomes bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from autdtorch.hardware.frames import BOARD, openmpd_frame, sonicsurface_frame
from autdtorch.hardware.levels import openmpd_levels, sonicsurface_levels
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
    """

    name: str
    vendor: int
    product: int
    transducers: int
    open_port: Callable[[Any], Port]
    frame: Callable[[torch.Tensor], bytes]


def _sonicsurface(drive: torch.Tensor) -> bytes:
    return sonicsurface_frame(sonicsurface_levels(drive))


def _openmpd(drive: torch.Tensor) -> bytes:
    return openmpd_frame(openmpd_levels(drive))


#: 16 x 16, pitch 10.5 mm; 32 phases, no amplitude. An FT232R is the adapter on most cables.
SONICSURFACE = Device(
    "SonicSurface", 0x0403, 0x6001, BOARD, partial(FtdiUart, baud=SONICSURFACE_BAUD), _sonicsurface
)

#: 16 x 16, pitch 10.5 mm; 128 phases, 64 amplitudes. Transducers are in the order of the board's pins.
OPENMPD = Device("OpenMPD", 0x0403, 0x6014, BOARD, FtdiFifo, _openmpd)
