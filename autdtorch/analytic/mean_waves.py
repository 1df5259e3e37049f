"""The means of outgoing waves over the discs of an array, as a body's T-matrix takes them.

The mean of a solution of the Helmholtz equation over a disc of radius a with the normal n is, at its centre,
a power series of an operator:

    2 J1(v) / v f,   v^2 = a^2 (k^2 + d^2/dn^2).

The derivative of a wave along z is two waves of neighbouring degrees (Martin, Multiple Scattering (2006),
section 3.7). So the mean is a sum of waves of the same order and of up to twice as many more degrees as
powers, in a frame with z along the normal.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
import torch

from autdtorch.analytic.spherical_waves import outgoing_waves, turned, turns
from autdtorch.scene.geometry import plane_basis
from autdtorch.utils.process import cached_tensors

_ERROR = 1e-10
"""Size of the first power that is left out, relative to the wave at the centre."""

_MOST_POWERS = 24


def powers_needed(degree: int, wavenumber: complex, distance: float, radius: float) -> int | None:
    """Return the powers of the series for waves up to a degree at a distance [m]; None if they are too many.

    Across the normal, waves oscillate with at most k or, of high degrees near the centre, degree / distance.
    """
    term = 1.0
    for power in range(1, _MOST_POWERS + 1):
        steepest = max(abs(wavenumber), (degree + 2 * power) / distance)
        term *= (radius * steepest / 2) ** 2 / (power * (power + 1))
        if term < _ERROR:
            return power
    return None


class MeanWaves(NamedTuple):
    """The means over M discs of h_l(kr) Y_lm^*, as products that are taken in the order that costs least.

    Attributes:
        waves: of more degrees at the centres (..., M, K), in a frame with z along the normal.
        means: for each order the places of its waves, those of their means, and the map from all to these.
        maps: of each degree's harmonics to those along the axes.
    """

    waves: torch.Tensor
    means: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
    maps: list[torch.Tensor]

    @classmethod
    def of(
        cls,
        degree: int,
        wavenumber: complex,
        offsets: torch.Tensor,
        normal: torch.Tensor,
        radius: float,
        axes: torch.Tensor,
        powers: int,
    ) -> Self:
        """Return the means over discs of all waves up to a degree, differentiable.

        Args:
            degree: the largest l.
            wavenumber: k [rad/m].
            offsets: centres of the discs (..., M, 3) [m] from the centre of the waves.
            normal: of all discs (3,).
            radius: of all discs [m].
            axes: of the harmonics, columns (..., 3, 3).
            powers: of the series, see `powers_needed`.
        """
        frame = torch.stack([*plane_basis(normal), normal], dim=1)
        waves = outgoing_waves(degree + 2 * powers, wavenumber, offsets @ frame, conjugate=True)
        maps = [each.conj() for each in turns(degree, frame.mT @ axes)]
        return cls(waves, _means(degree, wavenumber * radius, powers), maps)

    @property
    def matrix(self) -> torch.Tensor:
        """The means (..., M, N)."""
        parts = [self.waves[..., source] @ mean for source, _, mean in self.means]
        place = torch.cat([target for _, target, _ in self.means]).argsort()
        return turned(torch.cat(parts, dim=-1)[..., place], self.maps)

    def driven(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the sums (..., R, N) of the means with the weights (..., R, M) of their discs."""
        return self._replace(waves=drive @ self.waves).matrix

    def weighted(self, weights: torch.Tensor) -> torch.Tensor:
        """Return the sums (..., P, M) of the means with weights (..., P, N)."""
        before = turned(weights, [each.mT for each in self.maps])
        parts = [before[..., target] @ mean.mT for _, target, mean in self.means]
        places = torch.cat([source for source, _, _ in self.means])
        none = weights.new_zeros((*before.shape[:-1], self.waves.shape[-1]))  # of higher orders
        return none.index_copy(-1, places, torch.cat(parts, dim=-1)) @ self.waves.mT


@cached_tensors(16)
def _means(degree: int, size: complex, powers: int) -> list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    result = []
    for least in range(degree + 1):
        every = np.arange(least, degree + 2 * powers + 1)
        upper = np.sqrt((every[1:] ** 2 - least**2) / (4.0 * every[1:] ** 2 - 1))
        slope = np.diag(upper, -1) - np.diag(upper, 1)  # d/dz of the waves of a degree, in a row
        step = -((size / 2) ** 2) * (np.eye(len(every)) + slope @ slope)
        term = total = np.eye(len(every), dtype=np.complex128)
        for power in range(1, powers + 1):
            term = term @ step / (power * (power + 1))
            total = total + term
        means = torch.from_numpy(total[: degree + 1 - least].T.copy())
        for order in {least, -least}:
            places = torch.from_numpy(every**2 + every + order)
            result.append((places, places[: means.shape[1]], means))
    return result
