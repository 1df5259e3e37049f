"""The field of point sources in free space, exact."""

from __future__ import annotations

import math

import torch

from autdtorch.array import TransducerArray
from autdtorch.validation import LENGTH_TOLERANCE, ArrayLike, distances, points_tensor, positive


def green(points: ArrayLike, sources: ArrayLike, wavenumber: float) -> torch.Tensor:
    """Green's function of the Helmholtz equation, outgoing with e^{-i w t}: e^{i k r} / (4 pi r).

    Args:
        points: (P, 3) [m].
        sources: (M, 3) [m].
        wavenumber: k [rad/m], > 0.

    Returns:
        complex128 (P, M) [1/m], on the device of `points`; not differentiable in the positions.

    Raises:
        ValueError: not finite, wrong shape, a wavenumber <= 0, or a point on a source.
    """
    targets = points_tensor("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    wavenumber = positive("wavenumber", wavenumber, "rad/m")
    r = distances(targets, origins)
    if r.min() < LENGTH_TOLERANCE:
        point, source = divmod(int(r.argmin()), len(origins))
        raise ValueError(
            f"points[{point}]: {tuple(targets[point].tolist())} m; lies on source {source}, "
            f"must be at least {LENGTH_TOLERANCE:g} m away"
        )
    return torch.polar(1 / (4 * math.pi * r), wavenumber * r)


def free_space_matrix(points: ArrayLike, array: TransducerArray, wavenumber: float) -> torch.Tensor:
    """Transfer matrix of an array of point sources in free space: S e^{i k r} / r (Eq. 2).

    Args:
        points: (P, 3) [m].
        array: the M transducers; S is its source strength. Point sources have no use for its normals.
        wavenumber: k [rad/m], > 0.

    Returns:
        complex128 (P, M): pressure [Pa] per unit drive.

    Raises:
        ValueError: not finite, wrong shape, a wavenumber <= 0, or a point on a transducer.
    """
    return 4 * math.pi * array.source_strength * green(points, array.positions, wavenumber)
