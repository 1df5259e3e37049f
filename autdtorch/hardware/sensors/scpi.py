"""SCPI commands of oscilloscopes by maker, and volts from their samples.

From the makers' programming guides; none was tried on a device.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from autdtorch.hardware.transport.port import LinkError

#: Finest vertical scale of both makers [V/division].
FINEST = 1e-3
#: Coarsest vertical scale that both makers have [V/division].
COARSEST = 5.0
#: Commands of both makers: of an input, with its vertical scale, and for its waveform.
SET_UP_INPUT = (
    ":CHANnel{input}:DISPlay ON",
    ":CHANnel{input}:PROBe 1",
    ":CHANnel{input}:COUPling AC",
    ":CHANnel{input}:OFFSet 0",
    ":CHANnel{input}:VERNier ON",  # else some scales would be rounded to 1, 2 or 5
)
SCALE = ":CHANnel{input}:SCALe {scale:.6g}"
SOURCE = ":WAVeform:SOURce CHANnel{input}"
#: Question for ten numbers: the fifth is the time step, the last are step, origin, reference of the voltage.
PREAMBLE = ":WAVeform:PREamble?"
#: Question for the samples, a byte each, as a definite-length block.
SAMPLES = ":WAVeform:DATA?"


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
            given = f"preamble {preamble[:80]!r} and {len(codes)} samples"
            raise LinkError(f"oscilloscope: {given} make no waveform")
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
