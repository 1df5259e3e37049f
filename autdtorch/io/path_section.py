"""Paths of a focus as sections of configs: a circle, a line there and back, or lines between points."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from autdtorch.scene.geometry import circle_points, plane_basis, polyline_points
from autdtorch.scene.scene import Scene
from autdtorch.scene.sequence import LONGEST
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import (
    boolean,
    finite_vector,
    invalid,
    positive,
    require_known,
    require_one_of,
    unit_vector,
    within,
)


def path_points(where: str, section: Mapping[str, Any], scene: Scene, rate: float) -> torch.Tensor:
    """Return the points of a lap of the path of a section such as ``{type: circle, radius: 5e-3}``.

    Args:
        where: name of the section in messages.
        section: `type`, `frequency` [Hz] of laps, and the settings of the type. Without a place the path is
            around the middle of the control points, across the direction of the first transducer.
        scene: the scene.
        rate: points per second [Hz]; the frequency is rounded to a whole number of points a lap.

    Returns:
        Points (T, 3) [m].

    Raises:
        ValueError: an unknown type or setting, or a setting out of range.
    """
    kind = section.get("type")
    require_one_of(f"{where}.type", kind, _KINDS)
    keys, points = _KINDS[str(kind)]
    require_known(where, section, ("type", "frequency", *keys))
    frequency = positive(f"{where}.frequency", section.get("frequency"), "Hz")
    if not rate / LONGEST <= frequency <= rate / 2:
        accepted = f"must be in {rate / LONGEST:g} to {rate / 2:g}, for {LONGEST} to 2 points a lap"
        raise invalid(f"{where}.frequency", frequency, accepted, "Hz")
    with within(where):
        return points(scene, round(rate / frequency), *(section.get(key) for key in keys))


def _circle(scene: Scene, count: int, center: Any, radius: Any, normal: Any) -> torch.Tensor:
    across = scene.array.normals[0] if normal is None else normal
    return circle_points(_center(scene, center), radius, count, across)


def _line(scene: Scene, count: int, center: Any, length: Any, direction: Any) -> torch.Tensor:
    along = plane_basis(scene.array.normals[0])[0]
    if direction is not None:
        along = torch.tensor(unit_vector("direction", direction), **REAL)
    half = positive("length", length, "m") / 2 * along
    middle = _center(scene, center)
    return polyline_points(torch.stack([middle - half, middle + half]), count)


def _lines(scene: Scene, count: int, positions: Any, closed: Any) -> torch.Tensor:
    if positions is None:
        raise invalid("positions", None, "must be given, as [[0, 0, 0.1], [0, 0.01, 0.1]]")
    return polyline_points(positions, count, boolean("closed", closed))


def _center(scene: Scene, center: Any) -> torch.Tensor:
    if center is None:
        return scene.control_points.mean(dim=0)
    return torch.tensor(finite_vector("center", center), **REAL)


_KINDS: dict[str, tuple[tuple[str, ...], Callable[..., torch.Tensor]]] = {
    "circle": (("center", "radius", "normal"), _circle),
    "line": (("center", "length", "direction"), _line),
    "points": (("positions", "closed"), _lines),
}
