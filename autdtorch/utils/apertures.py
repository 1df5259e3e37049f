"""Points and discs that radiate or receive: the monopoles that stand for them, and the far field of discs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
import torch

from autdtorch.utils.array_types import COMPLEX, REAL, AnyArray, Array
from autdtorch.utils.images import Image, distinct

PATTERN_TERMS = 13
"""Powers of the square of the sine of an angle in a far-field pattern."""

_ORDERS = 4  # of the expansion in 1 / r
_LARGEST = 6.0  # k a of the largest discs: the first power that is left out is below 1e-7 of the axis
# A disc is far at so many radii and where k a^2 / 2r is at most this: the orders that are left out are below
# 3e-5 of the pressure on the axis
_FAR_RADII, _FAR_PHASE = 10.0, 0.14
_RINGS, _RING_NODES = 5, 16  # of the monopoles that stand for a disc


class Apertures(NamedTuple):
    """N sources or receivers with n monopoles each, in float64."""

    positions: torch.Tensor  # of the monopoles (N, n, 3) [m]
    weights: torch.Tensor  # (n,), with the sum 1
    normals: torch.Tensor | None = None  # of discs (N, 3)
    radii: torch.Tensor | None = None  # of discs (N,) [m]

    @classmethod
    def of_points(cls, points: torch.Tensor) -> Self:
        """Return points (P, 3) as sources or receivers."""
        return cls(points[:, None], torch.ones(1, **REAL))

    def chosen(self, index: slice | torch.Tensor) -> Self:
        """Return some of the sources or receivers."""
        normals, radii = (None if part is None else part[index] for part in (self.normals, self.radii))
        return self._replace(positions=self.positions[index], normals=normals, radii=radii)

    def alike(self) -> list[torch.Tensor]:
        """Return the indices (n,) of the discs of each direction and radius; points are all alike."""
        if self.normals is None or self.radii is None:
            return [torch.arange(len(self.positions), dtype=torch.int64, device="cpu")]
        kinds = torch.cat([self.normals, self.radii[:, None]], dim=1)
        _, kind = torch.unique(kinds, dim=0, return_inverse=True)
        return [torch.nonzero(kind == number)[:, 0] for number in range(int(kind.max()) + 1)]

    def with_images(self, images: Sequence[Image]) -> tuple[Self, torch.Tensor]:
        """Return all images of the apertures, one image after the other, and their weights (G N,)."""
        parts = distinct(images, self.positions)
        turned = (
            None if self.normals is None else torch.cat([self.normals @ each.matrix.mT for each in parts])
        )
        positions = torch.cat([image.of(self.positions) for image in parts])
        radii = None if self.radii is None else self.radii.repeat(len(parts))
        weights = torch.tensor([complex(image.weight) for image in parts], **COMPLEX)
        return self._replace(positions=positions, normals=turned, radii=radii), weights.repeat_interleave(
            len(self.positions)
        )

    @property
    def discs(self) -> Discs:
        """The discs that the monopoles stand for."""
        assert self.normals is not None
        assert self.radii is not None
        return Discs(self.positions.mean(dim=1), self.normals, self.radii)

    def far_from(self, points: torch.Tensor, wavenumber: complex) -> torch.Tensor:
        """Return which of them (N,) are discs far enough from all points (P, 3) for `Discs.pattern`."""
        if self.radii is None or len(points) == 0:
            return torch.zeros(len(self.positions), dtype=torch.bool, device="cpu")
        center, size = self.positions.mean(dim=1), abs(wavenumber) * self.radii
        beyond = torch.maximum(points.amin(dim=0) - center, center - points.amax(dim=0)).clamp(min=0)
        least = self.radii * (size / (2 * _FAR_PHASE)).clamp(min=_FAR_RADII)
        return torch.gt(beyond.norm(dim=1), least) & (size <= _LARGEST)


class Discs(NamedTuple):
    """Discs with a constant velocity, or that receive the mean pressure."""

    centers: torch.Tensor  # (N, 3) [m]
    normals: torch.Tensor  # (N, 3)
    radii: torch.Tensor  # (N,) [m]

    def of_equal_radius(self) -> Iterator[tuple[torch.Tensor, Self]]:
        """Yield the indices (n,) of the discs of each radius, and these discs."""
        for radius in np.unique(self.radii.numpy()):
            index = torch.nonzero(self.radii == radius)[:, 0]
            yield index, type(self)(*(part[index] for part in self))

    def pattern(self, wavenumber: complex) -> Array:
        """Return the factor on e^{i k r} / r far from discs of equal radius, with parts (orders, 2, terms).

        It is a polynomial in 1 / r and in u, the square of the sine of the angle from the normal. Order zero
        is 2 J1(v) / v with v^2 = (k a)^2 u. The recursion of Atkinson (1949) and Wilcox (1956) gives order n,
        2 i k n F_n = n (n - 1) F_(n-1) + B F_(n-1). B is the Laplacian on the sphere.
        """
        power = np.arange(PATTERN_TERMS, dtype=np.float64)
        factor = -((wavenumber * float(self.radii[0])) ** 2) / 4
        orders: list[AnyArray] = [
            np.cumprod(np.concatenate(([1.0 + 0j], factor / (power[1:] * (power[1:] + 1)))))
        ]
        for order in range(1, _ORDERS):
            laplacian = -2 * power * (2 * power + 1) * orders[-1]
            laplacian[:-1] += 4 * power[1:] ** 2 * orders[-1][1:]
            orders.append((order * (order - 1) * orders[-1] + laplacian) / (2j * wavenumber * order))
        return np.stack((np.real(orders), np.imag(orders)), axis=1)


def disc_rule() -> tuple[torch.Tensor, torch.Tensor]:
    """Return nodes (n, 2) and weights (n,) of a quadrature rule for the mean over the unit disc."""
    abscissa, weights = np.polynomial.legendre.leggauss(_RINGS)
    radius = np.sqrt((abscissa + 1) / 2)[:, None]
    ring, step = np.indices((_RINGS, _RING_NODES))
    angle = 2 * np.pi / _RING_NODES * (step + ring % 2 / 2)
    disc = np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=-1).reshape(-1, 2)
    return torch.from_numpy(disc), torch.from_numpy(np.repeat(weights / (2 * _RING_NODES), _RING_NODES))
