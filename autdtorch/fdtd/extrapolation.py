"""Reduced rank extrapolation of sequences x_(n+1) = A x_n + b, and what rings in them.

It estimates the fixed point (Eddy 1979; Sidi 2017): the mean sum g_j x_j, with sum g_j = 1, of least residual
sum g_j (x_(j+1) - x_j). It removes the slowest modes first, such as resonances of cavities.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from autdtorch.fdtd.resonances import are_resonances, offsets_of, parts_of
from autdtorch.utils.array_types import REAL

MOST_FITTED = 2048
"""Most cells whose phasors decide the means."""

# Numbers of stored phasors that are summed at once: as many as the CPU's cache holds, and for a GPU more
_SUMMED, _SUMMED_ON_GPU = 2**15, 2**24
_ROUNDING = 1e-13  # Regularisation of the normal equations, relative to the mean square of the differences


class Extrapolation:
    """Reduced rank extrapolation of R sequences, from the last `most` values of each."""

    def __init__(self, most: int, single: bool = False) -> None:
        """Start empty sequences, whose values are stored in double or in `single` precision."""
        self._precision = torch.complex64 if single else torch.complex128
        self._most, self._count = most, 0
        # The stored values (n, R, k), and of cells that decide the means the last value (R, m), its steps
        # (R, n - 1, m) and their products (R, n - 1, n - 1); the oldest are overwritten
        self._values = self._last = self._steps = self._products = torch.empty(0, **REAL)

    def __len__(self) -> int:
        return min(self._count, self._most)

    def append(self, values: Tensor) -> None:
        """Append the next value (R, k) of each sequence."""
        fitted, number = values[:, :: -(-values.shape[1] // MOST_FITTED)].clone(), self._count
        if number == 0:
            runs, count = fitted.shape
            self._values = values.new_empty((self._most, *values.shape), dtype=self._precision)
            self._steps = values.new_empty((runs, self._most - 1, count))
            self._products = values.new_empty((runs, self._most - 1, self._most - 1))
        else:
            place, filled = (number - 1) % (self._most - 1), min(number, self._most - 1)
            self._steps[:, place] = step = fitted - self._last
            products = (self._steps[:, :filled] @ step.conj()[..., None])[..., 0]
            self._products[:, place, :filled], self._products[:, :filled, place] = products, products.conj()
        self._values[number % self._most] = values
        self._last, self._count = fitted, number + 1

    def choose(self, places: Tensor) -> None:
        """Go on with some of the sequences."""
        self._values, self._last = self._values[:, places], self._last[places]
        self._steps, self._products = self._steps[places], self._products[places]

    def limits(self, places: Tensor) -> Tensor:
        """Return the estimated limits (k, r) of some sequences, or last values while there are too few."""
        return self._combined(self._weights(places), places)

    def ringing(self, places: Tensor, interval: float) -> Iterator[tuple[complex, Tensor]]:
        """Yield what rings in some sequences, of values an `interval` apart [periods]; see `resonances`.

        That are the offset of each resonance near the drive, and its part (k, r) of the first values.
        """
        if len(self) < 2:
            return
        numbers = np.arange(self._count - len(self), self._count)
        steps = (numbers[1:] - 1) % (self._most - 1)
        products = self._products[places].sum(dim=0).cpu().numpy()[np.ix_(steps, steps)].conj()
        offsets = offsets_of(products, interval)
        weights = np.zeros((len(offsets), len(self)), np.complex128)
        weights[:, numbers % self._most] = parts_of(offsets, len(self), interval)
        for number in np.flatnonzero(are_resonances(offsets, products, interval)):
            same = torch.from_numpy(weights[number]).to(self._values.device).expand(len(places), -1)
            yield complex(offsets[number]), self._combined(same, places)

    def _combined(self, weights: Tensor, places: Tensor) -> Tensor:
        """Return the sums (k, r) of the stored values of some sequences by weights (r, n)."""
        values = self._values[: len(self)]
        sums = weights.new_empty((len(places), values.shape[2]))
        width = max(1, (_SUMMED if values.device.type == "cpu" else _SUMMED_ON_GPU) // len(values))
        for place, weight, whole in zip(places.tolist(), weights, sums, strict=True):
            parts = torch.split(values[:, place], width, dim=1), torch.split(whole, width)
            for part, target in zip(*parts, strict=True):
                target[:] = weight @ part.to(weight.dtype)
        return sums.mT

    def _weights(self, places: Tensor) -> Tensor:
        """Return the weights (r, n) of the stored values of some sequences in their limits."""
        steps = min(self._count, self._most) - 1
        products = self._products[places, :steps, :steps].cpu().numpy()
        size = np.trace(products, axis1=1, axis2=2).real / max(steps, 1)
        usable = np.flatnonzero((steps > 1) & np.isfinite(size) & (size > 0))
        regular = products[usable] + _ROUNDING * size[usable, None, None] * np.eye(steps)
        means = np.linalg.solve(regular, np.ones((len(usable), steps, 1)))[..., 0]
        means /= means.sum(axis=1, keepdims=True)
        weights = np.zeros((len(places), len(self)), np.complex128)
        weights[:, (self._count - 1) % self._most] = 1
        numbers = np.arange(self._count - steps, self._count)  # of values that have a step
        weights[np.ix_(usable, numbers % self._most)] = means[:, (numbers - 1) % (self._most - 1)]
        return torch.from_numpy(weights).to(self._values.device)
