"""The discrete phases and amplitudes of a device, and the nearest of them to a drive."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class PhaseLevels:
    """Phases, and perhaps amplitudes, that a device can emit.

    Level n of N phases emits a cos(w t - 2 pi n / N), so that n counts arg q = -phi. Focusing on distance d
    takes -k d. AUTD3's and Ultraino's `focus`, OpenMPD's solver and SonicSurface's `phasesForFocus` agree.

    Attributes:
        phases: number N of phases in [0, 2 pi), >= 2.
        amplitudes: level of amplitude 1, >= 1; None for continuous amplitudes.
        pulses: a level of amplitude is the duty of a pulse, in 1/N of a period; `amplitudes` is then N / 2.
            Duty d has the fundamental sin(pi d / N). The level of the phase is the start of the pulse.
    """

    phases: int
    amplitudes: int | None = None
    pulses: bool = False

    def nearest(self, drive: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the levels of phase and amplitude nearest to a drive (..., M) with |q| <= 1, not checked.

        Both are int64, a continuous amplitude float64. The phase level is 0 where the amplitude is 0.
        """
        wanted = drive.abs().clamp_max(1)  # above 1 by rounding alone
        if self.amplitudes is None:
            amplitude = wanted
        elif self.pulses:
            amplitude = (self.phases / math.pi * wanted.asin()).round().long()
        else:
            amplitude = (self.amplitudes * wanted + 0.5).long()
        phase = torch.remainder(-drive.angle(), 2 * math.pi)
        ahead = (phase / self._step - self._delay(amplitude)).round()
        return torch.where(amplitude > 0, -ahead.long() % self.phases, 0), amplitude

    def drive(self, phase: torch.Tensor, amplitude: torch.Tensor) -> torch.Tensor:
        """Return the drive (..., M), complex128, of levels as `nearest` gives them."""
        emitted = amplitude.double()
        if self.pulses:
            emitted = (math.pi / self.phases * emitted).sin()
        elif self.amplitudes is not None:
            emitted = emitted / self.amplitudes
        ahead = (-phase % self.phases).double() + self._delay(amplitude)
        return torch.polar(emitted, -(ahead * self._step))

    @property
    def _step(self) -> float:
        return 2 * math.pi / self.phases

    def _delay(self, amplitude: torch.Tensor) -> torch.Tensor | float:
        """Return the levels by which a pulse begins after one of half a period with the same centre."""
        return (self.phases / 2 - amplitude.double()) / 2 if self.pulses else 0.0
