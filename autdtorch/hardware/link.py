"""A device that plays drives, and is silent when it is let go."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import torch

from autdtorch.drive import validate_drive
from autdtorch.hardware.devices import Device
from autdtorch.hardware.usb import Port, find_device
from autdtorch.validation import integer_at_least, invalid


class Link:
    """A device at the end of a port: `play` a drive, and it plays until the next, or until `off`.

    Use it as a context manager. The outputs are switched off when it is opened, as some devices start with
    all transducers on, and however the block ends.

    Attributes:
        device: what hangs on the port.
        transducers: which of the device's transducers play the drive (M,), int64.
    """

    def __init__(self, device: Device, port: Port, transducers: Sequence[int] | None = None) -> None:
        """Switch the outputs off.

        Args:
            device: what hangs on the port.
            port: takes its bytes.
            transducers: for each transducer of the scene, which of the device's it is; the others stay off.
                By default the scene has all, in the order of the device.

        Raises:
            ValueError: `transducers` that the device does not have, or one twice.
            LinkError: the device does not take the bytes.
        """
        self.device = device
        self._port = port
        self.off()
        self.transducers = wiring(transducers, device.transducers)

    def play(self, drive: torch.Tensor) -> None:
        """Play a drive (M,), |q| <= 1, on the nearest levels of the device, until the next.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
            LinkError: the device does not take the bytes.
        """
        drive = validate_drive(drive, len(self.transducers))
        everyone = torch.zeros(self.device.transducers, dtype=torch.complex128)
        everyone[self.transducers] = drive
        self._port.write(self.device.frame(everyone))

    def off(self) -> None:
        """Switch all outputs of the device off.

        Raises:
            LinkError: the device does not take the bytes.
        """
        silence = self.device.frame(torch.zeros(self.device.transducers, dtype=torch.complex128))
        # Twice: the first may be taken for the rest of a frame that broke off. It also fills both buffers.
        self._port.write(silence)
        self._port.write(silence)

    def close(self) -> None:
        """Switch all outputs off and let go of the device.

        Raises:
            LinkError: the device does not take the bytes; it is let go all the same.
        """
        try:
            self.off()
        finally:
            self._port.close()

    def __enter__(self) -> Self:
        """The link."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Switch all outputs off and let go of the device."""
        self.close()


def open_link(
    device: Device, transducers: Sequence[int] | None = None, serial: str | None = None, backend: Any = None
) -> Link:
    """Find a device on USB and switch its outputs off.

    Args:
        device: which.
        transducers: for each transducer of the scene, which of the device's it is; by default all in order.
        serial: number of the USB chip, where several such devices are plugged in.
        backend: of pyusb; by default libusb. An emulated bench has its own.

    Raises:
        LinkError: none or several such devices, or it does not take the bytes.
        ImportError: pyusb or libusb-package is missing.
        ValueError: `transducers` that the device does not have, or one twice.
    """
    port = device.open_port(find_device(device.vendor, device.product, serial, backend))
    try:
        return Link(device, port, transducers)
    except BaseException:
        port.close()
        raise


def wiring(transducers: Sequence[int] | None, count: int) -> torch.Tensor:
    """Which of a device's `count` transducers play a scene's (M,), int64.

    Raises:
        ValueError: transducers that the device does not have, or one twice.
    """
    if transducers is None:
        return torch.arange(count)
    chosen = [integer_at_least(f"transducers[{place}]", one, 0) for place, one in enumerate(transducers)]
    if not chosen or len(set(chosen)) < len(chosen) or max(chosen) >= count:
        raise invalid("transducers", chosen, f"must be indices from 0 to {count - 1}, each once")
    return torch.tensor(chosen)
