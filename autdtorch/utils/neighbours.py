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


def closest_pair(points: torch.Tensor) -> tuple[float, int, int]:
    """Return the least distance [m] between two of the points (P, 3), inf for one, and their indices."""
    from scipy.spatial import KDTree

    places = points.numpy(force=True)
    apart, index = KDTree(places).query(places, k=2)
    first = int(apart[:, 1].argmin())
    one, other = index[first].tolist()
    return float(apart[first, 1]), first, other if one == first else one  # a coincident point may come first


def require_distinct(name: str, points: torch.Tensor) -> None:
    """Check that no two of the `points` (P, 3) [m] coincide."""
    apart, first, other = closest_pair(points)
    if apart < LENGTH_TOLERANCE:
        place = tuple(points[first].tolist())
        raise ValueError(
            f"{name}: points {first} and {other} coincide at {place} m; "
            f"they must be at least {LENGTH_TOLERANCE:g} m apart"
        )
