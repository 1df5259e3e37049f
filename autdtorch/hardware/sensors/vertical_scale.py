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
    """The scale `now` [V/division], from the oscilloscope's `finest` to the `coarsest` for the loudest sound.

    A waveform keeps its scale if it fills a quarter of the screen or more, and fills half of it on a new one:
    a sound twice or half as loud as the last needs no change.
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
        """Return the scale for the next waveform, from one on this scale with noise of an rms [V].

        The scale is not made finer if the noise exceeds a step of the converter: rounding then adds at most
        1/12 to its variance, and no bias.
        """
        peak = float(waveform.volts.abs().max()) + waveform.resolution
        wanted = self.now
        if waveform.clipped:
            wanted *= _COARSER
        elif peak < _QUIET * _DIVISIONS * self.now and noise < waveform.resolution:
            wanted = peak / (_TARGET * _DIVISIONS)
        return VerticalScale(min(max(wanted, self.finest), self.coarsest), self.finest, self.coarsest)
