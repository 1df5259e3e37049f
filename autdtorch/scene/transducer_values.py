"""Checks of what each transducer of an array has: strength, radius and direction of emission."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from autdtorch.scene.geometry import Coordinates
from autdtorch.utils.spatial import closest_pair
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    invalid,
    not_negative,
    real_tensor,
    unit_vector,
)


def for_each(
    name: str, values: ArrayLike, count: int, check: Callable[[str, object, str], float], unit: str
) -> float | torch.Tensor:
    """Return a checked number, or the checked numbers (count,) of each transducer if they differ."""
    if isinstance(values, str | bytes) or not (hasattr(values, "__len__") and getattr(values, "ndim", True)):
        return check(name, values, unit)
    each = real_tensor(name, values, unit).detach().cpu()
    if each.shape != (count,):
        raise ValueError(f"{name}: shape {tuple(each.shape)}; must be a number or ({count},) as positions")
    numbers = [check(f"{name}[{index}]", value, unit) for index, value in enumerate(each.tolist())]
    return numbers[0] if len(set(numbers)) == 1 else each.clone().as_subclass(Coordinates)


def disc_radius(values: ArrayLike | None, positions: torch.Tensor) -> float | torch.Tensor:
    """Return the radius or radii (M,) of discs, after checking that the discs at (M, 3) [m] are apart."""
    name = "TransducerArray.radius"
    radius = 0.0 if values is None else for_each(name, values, len(positions), not_negative, "m")
    if isinstance(radius, torch.Tensor):
        _require_apart(name, radius, positions)
    elif radius > 0:
        most = closest_pair(positions)[0] / 2
        if radius > most + LENGTH_TOLERANCE:
            raise invalid(name, radius, f"must be at most {most:.6g} m, half the distance of neighbours", "m")
    return radius


def _require_apart(name: str, radii: torch.Tensor, positions: torch.Tensor) -> None:
    """Refuse discs whose spheres overlap: each is compared with those that are not larger."""
    from scipy.spatial import KDTree

    places, each = positions.numpy(), radii.numpy()
    tree = KDTree(places)
    for index in np.flatnonzero(each):
        near = np.array(tree.query_ball_point(places[index], 2 * each[index]))
        apart = np.linalg.norm(places[near] - places[index], axis=1)
        over = (
            (near != index)
            & (each[near] <= each[index])
            & (each[near] + each[index] > apart + 2 * LENGTH_TOLERANCE)
        )
        if over.any():
            other, gap = int(near[over][0]), float(apart[over][0])
            accepted = (
                f"with that of transducer {other}, {each[other]:.6g} m, at most their distance, {gap:.6g} m"
            )
            raise invalid(f"{name}[{index}]", float(each[index]), f"must be {accepted}", "m")


def unit_normals(normals: ArrayLike, count: int) -> torch.Tensor:
    """Return directions (count, 3) of length 1 for one (3,) or one for each transducer."""
    name = "TransducerArray.normals"
    rows = real_tensor(name, normals).detach().cpu()
    if rows.shape == (3,):
        return rows.new_tensor(unit_vector(name, rows)).repeat(count, 1)
    if rows.shape != (count, 3):
        raise ValueError(f"{name}: shape {tuple(rows.shape)}; must be (3,) or ({count}, 3) as positions")
    scaled = rows.clone()
    unlike = ~((rows.norm(dim=1) - 1).abs() <= 2 * torch.finfo(torch.float64).eps)
    for m in unlike.nonzero()[:, 0].tolist():  # `unit_vector` returns the others as they are
        scaled[m] = rows.new_tensor(unit_vector(f"{name}[{m}]", rows[m]))
    return scaled
