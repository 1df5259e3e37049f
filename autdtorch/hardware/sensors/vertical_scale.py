"""The vertical scale of an oscilloscope's input, adapted to the last waveform."""

from __future__ import annotations

from dataclasses import dataclass

from autdtorch.hardware.sensors.scpi import Waveform

_DIVISIONS = 3.5  # of a full screen, above and below the middle; there are 4 or more
_QUIET = 0.25  # share of the screen below which a waveform gets a finer scale
_TARGET = 0.5  # share that it then fills
_COARSER = 4.0  # a waveform that clips fills at least a quarter of a scale so much coarser


@dataclass(frozen=True)
class VerticalScale:
    """Volts per division, between two bounds.

    A waveform keeps its scale from a quarter of the screen to the whole, and a new scale has it at half: a
    sound as loud as the last, or twice or half as loud, needs no change.

    Attributes:
        now: the scale [V/division].
        finest: finest scale of the oscilloscope [V/division].
        coarsest: scale for the loudest sound [V/division].
    """

    now: float
    finest: float
    coarsest: float

    @classmethod
    def up_to(cls, volts: float, finest: float) -> VerticalScale:
        """Return the coarsest scale: an amplitude of `volts` [V] fills the screen."""
        coarsest = volts / _DIVISIONS
        return cls(coarsest, finest, coarsest)

    def fitted(self, waveform: Waveform, noise: float) -> VerticalScale:
        """Return the scale that suits a waveform on this one, with noise of an rms [V].

        From a step of the converter on, noise keeps the scale from being made finer: rounding then adds 1/12
        to the noise's variance at most, and no bias.
        """
        peak = float(waveform.volts.abs().max()) + waveform.resolution
        wanted = self.now
        if waveform.clipped:
            wanted *= _COARSER
        elif peak < _QUIET * _DIVISIONS * self.now and noise < waveform.resolution:
            wanted = peak / (_TARGET * _DIVISIONS)
        return VerticalScale(min(max(wanted, self.finest), self.coarsest), self.finest, self.coarsest)
