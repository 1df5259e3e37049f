"""AUTD3: 249 transducers a board, 256 phases, 255 amplitudes; on the network, by the client of its kit."""

from __future__ import annotations

import asyncio
import cmath
import math
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from queue import SimpleQueue
from typing import Any, ClassVar

import numpy as np
import torch

from autdtorch.hardware.devices.device import Device, EmulatedBoards, Firmware
from autdtorch.hardware.transport.port import HeldSequence, LinkError, Port, closed_on_error
from autdtorch.scene.boards import AUTD3_TRANSDUCERS
from autdtorch.scene.drive import PhaseLevels
from autdtorch.utils.array_types import COMPLEX, REAL, Bytes
from autdtorch.utils.hints import with_extra
from autdtorch.utils.validation import invalid

_ANSWER_MS = 100  # wait of the kit for an answer; its default of 10 ms is too short on a busy computer
_TIMEOUT = 5.0  # of a command [s]; the kit asks boards that do not answer 8 times more before it gives up
_SILENCE_MS = 2000  # of boards that are then lost: longer than the kit asks twice, as when outputs go off
_RECOVERY_MS = 100  # between attempts to reach lost boards again
_OPENING_TIMEOUT = 60.0  # [s]; the kit takes up to 10 s to find the boards and 30 s to synchronise them

_CLOCK = 40_000.0  # ticks per second, of which every frame lasts a whole number [Hz]
_MOST_TICKS, _MOST_PATTERNS, _MOST_FACTORS = 65_535, 1024, 65_536  # by the kit
_ROUNDING = 1e-6  # relative error of a rate that was written in decimals
_SAME = 1e-6  # largest difference of drives that count as equal, which may come in single precision
_SILENCER = (10, 40)  # ticks in which a change of amplitude, and of phase, is smoothed by default
_LEAD = 0.1  # time from a command until a sequence begins that does not loop [s]; the kit asks for 10 ms
_SECONDS_A_FRAME = 0.02  # further time that the network has to take a frame of a sequence [s]

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

    def emulated_port(self, bench: EmulatedBoards) -> Port:
        return EmulatedAutd3Port(self.boards, bench)

    def require_rate(self, rate: float) -> None:
        super().require_rate(rate)
        if rate < (least := _CLOCK / _MOST_TICKS):
            raise invalid("rate", rate, f"must be at least {least:.3g} for {self.name}", "Hz")
        ticks = _CLOCK / rate
        if abs(ticks - round(ticks)) > _ROUNDING * ticks:
            near = f"{_CLOCK / math.ceil(ticks):.7g} or {_CLOCK / math.floor(ticks):.7g}"
            accepted = f"must be {_CLOCK:g} over a whole number for {self.name}, such as {near}"
            raise invalid("rate", rate, accepted, "Hz")

    def held(self, drives: torch.Tensor, rate: float, loop: bool) -> HeldSequence:
        patterns, factors = _factorised(drives, loop)
        _require_room(len(patterns), _MOST_PATTERNS, "frames, apart from factors of all amplitudes")
        _require_room(len(factors), _MOST_FACTORS, "frames in which only the amplitude of all changes")
        levels = (255 * factors).round().to(torch.uint8).numpy()
        return HeldSequence(_two(self.frames(patterns)), _two(levels), round(_CLOCK / rate), loop)

    def pack(self, *levels: torch.Tensor) -> bytes:
        return torch.cat(levels, dim=-1).to(torch.uint8).numpy().tobytes()

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
        self._held: HeldSequence | None = None
        self._since = 0.0

    def receive(self, data: bytes) -> None:
        self._held, self._playing = None, data

    def hold(self, sequence: HeldSequence) -> None:
        self._held, self._since = sequence, time.perf_counter()

    def drive(self) -> torch.Tensor:
        """Return the drive (N,): phase n / 256 of a period, amplitude i / 255, perhaps modulated."""
        frame, factor = np.frombuffer(self._playing, np.uint8), 255
        if (held := self._held) is not None:
            number = int((time.perf_counter() - self._since) * 40_000 / held.divider)
            frame, factor = (
                part[number % len(part) if held.loop else min(number, len(part) - 1)]
                for part in (held.frames, held.modulation)
            )
        played = [
            cmath.rect(i * int(factor) / 255**2, 2 * math.pi * n / 256)
            for n, i in frame.reshape(2, -1).T.tolist()
        ]
        return torch.tensor(played, **COMPLEX)


