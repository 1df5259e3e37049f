"""Exact fields of point sources and discs in free space."""

from __future__ import annotations

import math

import torch

from autdtorch.scene.arrays import TransducerArray, strengths_of
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.memory import require_memory
from autdtorch.utils.spatial import distances
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    differentiable_points,
    invalid,
    not_negative,
    points_tensor,
    positive,
)

PAIR_BYTES = 80.0  # Memory for each entry of a transfer matrix while it is computed [bytes]


def green(points: ArrayLike, sources: ArrayLike, wavenumber: complex) -> torch.Tensor:
    """Return Green's function of the Helmholtz equation, e^{i k r} / (4 pi r), outgoing with e^{-i w t}.

    Args:
        points: (P, 3) [m].
        sources: (M, 3) [m].
        wavenumber: k [rad/m], > 0, or k + i alpha with an attenuation alpha >= 0 [Np/m].

    Returns:
        complex128 (P, M) [1/m], on the device of `points`, differentiable by them.

    Raises:
        ValueError: an argument is not finite or has another shape, k <= 0, alpha < 0, or a point on a source.
    """
    targets = differentiable_points("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    k, alpha = _wavenumber(wavenumber)
    r = distances(targets, origins)
    if r.detach().min() < LENGTH_TOLERANCE:
        point, source = divmod(int(r.argmin()), len(origins))
        accepted = f"lies on source {source}, must be at least {LENGTH_TOLERANCE:g} m away"
        raise invalid(f"points[{point}]", tuple(targets[point].tolist()), accepted, "m")
    return torch.polar(torch.exp(-alpha * r) / (4 * math.pi * r), k * r)


def free_space_matrix(points: ArrayLike, array: TransducerArray, wavenumber: complex) -> torch.Tensor:
    """Return the transfer matrix (P, M), complex128, of an array in free space: S e^{i k r} / r (Eq. 2).

    The mean over discs is that over `array.nodes`. Arguments and errors as for `green`; pressure [Pa] per
    unit drive.
    """
    positions, weights = array.nodes
    points = differentiable_points("points", points)
    require_memory("points", tuple(points.shape), PAIR_BYTES * len(points) * len(array))
    # node by node, with memory for one matrix only
    terms = (w * green(points, at, wavenumber) for at, w in zip(positions.unbind(1), weights, strict=True))
    none = torch.zeros((), **COMPLEX)
    return 4 * math.pi * strengths_of(array).to(points.device) * sum(terms, start=none)


def _wavenumber(value: complex) -> tuple[float, float]:
    """Return wavenumber k and attenuation alpha of a complex wavenumber."""
    if not isinstance(value, complex):
        return positive("wavenumber", value, "rad/m"), 0.0
    k = positive("wavenumber.real", value.real, "rad/m")
    return k, not_negative("wavenumber.imag", value.imag, "Np/m")
