"""Distances between points, and nearest neighbours."""

from __future__ import annotations

import torch

from autdtorch.utils.validation import LENGTH_TOLERANCE


def distances(points: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Return the distances (P, M) [m] between `points` (P, 3) and `others` (M, 3)."""
    # By default cdist expands the square, which loses half the digits of short distances.
    return torch.cdist(points, others, compute_mode="donot_use_mm_for_euclid_dist")


def nearest(points: torch.Tensor, others: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the distance (P,) [m] of points (P, 3) to the nearest of `others` (M, 3), and its index (P,)."""
    from scipy.spatial import KDTree

    apart, index = KDTree(others.numpy(force=True)).query(points.numpy(force=True))
    return torch.from_numpy(apart), torch.from_numpy(index)


def nearest_other(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the distance (P,) [m] of P >= 2 points (P, 3) to their nearest others, and the indices (P,)."""
    from scipy.spatial import KDTree

    places = points.numpy(force=True)
    apart, index = (torch.from_numpy(found) for found in KDTree(places).query(places, k=2))
    itself = index[:, 0] == torch.arange(len(points), device="cpu")  # a coincident point may come first
    return apart[:, 1], torch.where(itself, index[:, 1], index[:, 0])


def require_distinct(name: str, points: torch.Tensor) -> None:
    """Check that no two of the `points` (P, 3) [m] coincide."""
    if len(points) < 2:
        return
    apart, other = nearest_other(points)
    first = int(apart.argmin())
    if apart[first] < LENGTH_TOLERANCE:
        raise ValueError(
            f"{name}: points {first} and {int(other[first])} coincide at {tuple(points[first].tolist())} m; "
            f"they must be at least {LENGTH_TOLERANCE:g} m apart"
        )
