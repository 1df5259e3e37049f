"""A lock-in: the component of a sampled signal at one frequency."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import invalid


class Fit(NamedTuple):
    """A sine fitted to a signal: p (...,) of Re(p e^{-i w t}), t = 0 at the first sample; rms of the rest."""

    phasor: torch.Tensor
    residual: torch.Tensor


class LockIn:
    """A fit of an offset and a sine of known frequency: least squares, weighted by a Hann window.

    Offset and sine are found exactly for any number of periods. The window suppresses hum, slow drift and
    harmonics, which disturb a plain fit where that number is not whole. White noise causes an error sqrt(3/2)
    times the lowest bound of unbiased estimates (Rife and Boorstyn 1974, doi:10.1109/TIT.1974.1055282).

    White noise of variance s^2 in every sample puts an error of E|e|^2 = `noise_gain` s^2 on the phasor: 6
    over the number of samples, if they hold many periods.
    """

    def __init__(self, frequency: float, step: float, samples: int) -> None:
        """Prepare the fit of a sine of a `frequency` [Hz] to S `samples`, a time `step` [s] apart.

        `ValueError` for less than two periods, or two samples a period or fewer.
        """
        cycles = frequency * step
        if cycles >= 0.5:
            raise invalid("step", step, f"must be < {0.5 / frequency:g}, half a period", "s")
        if cycles * samples < 2:
            raise invalid("samples", samples, f"must be >= {math.ceil(2 / cycles)}, two periods")
        places = torch.arange(samples, **REAL)
        angle = 2 * math.pi * cycles * places
        window = (math.pi * (places + 0.5) / samples).sin().square()
        self._basis = torch.stack([torch.ones_like(angle), angle.cos(), angle.sin()])
        weighted = self._basis * window
        self._fit = torch.linalg.solve(weighted @ self._basis.T, weighted)
        self.noise_gain = float(self._fit[1:].square().sum())

    def __call__(self, signal: torch.Tensor) -> Fit:
        """Return the fits to signals (..., S)."""
        coefficients = signal.to(torch.float64) @ self._fit.T
        rest = signal - coefficients @ self._basis
        residual = (rest.square().sum(dim=-1) / (rest.shape[-1] - len(self._basis))).sqrt()
        return Fit(torch.complex(coefficients[..., 1], coefficients[..., 2]), residual)
