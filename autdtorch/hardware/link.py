"""A link to a device: it plays drives and sequences on the nearest levels, and is silent once closed."""

from __future__ import annotations

import atexit
import collections.abc
import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import torch

from autdtorch.hardware.devices import require_device
from autdtorch.hardware.devices.autd3 import AUTD3
from autdtorch.hardware.devices.device import Device
from autdtorch.hardware.streaming import (
    Playback,
    PreparedSequence,
    frames_within,
    outlast,
    require_sequence,
    stream,
)
from autdtorch.hardware.transport.port import HeldSequence, LinkError, MemoryPort, Port, closed_on_error
from autdtorch.scene.drive import AMPLITUDE_TOLERANCE, validate_drive, validate_single_drive
from autdtorch.scene.sequence import Sequence
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.validation import (
    indices,
    invalid,
    number_between,
    positive,
    require_callable,
    require_kind,
)

#: Default settle time [s]. Sound goes 1.7 m in it; a T4010A1 rings up in some 30 periods, 0.75 ms, as the
#: emulator of AUTD3's kit models it.
SETTLE = 5e-3
_LONGEST_SETTLE = 60.0  # [s]
_ATTEMPTS = 10  # to switch off, each after a signal
_FINEST = 2.0**-14  # resolution of the search; two levels of a device here are further apart

_Transducers: TypeAlias = collections.abc.Sequence[int] | torch.Tensor


class OffError(LinkError):
    """A device was not switched off: its outputs may still be on."""


class Wiring:
    """A device, and its transducer for each of a scene's (M,), int64; other transducers stay off."""

    def __init__(self, device: Device, transducers: _Transducers | None = None) -> None:
        """Wire a device; by default all its transducers in order."""
        require_device(device)
        self.device = device
        chosen = range(device.transducers) if transducers is None else transducers
        places = indices("transducers", chosen, device.transducers)
        self.transducers = torch.tensor(places, dtype=torch.int64, device="cpu")

    def frame(self, drive: torch.Tensor) -> bytes:
        """Return the bytes for a drive (M,), |q| <= 1, on the nearest levels."""
        return self.device.frame(self.of_device(validate_single_drive(drive, len(self.transducers))))

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest drive (M,) to a `drive` (M,)."""
        single = validate_single_drive(drive, len(self.transducers))
        return self.device.quantised(self.of_device(single))[self.transducers]

    def of_device(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the drive (..., N) of all the device's transducers for a checked `drive` (..., M)."""
        everyone = torch.zeros((*drive.shape[:-1], self.device.transducers), **COMPLEX)
        everyone[..., self.transducers] = drive.cpu()
        return everyone


