"""The field of point sources and discs in free space, exact."""

from __future__ import annotations

import math

import torch

from autdtorch.array import TransducerArray
from autdtorch.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    distances,
    not_negative,
    points_tensor,
    positive,
)

_PAIRS_AT_ONCE = 100_000
"""Pairs of a point and a source that are worked on at once: they stay in the processor's cache."""


def green(points: ArrayLike, sources: ArrayLike, wavenumber: complex) -> torch.Tensor:
    """Green's function of the Helmholtz equation, outgoing with e^{-i w t}: e^{i k r} / (4 pi r).

    Args:
        points: (P, 3) [m].
        sources: (M, 3) [m].
        wavenumber: k [rad/m], > 0, or k + i alpha with an attenuation alpha >= 0 [Np/m].

    Returns:
        complex128 (P, M) [1/m], on the device of `points`; not differentiable in the positions.

    Raises:
        ValueError: not finite, wrong shape, k <= 0, alpha < 0, or a point on a source.
    """
    targets = points_tensor("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    k, alpha = _wavenumber(wavenumber)
    r = distances(targets, origins)
    if r.min() < LENGTH_TOLERANCE:
        point, source = divmod(int(r.argmin()), len(origins))
        raise ValueError(
            f"points[{point}]: {tuple(targets[point].tolist())} m; lies on source {source}, "
            f"must be at least {LENGTH_TOLERANCE:g} m away"
        )
    return torch.polar(torch.exp(-alpha * r) / (4 * math.pi * r), k * r)


def free_space_matrix(points: ArrayLike, array: TransducerArray, wavenumber: complex) -> torch.Tensor:
    """Transfer matrix of an array in free space: S e^{i k r} / r (Eq. 2), the mean of it over discs.

    Args:
        points: (P, 3) [m].
        array: the M transducers, of source strength S; the mean is taken over `array.nodes`.
        wavenumber: k [rad/m], > 0, or k + i alpha with an attenuation alpha >= 0 [Np/m].

    Returns:
        complex128 (P, M), pressure [Pa] per unit drive.

    Raises:
        ValueError: not finite, wrong shape, k <= 0, alpha < 0, or a point on a node of a transducer.
    """
    positions, weights = array.nodes
    # Node by node: memory for one matrix only.
    terms = (w * green(points, at, wavenumber) for at, w in zip(positions.unbind(1), weights, strict=True))
    return 4 * math.pi * array.source_strength * sum(terms, start=torch.zeros(()))


def superposition(
    points: torch.Tensor,
    sources: torch.Tensor,
    amplitude: torch.Tensor,
    wavenumber: complex,
    nearest: float = 0.0,
    dtype: torch.dtype = torch.float64,
) -> torch.Tensor:
    """Fields of many point sources: sums of amplitude e^{i k r} / r. Any number of fields costs little more.

    Distances and whole turns of the phase are in double precision, the rest in `dtype`: with float32 a pair
    takes half the time, and each wave is good to 5e-7.

    Args:
        points: (P, 3) [m].
        sources: (N, 3) [m].
        amplitude: complex (N, R) [Pa m] of R fields.
        wavenumber: k + i alpha [rad/m].
        nearest: distances below this are taken as that [m].
        dtype: float64 or float32.

    Returns:
        complex128 (P, R) [Pa].
    """
    if not (len(points) and len(sources)):
        return torch.zeros((len(points), amplitude.shape[1]), dtype=torch.complex128)
    middle = sources.mean(dim=0)
    points, sources = points - middle, sources - middle
    # r^2 = |p|^2 - 2 p.s + |s|^2, as one product: good to 1e-12 at a hundredth of the largest distance
    one = torch.ones((len(points), 1), dtype=torch.float64)
    left = torch.cat((points, one, points.square().sum(dim=1, keepdim=True)), dim=1)
    one = torch.ones((len(sources), 1), dtype=torch.float64)
    right = torch.cat((-2 * sources, sources.square().sum(dim=1, keepdim=True), one), dim=1).mT.contiguous()
    both = torch.cat((amplitude.real, amplitude.imag), dim=1).to(dtype)
    parts = []
    for some in torch.split(left, max(1, _PAIRS_AT_ONCE // len(sources))):
        r = (some @ right).clamp_(min=max(nearest, LENGTH_TOLERANCE) ** 2).sqrt_()
        size = r.to(dtype).reciprocal()
        if wavenumber.imag:
            size *= torch.exp(-wavenumber.imag * r.to(dtype))
        r *= wavenumber.real / (2 * math.pi)
        r -= r.round()
        phase = r.to(dtype).mul_(2 * math.pi)
        real, imaginary = (phase.cos().mul_(size) @ both).double(), (phase.sin_().mul_(size) @ both).double()
        (rr, ri), (ir, ii) = real.chunk(2, dim=1), imaginary.chunk(2, dim=1)
        parts.append(torch.complex(rr - ii, ri + ir))
    return torch.cat(parts)


def _wavenumber(value: complex) -> tuple[float, float]:
    """Wavenumber k and attenuation alpha of a complex wavenumber."""
    if not isinstance(value, complex):
        return positive("wavenumber", value, "rad/m"), 0.0
    return positive("wavenumber.real", value.real, "rad/m"), not_negative(
        "wavenumber.imag", value.imag, "Np/m"
    )
