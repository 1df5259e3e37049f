"""The vertical scale of an oscilloscope's input, chosen anew where a waveform does not suit it."""

from __future__ import annotations

from dataclasses import dataclass

from autdtorch.hardware.sensors.scpi import Waveform

_DIVISIONS = 3.5  # of a full screen, above and below the middle; there are 4 or more
_QUIET = 0.25  # of a full screen: what fills less is put on a finer scale,
_TARGET = 0.5  # so that it fills this much
_COARSER = 4.0  # what clips here fills a quarter or more there, and so stays there


@dataclass(frozen=True)
class VerticalScale:
    """Volts per division, between two bounds.

    From a quarter of the screen to the whole it stays as it is, and what was changed is in the middle of
    that: a sound as loud as the last, or twice or half as loud, needs no change.

    Attributes:
        now: the scale [V/division].
        finest: of the oscilloscope [V/division].
        coarsest: that the loudest sound needs [V/division].
    """

    now: float
    finest: float
    coarsest: float

    @classmethod
    def up_to(cls, volts: float, finest: float) -> VerticalScale:
        """The coarsest scale, on which an amplitude of `volts` [V] fills the screen."""
        coarsest = volts / _DIVISIONS
        return cls(coarsest, finest, coarsest)

    def fitted(self, waveform: Waveform, noise: float) -> VerticalScale:
        """A scale that suits what was captured on this one; this one, if it does or no other may be.

        Args:
            waveform: captured on this scale.
            noise: its rms [V]. Where that is a step of the converter or more, no scale is finer: rounding
                then adds 1/12 to the noise's variance at most, and no bias.
        """
        peak = float(waveform.volts.abs().max()) + waveform.resolution
        wanted = self.now
        if waveform.clipped:
            wanted *= _COARSER
        elif peak < _QUIET * _DIVISIONS * self.now and noise < waveform.resolution:
            wanted = peak / (_TARGET * _DIVISIONS)
        return VerticalScale(min(max(wanted, self.finest), self.coarsest), self.finest, self.coarsest)
