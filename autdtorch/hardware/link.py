"""A device that plays drives, and is silent when it is let go."""

from __future__ import annotations

import atexit
import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

import torch

from autdtorch.hardware.devices import Device
from autdtorch.hardware.transport.usb import LinkError, Port, closed_on_error, find_device
from autdtorch.hardware.wiring import Wiring
from autdtorch.utils.validation import invalid, not_negative, require_callable, require_kind

#: Default settle time [s]. Sound goes 1.7 m in it; a T4010A1 rings up in some 30 periods, 0.75 ms, as the
#: emulator of AUTD3's kit models it.
SETTLE = 5e-3


class OffError(LinkError):
    """A device was not switched off: its outputs may still be on."""


class Link:
    """A device at the end of a port: `play` a drive, and it plays until the next, or until `off`.

    Use it as a context manager. The outputs are switched off when it is opened, as some devices start with
    all transducers on, and however the block ends; at the latest when Python exits. Threads may share it.

    Attributes:
        device: what hangs on the port.
        transducers: which of the device's transducers play the drive (M,), int64.
        wiring: of the two.
        settle: how long a drive plays before `play` returns [s].
    """

    def __init__(
        self,
        device: Device,
        port: Port,
        transducers: Sequence[int] | torch.Tensor | None = None,
        settle: float = SETTLE,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Switch the outputs off.

        Args:
            device: what hangs on the port.
            port: takes its bytes.
            transducers: for each transducer of the scene, which of the device's it is (M,); others stay off.
                By default the scene has all, in the order of the device.
            settle: how long `play` waits, after the frame has gone over the wire, for the sound to stand at
                the control points [s].
            sleep: waits for a number of seconds.

        Raises:
            ValueError: no device, port or function; `transducers` that the device does not have, or one
                twice; or a negative `settle`.
            OffError: the device does not take the bytes.
        """
        require_kind("device", device, Device)
        require_kind("port", port, Port)
        require_callable("sleep", sleep)
        self.device = device
        self._port = port
        self._sleep = sleep
        self._lock = threading.RLock()
        self._open = True
        self.off()
        self.wiring = Wiring(device, transducers)
        self.transducers = self.wiring.transducers
        self.settle = not_negative("settle", settle, "s")
        atexit.register(self.close)

    def play(self, drive: torch.Tensor) -> None:
        """Play a drive (M,), |q| <= 1, on the nearest levels of the device, until the next.

        It returns when the sound stands: a write ends before its bytes have gone over a serial line.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
            LinkError: the device does not take the bytes, or was let go.
        """
        self.begin(drive)
        self.wait_for_sound()

    def begin(self, drive: torch.Tensor) -> None:
        """Play a drive as `play` does, but return when its frame is on the device.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
            LinkError: the device does not take the bytes, or was let go.
        """
        frame = self.wiring.frame(drive)
        with self._lock:
            if not self._open:
                raise LinkError(f"{self.device.name} was let go; open it anew")
            self._send(frame)

    def wait_for_sound(self) -> None:
        """Wait for the settle time; other threads may switch the outputs off meanwhile."""
        self._sleep(self.settle)

    def off(self) -> None:
        """Switch all outputs of the device off; once it was let go they are.

        The frame is sent twice: a device that was left in mid-frame takes the first for the rest of that.

        Raises:
            OffError: the device does not take the bytes, nor once it was recovered.
        """
        with self._lock:
            if not self._open:  # pyusb would open it once more
                return
            try:
                self._send_silence()
            except BaseException as error:  # a fault of the bus that may pass, or a signal
                self._recover()
                if not isinstance(error, LinkError):
                    raise

    def _recover(self) -> None:
        try:
            with contextlib.suppress(LinkError):  # of several boards one may be gone, and the others play on
                self._port.recover()
            self._send_silence()
        except LinkError as error:
            raise OffError(f"{error}; the outputs may still be on: switch the device's power off") from error

    def _send_silence(self) -> None:
        silence = self.device.frame(
            torch.zeros(self.device.transducers, dtype=torch.complex128, device="cpu")
        )
        # Twice also because a device with two buffers may be left with the last drive in the other.
        for _ in range(2):
            self._send(silence)
        self._port.flush()

    def close(self) -> None:
        """Switch all outputs off and let go of the device.

        Raises:
            OffError: the device does not take the bytes; it is let go all the same.
            LinkError: the port cannot be given back to the system.
        """
        with self._lock:
            if not self._open:
                return
            try:
                self.off()
            except LinkError:
                with contextlib.suppress(LinkError):  # the first error says more
                    self._let_go()
                raise
            except BaseException:  # a signal, which may come before anything is sent, or amid a recovery
                self.close()
                raise
            self._let_go()

    def _let_go(self) -> None:
        self._open = False
        atexit.unregister(self.close)
        self._port.close()

    def _send(self, frame: bytes) -> None:
        self._port.write(frame)
        self._sleep(self.device.wire_time(frame))

    def __enter__(self) -> Self:
        """The link."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Switch all outputs off and let go of the device."""
        self.close()


def open_link(
    device: Device,
    transducers: Sequence[int] | torch.Tensor | None = None,
    serial: str | None = None,
    backend: Any = None,
    settle: float = SETTLE,
) -> Link:
    """Find a device on USB and switch its outputs off.

    Args:
        device: which.
        transducers: for each transducer of the scene, which of the device's it is (M,); by default all in
            order.
        serial: number of the USB chip, where several such devices are plugged in.
        backend: of pyusb; by default libusb. An emulated bench has its own, on which waiting takes no time.
        settle: how long a drive plays before its pressure is read [s]; the time that its frame is on the wire
            comes on top.

    Raises:
        LinkError: none or several such devices, or it does not take the bytes.
        ImportError: pyusb or libusb-package is missing.
        ValueError: no `Device`; `transducers` that it does not have, or one twice; a negative `settle`; or a
            `serial` for a device of several boards.
    """
    require_kind("device", device, Device)
    if serial is not None and len(device.serials) > 1:
        raise invalid("serial", serial, f"must be None, as {device.name} has {len(device.serials)} boards")
    openers = {(vendor, product): open_port for vendor, product, open_port in device.adapters}
    ports: list[Port] = []
    with closed_on_error(SharedPort(ports).close):
        for own in device.serials if serial is None else (serial,):
            found = find_device(openers, own, backend)
            ports.append(openers[found.idVendor, found.idProduct](found))
        port = ports[0] if len(ports) == 1 else SharedPort(ports)
        return Link(device, port, transducers, settle, getattr(backend, "sleep", time.sleep))


class SharedPort:
    """The ports of several boards, which share what is written evenly."""

    def __init__(self, ports: Sequence[Port]) -> None:
        """Take the `ports`, in the order of the boards."""
        self._ports = ports

    def write(self, data: bytes) -> None:
        """Send each board its part of `data`; if one does not take it, the others are sent theirs.

        Raises:
            LinkError: a board did not take its part.
        """
        part = len(data) // len(self._ports)
        parts = [data[start : start + part] for start in range(0, len(data), part)]
        _each(lambda port, own: port.write(own), self._ports, parts)

    def flush(self) -> None:
        """Wait until all has left the chips of all boards, where they tell.

        Raises:
            LinkError: it does not leave one.
        """
        _each(lambda port, _: port.flush(), self._ports, self._ports)

    def recover(self) -> None:
        """Take all boards up again.

        Raises:
            LinkError: a board is gone.
        """
        _each(lambda port, _: port.recover(), self._ports, self._ports)

    def close(self) -> None:
        """Let go of all boards."""
        _each(lambda port, _: port.close(), self._ports, self._ports)


def _each(do: Callable[[Port, Any], None], ports: Sequence[Port], things: Sequence[Any]) -> None:
    """Do it to every port, then raise the first error."""
    errors = []
    for port, thing in zip(ports, things, strict=True):
        try:
            do(port, thing)
        except LinkError as error:
            errors.append(error)
    if errors:
        raise errors[0]
