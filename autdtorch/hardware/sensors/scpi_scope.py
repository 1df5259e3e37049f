"""Oscilloscopes on USB: SCPI commands by maker, captures, and volts from their samples.

From the makers' programming guides; none was tried on a device.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from autdtorch.hardware.transport.port import LinkError, closed_on_error
from autdtorch.hardware.transport.usb import find_device
from autdtorch.hardware.transport.usbtmc import UsbtmcPort
from autdtorch.utils.validation import positive_integers, require_kind

logger = logging.getLogger(__name__)

#: Finest vertical scale of both makers [V/division].
FINEST = 1e-3
#: Coarsest vertical scale that both makers have [V/division].
COARSEST = 5.0
#: Sensitivities of microphones with their amplifiers that are taken for true [V/Pa].
SENSITIVITIES = (1e-9, 1e3)
#: Frequencies that an oscilloscope may capture [Hz].
FREQUENCIES = (1.0, 1e9)
_CAPTURE_TIME = 2.0  # time limit of a capture [s]
# Commands of both makers: of an input, with its vertical scale, and for its waveform.
_SET_UP_INPUT = (
    ":CHANnel{input}:DISPlay ON",
    ":CHANnel{input}:PROBe 1",
    ":CHANnel{input}:COUPling AC",
    ":CHANnel{input}:OFFSet 0",
    ":CHANnel{input}:VERNier ON",  # else some scales would be rounded to 1, 2 or 5
)
_SCALE = ":CHANnel{input}:SCALe {scale:.6g}"
_SOURCE = ":WAVeform:SOURce CHANnel{input}"
# Question for ten numbers: the fifth is the time step, the last are step, origin, reference of the voltage.
_PREAMBLE = ":WAVeform:PREamble?"
# Question for the samples, a byte each, as a definite-length block.
_SAMPLES = ":WAVeform:DATA?"


@dataclass(frozen=True)
class Waveform:
    """The samples of one input.

    Attributes:
        volts: (S,) [V], float64.
        time_step: from sample to sample [s].
        resolution: a step of the converter [V].
        clipped: number of samples beyond the converter's range.
    """

    volts: torch.Tensor
    time_step: float
    resolution: float
    clipped: int


@dataclass(frozen=True)
class Dialect:
    """The commands of a maker, beside those of all makers.

    Attributes:
        name: of the oscilloscopes that take them.
        set_up: sent once, with the time scale ``{time}`` [s/division].
        capture: starts a capture of all inputs at once, without a trigger signal.
        status: question for the end of the capture.
        ready: answer to it at the end.
        lowest: lowest code of a sample that is not clipped; the highest is 254.
        origin_in_codes: the voltage's origin is a number of codes, not of volts.
    """

    name: str
    set_up: tuple[str, ...]
    capture: tuple[str, ...]
    status: str
    ready: str
    lowest: int
    origin_in_codes: bool

    def waveform(self, preamble: str, codes: bytes) -> Waveform:
        """Return the waveform of the answers to the questions for preamble and samples.

        `LinkError` if the preamble is not ten numbers, with steps above 0, or there are no samples.
        """
        try:
            numbers = [float(number) for number in preamble.split(",")]
            time_step, resolution, origin, reference = numbers[4], *numbers[7:]
        except (ValueError, IndexError) as error:
            raise LinkError(f"oscilloscope: preamble {preamble[:80]!r}; must be ten numbers") from error
        if not (time_step > 0 and resolution > 0 and codes):
            answers = f"preamble {preamble[:80]!r} and {len(codes)} samples"
            raise LinkError(f"oscilloscope: {answers} make no waveform")
        values = torch.frombuffer(bytearray(codes), dtype=torch.uint8)
        clipped = int(((values < self.lowest) | (values > 254)).sum())
        steps = values.to(torch.float64) - reference
        volts = (steps - origin) * resolution if self.origin_in_codes else steps * resolution + origin
        return Waveform(volts, time_step, resolution, clipped)


#: InfiniiVision 2000, 3000 and 4000 X-Series Programmer's Guides.
KEYSIGHT = Dialect(
    "Keysight InfiniiVision",
    set_up=(
        ":ACQuire:TYPE NORMal",
        ":TIMebase:SCALe {time:.6g}",
        ":TRIGger:SWEep AUTO",
        ":WAVeform:FORMat BYTE",
        ":WAVeform:UNSigned ON",
        ":WAVeform:POINts 1000",
    ),
    capture=(":DIGitize",),
    status="*OPC?",
    ready="1",
    lowest=2,  # 0 is a hole, 1 clipped
    origin_in_codes=False,
)

#: MSO1000Z/DS1000Z Programming Guide; the samples are those of the screen.
RIGOL = Dialect(
    "Rigol DS1000Z",
    set_up=(
        ":ACQuire:TYPE NORMal",
        ":TIMebase:MAIN:SCALe {time:.6g}",
        ":WAVeform:MODE NORMal",
        ":WAVeform:FORMat BYTE",
    ),
    capture=(":CLEar", ":SINGle", ":TFORce"),  # cleared, so that no old capture is taken for the new
    status=":TRIGger:STATus?",
    ready="STOP",
    lowest=1,
    origin_in_codes=True,
)


class Oscilloscope(contextlib.AbstractContextManager["Oscilloscope"]):
    """An oscilloscope that captures on request, without a trigger signal; `identity` answers ``*IDN?``.

    Use it as a context manager. Methods raise `LinkError` if it does not take commands or does not answer.
    """

    def __init__(self, port: UsbtmcPort, dialect: Dialect = KEYSIGHT) -> None:
        """Ask the oscilloscope at a `port` for its identity; `dialect` has the commands of its maker."""
        require_kind("port", port, UsbtmcPort)
        require_kind("dialect", dialect, Dialect)
        self._port, self._dialect = port, dialect
        self._scales: dict[int, float] = {}  # by input, as sent
        self.identity = port.ask("*IDN?")

    def set_up(self, inputs: Collection[int], time_scale: float) -> None:
        """Set up inputs, by their numbers from 1, and their common `time_scale` [s/division]."""
        for command in self._dialect.set_up:
            self._port.tell(command.format(time=time_scale))
        for number in inputs:
            for command in _SET_UP_INPUT:
                self._port.tell(command.format(input=number))

    def capture(self, scales: Mapping[int, float]) -> list[Waveform]:
        """Return a waveform for each input in `scales` [V/division], all of the same time.

        A first error is logged as a warning; the oscilloscope is cleared, and captures once more.
        """
        try:
            return self._capture(scales)
        except LinkError as error:
            logger.warning("%s: %s; it is cleared, and captures once more", self.identity, error)
        self._port.recover()
        self._scales.clear()  # a scale that was under way may be lost
        return self._capture(scales)

    def close(self) -> None:
        """Release the oscilloscope."""
        self._port.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _capture(self, scales: Mapping[int, float]) -> list[Waveform]:
        for number, scale in scales.items():
            if self._scales.get(number) != scale:
                self._port.tell(_SCALE.format(input=number, scale=scale))
                self._scales[number] = scale
        for command in self._dialect.capture:
            self._port.tell(command)
        deadline = time.monotonic() + _CAPTURE_TIME
        while (status := self._port.ask(self._dialect.status)) != self._dialect.ready:
            if time.monotonic() > deadline:
                raise LinkError(f"{self.identity}: no capture within {_CAPTURE_TIME:g} s, status {status!r}")
            time.sleep(0.01)
        return [self._waveform(number) for number in scales]

    def _waveform(self, number: int) -> Waveform:
        self._port.tell(_SOURCE.format(input=number))
        return self._dialect.waveform(self._port.ask(_PREAMBLE), self._port.ask_block(_SAMPLES))


def open_scope(
    chip: tuple[int, int], dialect: Dialect = KEYSIGHT, serial: str | None = None, backend: Any = None
) -> Oscilloscope:
    """Find an oscilloscope on USB.

    Args:
        chip: idVendor and idProduct, as ``lsusb`` shows them.
        dialect: commands of its maker.
        serial: serial number, where several such are plugged in.
        backend: backend of pyusb; by default libusb. An emulated bench has one in `bus`.

    Raises:
        ValueError: `chip` is not two numbers.
        LinkError: none or several such devices, or it does not answer.
    """
    vendor, product = positive_integers("chip", chip, 2)
    port = UsbtmcPort(find_device([(vendor, product)], serial, backend))
    with closed_on_error(port.close):
        return Oscilloscope(port, dialect)
