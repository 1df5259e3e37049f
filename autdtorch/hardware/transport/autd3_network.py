"""AUTD3 over its own software development kit, as it hangs on the network and not on USB."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine, Sequence
from queue import SimpleQueue
from typing import Any

import numpy as np
import torch

from autdtorch.hardware.devices import Device
from autdtorch.hardware.devices.levels import Levels, autd3_drive, autd3_levels
from autdtorch.hardware.link import SETTLE, Link
from autdtorch.hardware.transport.usb import LinkError, closed_on_error
from autdtorch.scene.device_layouts import AUTD3_TRANSDUCERS
from autdtorch.utils.validation import integer_at_least

#: How long the kit waits for an answer [ms]; its own 10 ms run out on a computer that is busy.
_ANSWER_MS = 100
#: How long a command may take [s]; the kit asks boards that do not answer 8 times more before it gives up.
_TIMEOUT = 5.0
#: And opening [s]: the kit takes up to 10 s to find the boards and 30 s to synchronise them.
_OPENING_TIMEOUT = 60.0

_Command = Callable[[], Coroutine[Any, Any, None]]
_Asked = tuple[_Command, SimpleQueue[BaseException | None]]  # and to whom its end is told


def autd3_device(boards: int = 1) -> Device:
    """Boards of AUTD3, 249 transducers each: 256 phases, 255 amplitudes; not on USB, but for `open_autd3`.

    Args:
        boards: their number, >= 1.

    Raises:
        ValueError: `boards` out of range.
    """
    return Device(
        name="AUTD3",
        adapters=(),
        transducers=AUTD3_TRANSDUCERS * integer_at_least("boards", boards, 1),
        frame=_autd3_frame,
        played=_autd3_played,
    )


def open_autd3(
    boards: int = 1,
    transducers: Sequence[int] | torch.Tensor | None = None,
    network: Any = None,
    settle: float = SETTLE,
) -> Link:
    """Find boards of AUTD3 on the network and switch their outputs off.

    Their firmware is reset to its defaults first; its silencer smooths every change over a millisecond.

    Args:
        boards: their number, >= 1.
        transducers: for each transducer of the scene, which of the device's it is (M,); by default all in
            order.
        network: `autd3.UdpOption` or `autd3.ServerLink`; by default UDP on the interface that finds them.
        settle: how long a drive plays before its pressure is read [s].

    Raises:
        LinkError: they are not there, or do not take the commands.
        ImportError: the packages autd3 and autd3-pattern are missing.
        ValueError: `boards` out of range; `transducers` that they do not have, or one twice; or a negative
            `settle`.
    """
    device = autd3_device(boards)
    port = Autd3Port(boards, network)
    with closed_on_error(port.close):
        return Link(device, port, transducers, settle)


def autd3_kit() -> Any:
    """The package autd3, if all that is needed of the kit is there.

    Raises:
        ImportError: the packages autd3 and autd3-pattern are missing.
    """
    try:
        import autd3
        import autd3_core  # noqa: F401
        import autd3_pattern  # noqa: F401
    except ImportError as error:
        raise ImportError(f"{error}; pip install 'autdtorch[autd3]' brings what is needed") from error
    return autd3


class Autd3Port:
    """Boards of AUTD3 on the network, by the client of their kit, which waits until they have answered.

    The kit's event loop runs in a thread of its own, where commands wait for their turn. Signals are heard in
    the main thread, so that none breaks off a command: an exception in asyncio's own code loses what would
    wake the command up, and closing the loop then waits for it for ever.
    """

    def __init__(self, boards: int, network: Any = None) -> None:
        """Connect, and reset the firmware to its defaults.

        Args:
            boards: their number.
            network: `autd3.UdpOption` or `autd3.ServerLink`; by default UDP on the interface that finds them.

        Raises:
            LinkError: they are not there.
            ImportError: the packages autd3 and autd3-pattern are missing.
        """
        autd3 = autd3_kit()
        from autd3.commands import Clear
        from autd3_core import Autd3, Geometry

        # A pattern is by board and transducer: where the boards stand plays no part.
        geometry = Geometry([Autd3() for _ in range(boards)])
        option = autd3.UdpOption() if network is None else network
        config = autd3.ClientConfig(ack_timeout=autd3.Duration.from_millis(_ANSWER_MS))
        self._error: type[Exception] = autd3.Autd3Error
        self._boards = boards
        self._client: Any = None
        self._commands: SimpleQueue[_Asked | None] = SimpleQueue()
        # A daemon: others are waited for before what `atexit` holds, the link's switching off, is called.
        threading.Thread(target=_obey, args=(self._commands,), name="AUTD3", daemon=True).start()

        async def open_client() -> None:  # kept here, as a signal may end the wait for it
            self._client = await autd3.Client.open(geometry, option, config)

        with closed_on_error(self.close):
            self._run("be opened", open_client, _OPENING_TIMEOUT)
            self._send("be reset", Clear())

    def write(self, data: bytes) -> None:
        """Play a frame; its boards have taken it when this returns.

        Raises:
            LinkError: a board did not take it.
        """
        self._send("be written to", autd3_pattern(data, self._boards))

    def flush(self) -> None:
        """`write` has waited for their answer."""

    def recover(self) -> None:
        """The kit leaves nothing half sent."""

    def close(self) -> None:
        """Let go of the boards.

        Raises:
            LinkError: they do not answer; they are let go all the same.
        """

        async def close_client() -> None:
            client, self._client = self._client, None  # the kit lets go of boards that do not answer with it
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
        """Have the thread do it, after all that was asked for before, and wait.

        Nothing here may be torn by a signal: a `SimpleQueue` puts and gets in one piece.
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
    """Do one command after the other, until None, and say how each ended."""
    with asyncio.Runner() as runner:
        while (asked := commands.get()) is not None:
            command, ended = asked
            try:
                runner.run(command())
            except BaseException as error:  # whoever waits raises it
                ended.put(error)
            else:
                ended.put(None)


def autd3_pattern(frame: bytes, boards: int) -> Any:
    """The kit's command (`autd3.commands.Pattern`) for a frame: all phases, then all intensities."""
    from autd3.commands import Pattern
    from autd3_pattern import IntensityBuffer, PhaseBuffer

    phases, intensities = np.frombuffer(frame, np.uint8).reshape(2, boards, AUTD3_TRANSDUCERS)
    return Pattern(PhaseBuffer.from_array(phases), IntensityBuffer.from_array(intensities))


def _autd3_frame(drive: torch.Tensor) -> bytes:
    return torch.cat(autd3_levels(drive)).to(torch.uint8).numpy().tobytes()


def _autd3_played(frame: bytes) -> torch.Tensor:
    values = torch.from_numpy(np.frombuffer(frame, np.uint8).astype(np.int64))
    return autd3_drive(Levels(*values.reshape(2, -1)))