def _factorised(drives: torch.Tensor, loop: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return drives (P, N) and factors (T,) from 0 to 1 whose products, P again and again, are drives (T, N).

    P is 1, or, for a loop that exceeds the memory, the least possible. Otherwise return the drives themselves
    and a factor of 1.
    """
    frames = len(drives)
    most = _MOST_PATTERNS if loop and frames > _MOST_PATTERNS else 1
    for count in (count for count in range(1, most + 1) if frames % count == 0):
        laps = drives.reshape(-1, count, drives.shape[1])
        power = laps.abs().square().sum(dim=2)
        loudest = laps[power.argmax(dim=0), torch.arange(count, device="cpu")]
        dots = (laps * loudest.conj()).sum(dim=2).real
        factors = (dots / power.amax(dim=0).clamp_min(torch.finfo(power.dtype).tiny)).clamp(0, 1)
        if (laps - factors[..., None] * loudest).abs().max() <= _SAME:
            return loudest, factors.flatten()
    return drives, torch.ones(1, **REAL)


def _require_room(count: int, most: int, what: str) -> None:
    if count > most:
        raise ValueError(f"sequence: {count} frames; must be at most {most} {what}, the memory of AUTD3")


def _two(rows: Bytes) -> Bytes:
    """Return rows, the only one twice: the firmware takes no fewer."""
    return rows.repeat(2, axis=0) if len(rows) == 1 else rows


#: One board. An intensity i is proportional to the amplitude, as the firmware gives it the pulse width
#: 512 asin(i / 255) / pi (AUTD3 manual, "Intensity and Pulse Width"), unless another table was loaded.
AUTD3 = _Autd3(
    name="AUTD3",
    board=AUTD3_TRANSDUCERS,
    phase_levels=PhaseLevels(256, 255),
    columns=("phase", "intensity"),
    most_rate=_CLOCK,
    most_boards=None,
)


def autd3_kit() -> Any:
    """Return the package autd3; `ImportError` if a part of the kit is missing."""
    try:
        import autd3
        import autd3_core  # noqa: F401
        import autd3_modulation  # noqa: F401
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
        option = _lasting(autd3.UdpOption() if network is None else network)
        config = autd3.ClientConfig(ack_timeout=autd3.Duration.from_millis(_ANSWER_MS))
        self._error: type[Exception] = autd3.Autd3Error
        self._boards = boards
        self._holds_sequence = False
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
        from autd3.commands import Clear

        pattern = autd3_pattern(data, self._boards)
        # Before it `Clear` ends modulation and smoothing of a sequence, and is silent.
        self._send("be written to", [Clear(), pattern] if self._holds_sequence else pattern)
        self._holds_sequence = False

    def hold(self, sequence: HeldSequence) -> None:
        """Begin a sequence; a loop begins anywhere, as the boards count by their common clock."""
        from autd3.commands import ActivateModulationBank, ActivatePatternBank
        from autd3.value import ModulationBank, PatternBank, TransitionMode
        from autd3_core import Duration

        self._holds_sequence = True
        seconds = _TIMEOUT + _SECONDS_A_FRAME * len(sequence.frames)
        self._send("take a sequence", autd3_sequence(sequence, self._boards), seconds)
        if sequence.loop:
            return

        async def start() -> None:
            moment = self._client.device_time_now() + Duration.from_secs_f64(_LEAD)
            at = TransitionMode.SysTime(moment)
            await self._client.send(
                [ActivateModulationBank(ModulationBank.B1, at), ActivatePatternBank(PatternBank.B1, at)]
            )

        self._run("start a sequence", start, _TIMEOUT)
        time.sleep(_LEAD)

    def recover(self) -> None:
        """Wait until lost boards have been looked for again."""
        time.sleep(3e-3 * _RECOVERY_MS)

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

    def _send(self, what: str, command: Any, seconds: float | None = None) -> None:
        async def send() -> None:
            await self._client.send(command)

        self._run(what, send, _TIMEOUT if seconds is None else seconds)

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


def autd3_sequence(sequence: HeldSequence, boards: int) -> list[Any]:
    """Return the kit's commands for a sequence; one that does not loop waits in bank B1 for its activation.

    The silencer smooths a change over at most one frame, at whose end every level is reached.
    """
    from autd3.commands import (
        Clear,
        FixedCompletionTime,
        Modulation,
        PatternStm,
        PatternStmOption,
        SetSilencer,
    )
    from autd3.value import LoopBehavior, ModulationBank, PatternBank, SamplingConfig, TransitionMode
    from autd3_core import Duration
    from autd3_modulation import ModulationBuffer
    from autd3_pattern import IntensityBuffer, PhaseBuffer

    intensity, phase = (Duration.from_micros(25 * min(ticks, sequence.divider)) for ticks in _SILENCER)
    sampling = SamplingConfig(sequence.divider)
    loops = LoopBehavior.Infinite if sequence.loop else LoopBehavior.Once
    begins = TransitionMode.Immediate if sequence.loop else TransitionMode.Later
    frames = sequence.frames.reshape(-1, 2, boards, AUTD3_TRANSDUCERS)
    phases = [PhaseBuffer.from_array(frame) for frame in frames[:, 0]]
    intensities = [IntensityBuffer.from_array(frame) for frame in frames[:, 1]]
    option = PatternStmOption(PatternBank.B1, loop_behavior=loops, transition_mode=begins)
    factors = ModulationBuffer.from_array(sequence.modulation)
    return [
        Clear(),
        SetSilencer(FixedCompletionTime(intensity, phase)),
        Modulation(sampling, factors, ModulationBank.B1, loops, begins),
        PatternStm(sampling, phases, intensities, option),
    ]


class EmulatedAutd3Port(Autd3Port):
    """The port of AUTD3 boards that the kit emulates on this machine, silently; a bench plays for them."""

    def __init__(self, boards: int, bench: EmulatedBoards) -> None:
        """Start the emulator of `boards` boards, and connect to it."""
        self._emulator = autd3_kit().UdpEmulator(boards)
        self._bench = bench
        super().__init__(boards, self._emulator.option())

    def write(self, data: bytes) -> None:
        """Play a frame, on boards and bench."""
        super().write(data)
        self._bench.receive(data)

    def hold(self, sequence: HeldSequence) -> None:
        """Begin a sequence, on boards and bench."""
        super().hold(sequence)
        if isinstance(self._bench.firmware, _Autd3Firmware):
            self._bench.firmware.hold(sequence)


def _network(text: str) -> Any:
    """Return the setting `hardware.network` as the kit takes it."""
    kind, separator, port = text.partition(":")
    if (kind, separator) != ("server", ":"):
        return autd3_kit().UdpOption(text)
    if not (port.isdecimal() and 0 < int(port) < 2**16):
        raise invalid("hardware.network", text, "must be server:PORT with a port from 1 to 65535")
    return autd3_kit().ServerLink(int(port))


def _lasting(network: Any) -> Any:
    """Return a way to the boards that outlasts a busy moment of the network or the computer.

    By the kit's defaults boards that are silent for 0.1 s are lost for good, and cannot be switched off.
    """
    autd3 = autd3_kit()
    if not isinstance(network, autd3.UdpOption) or network.recovery_interval is not None:
        return network
    settings = {name: getattr(network, name) for name in dir(network) if not name.startswith("_")}
    settings["lost_timeout"] = max(network.lost_timeout, autd3.Duration.from_millis(_SILENCE_MS))
    settings["recovery_interval"] = autd3.Duration.from_millis(_RECOVERY_MS)
    return autd3.UdpOption(**settings)
