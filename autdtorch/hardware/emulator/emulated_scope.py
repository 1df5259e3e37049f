"""An oscilloscope without hardware: USBTMC, its commands, and the waveforms of microphones on a bench.

Written from the makers' programming guides and the specification of USBTMC, not from `scpi_scope` and
`usbtmc`, so that one checks the other.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.hardware.emulator.bench import EmulatedBench, EmulatedDevice, stall, time_out
from autdtorch.hardware.sensors.scpi_scope import FREQUENCIES, SENSITIVITIES
from autdtorch.utils.validation import (
    integer_at_least,
    integers,
    number_between,
    require_callable,
    require_one_of,
)

_DRIFT_CAPTURES = 1000  # after which the rms of a drift is stated
_PACKET = 64  # of USB
_CLASS_INTERFACE = 0xA1  # from the device
_INITIATE_CLEAR, _CHECK_CLEAR_STATUS = 5, 6


@dataclass(frozen=True)
class _Maker:
    time_scale: str
    capture: str  # the command that takes a capture
    clear: str | None
    ignored: frozenset[str]  # settings and commands without effect here
    answers: dict[str, str]
    points: int
    codes_per_division: int
    middle: int
    clipped: tuple[int, int]  # codes of samples below and above the range of the converter
    digits: int  # in the length of a block
    scales: tuple[float, float]  # the finest and the coarsest [V/division]


_MAKERS = {
    "Keysight": _Maker(
        "TIM:SCAL", "DIG", None,
        frozenset({"ACQ:TYPE", "TRIG:SWE", "WAV:FORM", "WAV:UNS", "WAV:POIN"}),
        {"*IDN?": "KEYSIGHT TECHNOLOGIES,DSO-X 3024T,EMULATED,07.50", "*OPC?": "1"},
        points=1000, codes_per_division=32, middle=128, clipped=(1, 255), digits=8,
        scales=(1e-3, 5.0),
    ),
    "Rigol": _Maker(
        "TIM:MAIN:SCAL", "TFOR", "CLE",
        frozenset({"ACQ:TYPE", "SING", "WAV:FORM", "WAV:MODE"}),
        {"*IDN?": "RIGOL TECHNOLOGIES,DS1104Z,EMULATED,00.04.04", "TRIG:STAT?": "STOP"},
        points=1200, codes_per_division=25, middle=127, clipped=(0, 255), digits=9,
        scales=(1e-3, 10.0),
    ),
}  # fmt: skip
_INPUT_SETTINGS = frozenset({"DISP", "PROB", "COUP", "OFFS", "VERN"})


_LARGEST_VOLTAGE = 1e3  # [V]
_LARGEST_DRIFT = 10.0


class EmulatedScope:
    """An oscilloscope with microphones at the control points of a bench; 8 bits, from a random moment on.

    Attributes:
        points: control point of the microphone at each input, from the first.
        unknown: lines that are no known command.
    """

    def __init__(
        self,
        pressure: Callable[[], torch.Tensor],
        frequency: float,
        sensitivity: float,
        points: Sequence[int],
        maker: str = "Keysight",
        noise: float = 0.0,
        dc_offset: float = 0.0,
        drift: float = 0.0,
        seed: int = 0,
    ) -> None:
        """Set the bench up.

        Args:
            pressure: returns the phasors (P,) [Pa] at the control points now.
            frequency: of the sound [Hz].
            sensitivity: of all microphones, with their amplifiers [V/Pa].
            points: control point, from 0, of the microphone at each input, from the first.
            maker: of the oscilloscope, Keysight or Rigol.
            noise: rms of the white noise at every input [V].
            dc_offset: voltage at every input without sound [V].
            drift: the microphones' gain is e^u, u a random walk of this rms after 1000 captures.
            seed: of noise, drift and the moments of capture, >= 0.

        `ValueError` for an argument out of range.
        """
        require_callable("pressure", pressure)
        require_one_of("maker", maker, _MAKERS)
        self.points = integers("points", points, 0, "must be numbers of control points, from 0")
        self.unknown: list[str] = []
        self._maker = _MAKERS[maker]
        self._pressure = pressure
        self._frequency = number_between("frequency", frequency, *FREQUENCIES, "Hz")
        self._sensitivity = number_between("sensitivity", sensitivity, *SENSITIVITIES, "V/Pa")
        self._noise = number_between("noise", noise, 0.0, _LARGEST_VOLTAGE, "V")
        self._offset = number_between("dc_offset", dc_offset, -_LARGEST_VOLTAGE, _LARGEST_VOLTAGE, "V")
        self._drift = number_between("drift", drift, 0.0, _LARGEST_DRIFT)
        self._generator = np.random.default_rng(integer_at_least("seed", seed, 0))
        self._walk = 0.0
        self._time_scale, self._source = 1e-3, 0
        self._scales = [1.0] * len(self.points)
        self._captured: list[tuple[bytes, float]] = []  # codes, and the scale they were taken on

    def plug_into(self, bench: EmulatedBench, chip: tuple[int, int], serial: str = "EMULATED") -> None:
        """Appear on the bus of a bench, with idVendor and idProduct of `chip` and a `serial` number."""
        bench.bus.chips.append(EmulatedInstrument(*chip, serial, self))

    def execute(self, line: str) -> bytes | None:
        """Execute a line, and return its answer, if it has one."""
        header, _, argument = line.partition(" ")
        header = _short(header)
        match = re.fullmatch(r"CHAN(\d):(\w+)", header)
        number = int(match[1]) - 1 if match and 1 <= int(match[1]) <= len(self.points) else None
        setting = match[2] if match and number is not None else ""
        if header == self._maker.time_scale:
            self._time_scale = float(argument)
        elif number is not None and setting == "SCAL":
            self._scales[number] = min(max(float(argument), self._maker.scales[0]), self._maker.scales[1])
        elif header == "WAV:SOUR":
            self._source = int(argument[-1]) - 1
        elif header == self._maker.clear:
            self._captured = []
        elif header == self._maker.capture:
            self._capture()
        elif header.endswith("?") and (answer := self._answer(header)) is not None:
            return answer + b"\n"
        elif header not in self._maker.ignored and setting not in _INPUT_SETTINGS:
            self.unknown.append(line)
        return None

    def _answer(self, header: str) -> bytes | None:
        maker = self._maker
        if header in maker.answers:
            return maker.answers[header].encode()
        if not 0 <= self._source < len(self._captured):
            return None
        codes, scale = self._captured[self._source]
        if header == "WAV:PRE?":
            resolution = scale / maker.codes_per_division
            time = f"{self._step():+.6E},{-self._step() * maker.points / 2:+.6E},+0"
            return f"+0,+0,{len(codes):+d},+1,{time},{resolution:+.6E},+0,{maker.middle:+d}".encode()
        if header == "WAV:DATA?":
            return f"#{maker.digits}{len(codes):0{maker.digits}d}".encode() + codes
        return None

    def _step(self) -> float:
        return self._time_scale / 100

    def _capture(self) -> None:
        """Sample all inputs, from a random moment on."""
        self._walk += self._drift / _DRIFT_CAPTURES**0.5 * self._generator.standard_normal()
        samples = np.arange(self._maker.points)
        moments = self._generator.uniform(0, 1 / self._frequency) + self._step() * samples
        turns = np.exp(-2j * np.pi * self._frequency * moments)
        phasors = self._pressure().numpy()[self.points] * self._sensitivity * np.exp(self._walk)
        noise = self._noise * self._generator.standard_normal((len(self.points), len(moments)))
        volts = (phasors[:, None] * turns).real + self._offset + noise
        low, high = self._maker.clipped
        steps = volts * self._maker.codes_per_division / np.array(self._scales)[:, None]
        codes = np.clip(np.round(steps) + self._maker.middle, low, high).astype(np.uint8)
        self._captured = [(row.tobytes(), scale) for row, scale in zip(codes, self._scales, strict=True)]


class EmulatedInstrument(EmulatedDevice):
    """The USB interface of an instrument: USB488, without its interrupt endpoint.

    A message longer than `longest` bytes comes in several transfers. An empty packet follows a transfer of
    whole packets, as USB demands, if `sends_empty_packets`; some instruments send none.
    """

    interfaces = (((0xFE, 0x03, 0x01), (0x82, 0x01)),)

    def __init__(self, vendor: int, product: int, serial: str, instrument: EmulatedScope) -> None:
        """Plug it in."""
        super().__init__(vendor, product, serial)
        self.sends_empty_packets, self.longest = True, 512
        self._instrument = instrument
        self._received = self._answer = b""
        self._asked: tuple[int, int] | None = None  # tag, bytes
        self._sending: bytes | None = None

    def answer(self, kind: int, request: int) -> bytes | None:
        """Answer INITIATE_CLEAR and CHECK_CLEAR_STATUS, which succeed at once."""
        if kind != _CLASS_INTERFACE:
            return None
        if request == _INITIATE_CLEAR:
            self._received, self._answer, self._asked, self._sending = b"", b"", None, None
        return {_INITIATE_CLEAR: b"\x01", _CHECK_CLEAR_STATUS: b"\x01\x00"}.get(request)

    def write(self, data: bytes) -> None:
        """Take a transfer: part of a message, or the request for an answer."""
        kind, tag, complement = data[:3]
        length = int.from_bytes(data[4:8], "little")
        if tag == 0 or tag + complement != 255:
            raise stall()
        if kind == 2 and len(data) == 12:
            self._asked = tag, length
        elif kind == 1 and len(data) == 12 + length + -length % 4:
            self._received += data[12 : 12 + length]
            if data[8] & 1:  # the message ends
                line, self._received = self._received.decode("ascii").strip(), b""
                self._answer = self._instrument.execute(line) or b""
        else:
            raise stall()

    def read(self, most: int) -> bytes:
        """Return at most `most` bytes of a requested transfer."""
        transfer = self._transfer() if self._sending is None else self._sending
        piece, rest = transfer[:most], transfer[most:]
        whole = len(piece) % _PACKET == 0
        if whole and len(piece) < most and not self.sends_empty_packets:
            raise time_out()  # the host waits for more
        empty_is_due = whole and len(piece) == most and self.sends_empty_packets
        self._sending = rest if rest or empty_is_due else None
        return piece

    def _transfer(self) -> bytes:
        if self._asked is None or not self._answer:
            raise time_out()
        tag, most = self._asked
        self._asked = None
        size = min(most, self.longest)
        data, self._answer = self._answer[:size], self._answer[size:]
        header = bytes([2, tag, 255 - tag, 0, *len(data).to_bytes(4, "little"), not self._answer, 0, 0, 0])
        return header + data + bytes(-len(data) % 4)


def _short(header: str) -> str:
    """Return a header in capitals and short form: words of four letters, or three before a vowel."""
    return re.sub(r"([A-Z]{3})([AEIOU][A-Z]+|([A-Z])[A-Z]+)", r"\1\3", header.upper().removeprefix(":"))
