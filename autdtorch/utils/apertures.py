"""Points and discs that radiate or receive: the monopoles that stand for them, and the waves of discs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Self

import numpy as np
import torch

from autdtorch.utils.array_types import COMPLEX, REAL, Array, ComplexArray, Index
from autdtorch.utils.mirror_images import Image, distinct
from autdtorch.utils.process import cached_tensors

TOGETHER = 3
"""Degrees of the waves of a disc that are summed at once."""

_ERROR = 1e-8
"""Limit for the waves of a disc that are left out, in all, relative to a point of its strength."""

_REACH, _REACHES = 1.5, 20
"""Least distance of these waves, in radii, and the number of distances by factors of 2^(1/4)."""

_POINT = 1e-8
"""k a of discs that are points, of less than 1e-10 of a wavelength."""

RIM_DIGITS, RIM_TURNS, RIM_STRIP, RIM_LEAST = 20.0, 1.2, 2.164, 1e-5
"""Rule for the integral along a rim. The first number is -log of its error, the second the growth of a wave
in the complex plane with k a [rad], the third coth(1 / 2). The last one is the least ratio of the distances
to the nearest and the farthest point of the rim."""

_LEAST = 1e-290
"""Least scale of a wave of a high degree; smaller ones of the smallest discs count as 0."""

_RINGS, _RING_NODES = 5, 16
"""Rings of the monopoles that stand for a disc on a grid, and monopoles of each, up to k a = 6."""


class Apertures(NamedTuple):
    """N sources or receivers, points or discs, in float64."""

    centers: torch.Tensor  # (N, 3) [m]
    axes: torch.Tensor | None = None  # of discs (N, 3, 3), one a row: two in the plane and the normal
    radii: torch.Tensor | None = None  # of discs (N,) [m]
    size: float = 0.0  # k a of the largest disc

    @property
    def positions(self) -> torch.Tensor:
        """The positions (N, n, 3) [m] of monopoles that stand for each, one for a point."""
        if self.axes is None or self.radii is None:
            return self.centers[:, None]
        return self.centers[:, None] + self.radii[:, None, None] * disc_rule(self.size)[0] @ self.axes[:, :2]

    @property
    def weights(self) -> torch.Tensor:
        """The weights (n,) of the monopoles, with the sum 1."""
        return torch.ones(1, **REAL) if self.axes is None else disc_rule(self.size)[1].clone()

    def chosen(self, index: slice | torch.Tensor) -> Self:
        """Return some of the sources or receivers."""
        axes, radii = (None if part is None else part[index] for part in (self.axes, self.radii))
        return self._replace(centers=self.centers[index], axes=axes, radii=radii)

    def singly(self, numbers: Iterable[int]) -> list[Self]:
        """Return one of these for each number, with that source alone."""
        return [self.chosen(slice(number, number + 1)) for number in numbers]

    def loudest(self, points: torch.Tensor, strength: torch.Tensor, nearest: float) -> float:
        """Return the norm of the free-space pressure [Pa] at points (P, 3), as if no sources cancelled.

        Strengths (N,) are in Pa m; distances below `nearest` [m] count as that.
        """
        distance = torch.cdist(points, self.centers).clamp(min=nearest)
        return float((strength.abs() / distance).norm())

    def with_images(self, images: Sequence[Image]) -> tuple[Self, torch.Tensor]:
        """Return all images of the apertures, one image after the other, and their weights (G N,)."""
        spanning = self.centers
        if self.axes is not None and self.radii is not None:
            rims = self.centers[:, None] + self.radii[:, None, None] * self.axes[:, :2]
            spanning = torch.cat([self.centers, rims.flatten(0, 1)])
        parts = distinct(images, spanning)
        axes = None if self.axes is None else torch.cat([self.axes @ each.matrix.mT for each in parts])
        radii = None if self.radii is None else self.radii.repeat(len(parts))
        weights = torch.tensor([complex(image.weight) for image in parts], **COMPLEX)
        everything = self._replace(
            centers=torch.cat([image.of(self.centers) for image in parts]), axes=axes, radii=radii
        )
        return everything, weights.repeat_interleave(len(self.centers))

    @property
    def places(self) -> torch.Tensor | Discs:
        """The points (N, 3), or the discs."""
        if self.axes is None or self.radii is None:
            return self.centers
        return Discs(self.centers, self.axes[:, 2], self.radii)


class Discs(NamedTuple):
    """Discs with a constant velocity, or that receive the mean pressure."""

    centers: torch.Tensor  # (N, 3) [m]
    normals: torch.Tensor  # (N, 3)
    radii: torch.Tensor  # (N,) [m]

    def kinds(self) -> tuple[tuple[float, ...], Index]:
        """Return the radii, each once, and the number of its radius among them for each disc (N,)."""
        radii, kind = np.unique(np.array(self.radii.tolist()), return_inverse=True)
        return tuple(radii.tolist()), kind.reshape(-1)


def centers_of(places: torch.Tensor | Discs) -> torch.Tensor:
    """Return points (N, 3) [m], or the centres of discs."""
    return places.centers if isinstance(places, Discs) else places


def image_of(places: torch.Tensor | Discs, image: Image) -> torch.Tensor | Discs:
    """Return the image of points (N, 3) or discs."""
    if not isinstance(places, Discs):
        return image.of(places)
    return places._replace(centers=image.of(places.centers), normals=places.normals @ image.matrix.mT)


class EvenWaves(NamedTuple):
    """The mean of e^{ikR} / R over a disc as outgoing waves: e^{ikr} / r sum_n c_n H_n P_2n(cos t).

    The angle from the normal is t. With v = 1 / r^2, waves follow from the two before, degree by degree:
    H_(n+1) = (alpha v - beta) H_n - gamma H_(n-1) and P_2(n+1) = (A cos^2 t - B) P_2n - C P_2(n-1). They
    begin with H_(-1) = -1 - i / kr and H_0 = P_0 = 1.
    """

    first: ComplexArray  # c_0 of discs of several radii (R,)
    steps: Array  # Re alpha, Im alpha, beta, gamma, A, B, C, Re c_(n+1), Im c_(n+1), by n (R, N, 9)
    reaches: Array  # distances (R, K) [m]; nearer than the first the series is slow
    counts: Index  # numbers of steps that suffice from each distance on (R, K)


@cached_tensors(64)
def even_waves(wavenumber: complex, radii: tuple[float, ...]) -> EvenWaves:
    """Return the waves of discs of radii a [m]; very small ones are points, of one wave.

    With spherical Bessel functions, c_n h_2n = (4n + 1) P_2n(0) 2 / a^2 int_0^a j_2n(ks) s ds h_2n(kr) up to
    e^{ikr} / r (Stenzel 1935). With x = ka and I_l = int_0^x j_l(t) t dt,
    (l + 1) I_(l-1) = (2l + 1) x j_l(x) + l I_(l+1). High degrees fall as (a / r)^2n. H_n are h_2n of size 1
    at the least distance.
    """
    from scipy.special import eval_legendre, spherical_jn

    radius = np.array(radii)
    is_point = abs(wavenumber) * radius < _POINT
    size = wavenumber * np.where(is_point, 1 / abs(wavenumber), radius)
    count = TOGETHER * math.ceil((float(abs(size).max()) / 2 + 24) / TOGETHER)
    degrees = 2 * np.arange(count + 1)
    means = np.zeros((count + 21, len(radii)), np.complex128)
    for n in range(count + 19, -1, -1):
        odd = 2 * n + 1
        means[n] = ((2 * odd + 1) * size * spherical_jn(odd, size) + odd * means[n + 1]) / (odd + 1)
    l = 2.0 * np.arange(count)  # noqa: E741 - the degree in the formulas
    alpha, gamma = (2 * l + 1) * (2 * l + 3), (2 * l + 3) / (2 * l - 1)
    a = alpha / ((l + 1) * (l + 2))
    b = a * ((l + 1) ** 2 / alpha + l**2 / ((2 * l + 1) * (2 * l - 1)))
    c = a * l * (l - 1) / ((2 * l + 1) * (2 * l - 1))
    stretch = _REACH * 2 ** (np.arange(_REACHES) / 4)
    nearness = 1 / (size[:, None] * stretch)
    scales, sizes = [np.ones((len(radii), 1))], [np.ones(nearness.shape)]
    before, wave = -1 - 1j * nearness, 1 + 0j * nearness
    for n in range(count):
        after = (alpha[n] * nearness**2 - 1 - gamma[n]) * wave - scales[-1] * gamma[n] * before
        scales.append(1 / abs(after[:, :1]))
        before, wave = wave, scales[-1] * after
        sizes.append(abs(wave))
    scale = np.concatenate(scales, axis=1)
    means = (2 / size**2 * means[: count + 1]).T
    total = np.cumprod(scale, axis=1)
    means = means * np.divide(1, total, out=np.zeros_like(total), where=total > _LEAST)
    amplitude = (2 * degrees + 1) * eval_legendre(degrees, 0.0) * means
    terms = abs(amplitude).T[:, :, None] * np.array(sizes)
    left_out = np.cumsum(terms[:0:-1], axis=0)[::-1]
    counts = TOGETHER * np.ceil((left_out > _ERROR).sum(axis=0) / TOGETHER)
    alpha = scale[:, 1:] * alpha / wavenumber**2
    beta, gamma = scale[:, 1:] * (1 + gamma), scale[:, 1:] * scale[:, :-1] * gamma
    parts = alpha.real, alpha.imag, beta, gamma, a, b, c, amplitude[:, 1:].real, amplitude[:, 1:].imag
    steps = np.stack(np.broadcast_arrays(*parts), axis=2)
    radius = np.where(is_point, 0, radius)
    return EvenWaves(
        np.where(is_point, 1, amplitude[:, 0]),
        np.where(is_point[:, None, None], 0, steps),
        radius[:, None] * stretch,
        np.where(is_point[:, None], 0, counts).astype(np.int64),
    )


@cached_tensors(64)
def disc_rule(size: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return nodes (n, 2) and weights (n,) of a quadrature rule for the mean over the unit disc.

    For waves of k a up to `size` the error is 1e-6 at most.
    """
    rings, count = max(_RINGS, math.ceil(size / 3 + 3)), max(_RING_NODES, 2 * math.ceil(0.75 * size + 3.5))
    abscissa, weights = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt((abscissa + 1) / 2)[:, None]
    ring, step = np.indices((rings, count))
    angle = 2 * np.pi / count * (step + ring % 2 / 2)
    disc = np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=-1).reshape(-1, 2)
    return torch.from_numpy(disc), torch.from_numpy(np.repeat(weights / (2 * count), count))
