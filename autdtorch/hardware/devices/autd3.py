"""AUTD3: 249 transducers a board, 256 phases, 255 amplitudes; on the network, by the client of its kit."""

from __future__ import annotations

import asyncio
import cmath
import math
import threading
from collections.abc import Callable, Coroutine, Mapping
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from autdtorch.hardware.devices.device import Device, Firmware
from autdtorch.hardware.transport.port import LinkError, Port, closed_on_error
from autdtorch.scene.arrays import AUTD3_TRANSDUCERS
from autdtorch.scene.drive import PhaseLevels
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.hints import with_extra
from autdtorch.utils.validation import invalid

if TYPE_CHECKING:
    from autdtorch.hardware.emulator.bench import EmulatedBench

_ANSWER_MS = 100  # wait of the kit for an answer; its default of 10 ms is too short on a busy computer
_TIMEOUT = 5.0  # of a command [s]; the kit asks boards that do not answer 8 times more before it gives up
_OPENING_TIMEOUT = 60.0  # [s]; the kit takes up to 10 s to find the boards and 30 s to synchronise them

_Command = Callable[[], Coroutine[Any, Any, None]]
_Asked = tuple[_Command, SimpleQueue[BaseException | None]]  # with the queue that its end goes into


class _Autd3(Device):
    """A frame is the phases of all boards, then the intensities of all."""

    keys = ("boards",)
    port_keys = ("network",)

    def open_port(self, place: Mapping[str, Any], backend: Any = None) -> Port:
        network = place.get("network")
        for name, value in {**place, "backend": backend}.items():
            if name != "network" and value is not None:
                raise invalid(name, value, f"must be None, as {self.name} is on the network")
        return Autd3Port(self.boards, _network(network) if isinstance(network, str) else network)

    def emulated_port(self, bench: EmulatedBench) -> Port:
        return EmulatedAutd3Port(self.boards, bench)

    def pack(self, *levels: torch.Tensor) -> bytes:
        return torch.cat(levels).to(torch.uint8).numpy().tobytes()

    def firmware(self, transducers: int) -> Firmware:
        return _Autd3Firmware(transducers)


class _Autd3Firmware:
    """Boards behind their software kit, which receives a frame as one pattern.

    The kit makes the packets to the boards; its `autd3_emulator` checks the levels in them.
    """

    baud: ClassVar[int | None] = None

    def __init__(self, transducers: int) -> None:
        """Switch boards of so many `transducers` on; they are silent until the first pattern."""
        self._playing = bytes(2 * transducers)

    def receive(self, data: bytes) -> None:
        self._playing = data

    def drive(self) -> torch.Tensor:
        """Return the drive (N,): phase n / 256 of a period, amplitude i / 255."""
        levels = np.frombuffer(self._playing, np.uint8).reshape(2, -1).T.tolist()
        played = [cmath.rect(i / 255, 2 * math.pi * n / 256) for n, i in levels]
        return torch.tensor(played, **COMPLEX)


#: One board. An intensity i is proportional to the amplitude, as the firmware gives it the pulse width
#: 512 asin(i / 255) / pi (AUTD3 manual, "Intensity and Pulse Width"), unless another table was loaded.
AUTD3 = _Autd3(
    name="AUTD3",
    board=AUTD3_TRANSDUCERS,
    phase_levels=PhaseLevels(256, 255),
    columns=("phase", "intensity"),
    most_boards=None,
)


def autd3_kit() -> Any:
    """Return the package autd3; `ImportError` if a part of the kit is missing."""
    try:
        import autd3
        import autd3_core  # noqa: F401
        import autd3_pattern  # noqa: F401
    except ImportError as error:
        raise ImportError(f"{error}; {with_extra('autd3')} brings it") from error
    return autd3