class AmplitudeScale:
    """The scale between a trial's drives and the device's, whose amplitude `largest` is 1 in the trial.

    Transducers of a calibrated device differ in their levels. None is driven above the highest of its levels
    within the limit, so that rounding exceeds the limit nowhere.
    """

    def __init__(self, wiring: Wiring, amplitude: float) -> None:
        """Find the levels within a limit, above 0 up to 1; `ValueError` if that leaves only 0."""
        self._wiring = wiring
        limit = number_between("amplitude", positive("amplitude", amplitude), 0.0, 1.0)
        self._most = self._amplitudes(self._highest(limit))
        self.largest = float(self._most.max())
        if self.largest == 0:
            above = self._amplitudes((self._highest(0.0) + 2 * _FINEST).clamp(max=1))
            least = torch.where(above > 0, above, torch.inf).min()
            accepted = f"must be >= {least:.3g}, the lowest level of {wiring.device.name}"
            raise invalid("amplitude", limit, accepted)

    def asked(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the drive to ask of the device, in the device's scale, for a trial's `drive` (M,)."""
        return self.frames_asked(validate_single_drive(drive, len(self._most)).cpu())

    def frames_asked(self, drives: torch.Tensor) -> torch.Tensor:
        """Return the drives to ask of the device, in its scale, for a trial's checked `drives` (..., M)."""
        wanted = self.largest * drives
        return torch.polar(wanted.abs().minimum(self._most), wanted.angle())

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest drives to drives (..., M), both in the trial's scale."""
        drive = validate_drive(drive, len(self._most)).cpu()
        # One by one, as the link plays them: no rounding may depend on the rows beside.
        rows = [self._wiring.quantised(self.asked(row)) for row in drive.reshape(-1, drive.shape[-1])]
        return torch.stack(rows).reshape(drive.shape) / self.largest

    def _highest(self, limit: float) -> torch.Tensor:
        """Return the amplitude to ask of each transducer (M,) for the highest of its levels up to `limit`."""
        asked = torch.zeros(len(self._wiring.transducers), **REAL)
        step = 1.0
        while step >= _FINEST:
            more = (asked + step).clamp(max=1)
            asked = torch.where(self._amplitudes(more) <= limit + AMPLITUDE_TOLERANCE, more, asked)
            step /= 2
        return asked

    def _amplitudes(self, asked: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest amplitudes (M,) to others (M,)."""
        return self._wiring.quantised(asked.to(torch.complex128)).abs()


class Link(contextlib.AbstractContextManager["Link"]):
    """A device at the end of a port: `play` a drive, and it plays until the next, or until `off`.

    `play_sequence` plays a sequence to its end.

    Use it as a context manager. The outputs are switched off when it is opened, as some devices start with
    all transducers on, and however the block ends; at the latest when Python exits. Threads may share it.
    Methods raise `LinkError` if the device does not take the bytes; `off` and `close` then raise `OffError`.
    Attributes are `device`, `transducers` (M,), int64, and `settle` [s].
    """

    def __init__(
        self,
        device: Device,
        port: Port,
        transducers: _Transducers | None = None,
        settle: float = SETTLE,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Switch the outputs off; the port is closed if that fails, or with the link.

        Args:
            device: the device at the port.
            port: takes the bytes for the device.
            transducers: the device's transducer for each of the scene's (M,); others stay off. By default
                the scene has all, in the order of the device.
            settle: time that `play` waits, after the frame has been sent, for steady sound [s]; 0 to 60.
            sleep: waits for a number of seconds.

        Raises:
            ValueError: no device, port or function; `transducers` that the device does not have, or one
                twice; or `settle` out of range.
            OffError: the device does not take the bytes.
        """
        require_device(device)
        require_kind("port", port, Port)
        require_callable("sleep", sleep)
        self.device, self._port, self._sleep = device, port, sleep
        self._lock = threading.RLock()
        self._open = True
        self._turn: object | None = None  # of the sequence that plays or is prepared
        with closed_on_error(port.close):
            self.off()
            self.wiring = Wiring(device, transducers)
            self.transducers = self.wiring.transducers
            self.settle = number_between("settle", settle, 0.0, _LONGEST_SETTLE, "s")
        atexit.register(self.close)

    def play(self, drive: torch.Tensor) -> None:
        """Play a drive (M,) on the nearest levels, until the next; return when the sound is steady.

        `ValueError` for another shape, not finite complex numbers or an amplitude above 1; `LinkError` if the
        link is closed.
        """
        self.begin(drive)
        self.wait_for_sound()

    def begin(self, drive: torch.Tensor) -> None:
        """Play a drive (M,) as `play` does, but return when its frame is on the device."""
        frame = self.wiring.frame(drive)
        with self._lock:
            self._require_open()
            self._turn = None
            self._send(frame)

    def wait_for_sound(self) -> None:
        """Wait for the settle time; other threads may switch the outputs off meanwhile."""
        self._sleep(self.settle)

    def play_sequence(self, sequence: Sequence, seconds: float | None = None) -> Playback:
        """Play a sequence on the nearest levels and switch off; return its times when it is over.

        A device with a memory for sequences plays by its own clock; to others the frames are sent one by one,
        each when it is due. A loop without `seconds` plays until another thread calls `off` or plays
        something else.

        Args:
            sequence: frames of drives (T, M).
            seconds: time to play [s], less the rest of a frame; by default all frames once, or a loop
                without end.

        Raises:
            ValueError: no sequence, another number of transducers, a rate that the device does not have, more
                frames than fit in its memory, or `seconds` below one frame, or beyond the end of a sequence
                that does not loop.
            LinkError: the link is closed, the device does not take the bytes, or the computer is too slow.
        """
        with self.turn() as ended:
            return self.play_prepared(self.prepare_sequence(sequence, seconds), ended)

    @contextlib.contextmanager
    def turn(self) -> Iterator[Callable[[], bool]]:
        """End an earlier sequence, and have the outputs off at the end of the block.

        It gives a function that returns whether the turn has ended: by `off`, a drive, or another sequence.
        The outputs are left to these then.
        """
        with self._lock:
            self._require_open()
            self.end_sequence()
            turn = self._turn = object()
        try:
            yield lambda: self._turn is not turn
        finally:
            with self._lock:
                if self._turn is turn:
                    self.off()

    def prepare_sequence(self, sequence: Sequence, seconds: float | None = None) -> PreparedSequence:
        """Return a sequence as bytes of the device, which may take long; errors as of `play_sequence`.

        Args:
            sequence: frames of drives (T, M).
            seconds: time to play [s]; see `play_sequence`.
        """
        require_sequence(sequence, len(self.transducers))
        device, rate = self.device, sequence.rate
        device.require_rate(rate)
        count = frames_within(sequence, seconds)
        drives = self.wiring.of_device(sequence.drives)
        held = device.held(drives, rate, sequence.loop)
        if held is not None and isinstance(self._port, MemoryPort):
            return PreparedSequence(held, rate, count)
        frames = device.frames(drives).reshape(len(drives), len(device.serials), -1)
        return PreparedSequence(frames, rate, count)

    def play_prepared(self, prepared: PreparedSequence, ended: Callable[[], bool]) -> Playback:
        """Play a prepared sequence, or until its `turn` has ended; return its times."""
        content, rate, count = prepared.content, prepared.rate, prepared.count

        def send(chunk: bytes) -> bool:
            with self._lock:
                if ended():
                    return False
                self._port.write(chunk)
                return True

        if isinstance(content, HeldSequence):
            with self._lock:
                if isinstance(self._port, MemoryPort) and not ended():
                    self._port.hold(content)
            return outlast(rate, count, ended)
        return stream(send, content, rate, count, ended, self.device.wire_time(content[0].tobytes()))

    def end_sequence(self) -> None:
        """Switch the outputs off if a sequence plays or is prepared, which ends it."""
        with self._lock:
            if self._turn is not None:
                self.off()

    def off(self) -> None:
        """Switch all outputs of the device off, after a recovery of the port if need be."""
        with self._lock:
            self._turn = None
            if not self._open:  # pyusb would open it once more
                return
            try:
                self._send_silence()
            except BaseException as error:  # a fault of the bus that may pass, or a signal
                self._recover()
                if not isinstance(error, LinkError):
                    raise

    def close(self) -> None:
        """Switch all outputs off and release the device, which happens even on an error."""
        with self._lock:
            if self._open:
                with closed_on_error(self._release):
                    self._off_despite_signals(_ATTEMPTS)
                self._release()

    def _off_despite_signals(self, attempts: int) -> None:
        """Switch off, again after a signal: it may come before anything is sent, or amid a recovery."""
        try:
            self.off()
        except BaseException as error:
            if attempts > 1 and not isinstance(error, Exception):
                self._off_despite_signals(attempts - 1)
            raise

    def _recover(self) -> None:
        try:
            with contextlib.suppress(LinkError):  # of several boards one may be gone, and the others play on
                self._port.recover()
            self._send_silence()
        except Exception as error:
            raise OffError(f"{error}; the outputs may still be on: switch the device's power off") from error

    def _send_silence(self) -> None:
        off = torch.zeros(self.device.transducers, **COMPLEX)
        silence = self.device.frame(off)
        # Twice: a device that was left in mid-frame takes the first for the rest of that frame, and one with
        # two buffers may keep the last drive in the other.
        for _ in range(2):
            self._send(silence)
        self._port.flush()

    def _require_open(self) -> None:
        if not self._open:
            raise LinkError(f"{self.device.name} is closed; open it again")

    def _release(self) -> None:
        self._open = False
        atexit.unregister(self.close)
        self._port.close()

    def _send(self, frame: bytes) -> None:
        self._port.write(frame)
        self._sleep(self.device.wire_time(frame))

    def __exit__(self, *_: object) -> None:
        self.close()


def open_link(
    device: Device,
    transducers: _Transducers | None = None,
    serial: str | None = None,
    backend: Any = None,
    settle: float = SETTLE,
    port: str | None = None,
) -> Link:
    """Find a device on USB, or at a serial port, and switch its outputs off.

    Args:
        device: the device to find.
        transducers: the device's transducer for each of the scene's (M,); by default all in order.
        serial: serial number of the USB chip, where several such devices are plugged in.
        backend: of pyusb; by default libusb. With an emulated bench's backend waiting takes no time.
        settle: time that a drive plays before its pressure is read [s], after the frame has been sent.
        port: name of a serial port of the system, such as "COM3" or "/dev/ttyUSB0"; by default the chips of
            the device are looked for over pyusb.

    Raises:
        LinkError: none or several such devices, or it does not take the bytes.
        ValueError: as of `Link`; a `serial` for a device of several boards, or a `port` for one without a
            serial line.
    """
    require_device(device)
    opened = device.open_port({"serial": serial, "port": port}, backend)
    return Link(device, opened, transducers, settle, getattr(backend, "sleep", time.sleep))


def open_autd3(
    boards: int = 1, transducers: _Transducers | None = None, network: Any = None, settle: float = SETTLE
) -> Link:
    """Find boards of AUTD3 on the network and switch their outputs off.

    Their firmware is reset to its defaults first; its silencer smooths every change over a millisecond.

    Args:
        boards: number of boards, >= 1.
        transducers: the device's transducer for each of the scene's (M,); by default all in order.
        network: `autd3.UdpOption` or `autd3.ServerLink`; by default UDP on the interface that finds them.
            An option without a `recovery_interval` gets one: boards are lost after 2 s of silence, and looked
            for again every 0.1 s.
        settle: time that a drive plays before its pressure is read [s].

    `LinkError` if they are not there or do not take the commands, `ImportError` without the packages autd3
    and autd3-pattern, `ValueError` as of `Link` or for `boards` out of range.
    """
    device = AUTD3.with_boards(boards)
    return Link(device, device.open_port({"network": network}), transducers, settle)