class Autd3Port(Port):
    """Boards of AUTD3 on the network; `LinkError` if one does not answer, `ImportError` without the kit.

    The kit's event loop has a thread for itself, and signals are handled in the main thread. A signal in the
    code of asyncio would lose the command's wake-up, and closing the loop would wait for it for ever.
    """

    def __init__(self, boards: int, network: Any = None) -> None:
        """Connect to `boards` boards by `network`, as of `open_autd3`, and reset their firmware."""
        autd3 = autd3_kit()
        from autd3.commands import Clear
        from autd3_core import Autd3, Geometry

        # A pattern is by board and transducer: the places of the boards play no part.
        geometry = Geometry([Autd3() for _ in range(boards)])
        option = autd3.UdpOption() if network is None else network
        config = autd3.ClientConfig(ack_timeout=autd3.Duration.from_millis(_ANSWER_MS))
        self._error: type[Exception] = autd3.Autd3Error
        self._boards = boards
        self._client: Any = None
        self._commands: SimpleQueue[_Asked | None] = SimpleQueue()
        # A daemon: others are waited for before `atexit` calls the link's switching off.
        threading.Thread(target=_obey, args=(self._commands,), name="AUTD3", daemon=True).start()

        async def open_client() -> None:  # sets the client itself, as a signal may end the wait for it
            self._client = await autd3.Client.open(geometry, option, config)

        with closed_on_error(self.close):
            self._run("be opened", open_client, _OPENING_TIMEOUT)
            self._send("be reset", Clear())

    def write(self, data: bytes) -> None:
        """Play a frame; its boards have taken it when this returns."""
        self._send("be written to", autd3_pattern(data, self._boards))

    def close(self) -> None:
        """Release the boards, even if they do not answer."""

        async def close_client() -> None:
            client, self._client = self._client, None  # the kit releases boards that do not answer with it
            if client is not None:
                await client.close()

        try:
            self._run("be closed", close_client, _TIMEOUT)
        finally:
            self._commands.put(None)

    def _send(self, what: str, command: Any) -> None:
        async def send() -> None:
            await self._client.send(command)

        self._run(what, send, _TIMEOUT)

    def _run(self, what: str, command: _Command, seconds: float) -> None:
        """Have the thread run a command after all earlier ones, and wait for its end.

        No signal may break a step of this: a `SimpleQueue` puts and gets in one piece.
        """

        async def timed() -> None:
            async with asyncio.timeout(seconds):
                await command()

        ended: SimpleQueue[BaseException | None] = SimpleQueue()
        self._commands.put((timed, ended))
        error = ended.get()
        if isinstance(error, TimeoutError):
            raise LinkError(f"AUTD3 cannot {what}: no answer within {seconds:g} s") from error
        if isinstance(error, self._error):
            raise LinkError(f"AUTD3 cannot {what}: {error}") from error
        if error is not None:
            raise error


def _obey(commands: SimpleQueue[_Asked | None]) -> None:
    """Run one command after the other, until None, and report the end of each."""
    with asyncio.Runner() as runner:
        while (asked := commands.get()) is not None:
            command, ended = asked
            try:
                runner.run(command())
            except BaseException as error:  # raised where it is waited for
                ended.put(error)
            else:
                ended.put(None)


def autd3_pattern(frame: bytes, boards: int) -> Any:
    """Return the kit's command (`autd3.commands.Pattern`) for a frame: all phases, then all intensities."""
    from autd3.commands import Pattern
    from autd3_pattern import IntensityBuffer, PhaseBuffer

    phases, intensities = np.frombuffer(frame, np.uint8).reshape(2, boards, -1)
    return Pattern(PhaseBuffer.from_array(phases), IntensityBuffer.from_array(intensities))


class EmulatedAutd3Port(Autd3Port):
    """The port of AUTD3 boards that the kit emulates on this machine, silently; a bench plays for them."""

    def __init__(self, boards: int, bench: EmulatedBench) -> None:
        """Start the emulator of `boards` boards, and connect to it."""
        self._emulator = autd3_kit().UdpEmulator(boards)
        self._bench = bench
        super().__init__(boards, self._emulator.option())

    def write(self, data: bytes) -> None:
        """Play a frame, on boards and bench."""
        super().write(data)
        self._bench.receive(data)


def _network(text: str) -> Any:
    """Return the setting `hardware.network` as the kit takes it."""
    kind, separator, port = text.partition(":")
    if (kind, separator) != ("server", ":"):
        return autd3_kit().UdpOption(text)
    if not (port.isdecimal() and 0 < int(port) < 2**16):
        raise invalid("hardware.network", text, "must be server:PORT with a port from 1 to 65535")
    return autd3_kit().ServerLink(int(port))
