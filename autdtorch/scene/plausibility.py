"""Warnings of scenes that are possible, but seldom meant: lengths in mm, foci behind the array, other air."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch

from autdtorch.scene.obstacles import Mesh, Obstacle, VoxelMask
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import LENGTH_TOLERANCE

if TYPE_CHECKING:
    from autdtorch.scene.scene import Scene

_USUAL_EXTENT = 0.1, 2000.0  # [wavelengths] across array and control points
_USUAL_SIZE = 20.0  # [extents of array and control points] across everything, unless lengths are in mm
_LEAST_EXTENT = 15.0  # [wavelengths], for arrays and control points that are closer
_SAME_FREQUENCY = 0.01  # relative difference, for which the absorption changes by 2 %


def warn_of_implausible(scene: Scene, domain_is_given: bool) -> None:
    """Warn of units, foci behind the array and the air of another frequency."""
    extent = _observed_extent(scene)
    least, most = (bound * scene.wavelength for bound in _USUAL_EXTENT)
    if not least <= extent <= most:
        found = f"{extent:.4g} m from end to end of array and control points, but a wavelength of"
        ask = "are lengths in m and the frequency in Hz, 40 kHz as 40e3?"
        warn_user(f"Scene: {found} {scene.wavelength:.4g} m; {ask}")
    for name, hint in _too_large(scene, domain_is_given):
        warn_user(f"Scene.{name}{hint}")
    _warn_of_foci_behind(scene)
    known = scene.medium.absorption_frequency
    if known is not None and abs(known / scene.frequency - 1) > _SAME_FREQUENCY:
        fix = f"take Medium.air(..., frequency={scene.frequency:g})"
        warn_user(
            f"Scene.medium: its absorption is for {known:g} Hz, the scene has {scene.frequency:g} Hz; {fix}"
        )


def unit_hint(scene: Scene, obstacle: Obstacle) -> str:
    """Return what to do about an obstacle far larger or farther than the array and the foci; else nothing."""
    if not _is_far_larger(scene, obstacle.lower, obstacle.upper):
        return ""
    if isinstance(obstacle, Mesh):
        return "; take scale=1e-3 for a file in millimetres"
    if isinstance(obstacle, VoxelMask):
        return "; is its spacing in m, 1 mm as 1e-3?"
    return "; are its lengths in m, 16 mm as 16e-3?"


def extent_of(obstacle: Obstacle) -> str:
    """Return the corners of the bounding box as text, without rounding errors."""
    bounds = obstacle.lower, obstacle.upper
    low, high = (tuple(float(f"{entry:.9g}") for entry in corner) for corner in bounds)
    return f"{low} to {high} m"


def _too_large(scene: Scene, domain_is_given: bool) -> Iterator[tuple[str, str]]:
    """Yield names and descriptions of the parts that are far larger than array and control points."""
    for index, obstacle in enumerate(scene.obstacles):
        if hint := unit_hint(scene, obstacle):
            yield f"obstacles[{index}]", f": {type(obstacle).__name__} of {extent_of(obstacle)}{hint}"
    ask = "is it in m, 100 mm as 100e-3?"
    if (plane := scene.observation_plane) is not None:
        lower, upper = plane.corners.amin(dim=0), plane.corners.amax(dim=0)
        if _is_far_larger(scene, lower.tolist(), upper.tolist()):
            yield "observation_plane", f": of {plane.size} m around {plane.center} m; {ask}"
    if domain_is_given and _is_far_larger(scene, *scene.domain):
        yield "domain", f": {scene.domain[0]} to {scene.domain[1]} m; {ask}"


def _is_far_larger(
    scene: Scene, lower: list[float] | tuple[float, ...], upper: list[float] | tuple[float, ...]
) -> bool:
    """Return whether a box with these corners makes the scene far larger than array and control points."""
    points = _observed(scene)
    corners = torch.cat([points, points.new_tensor([lower, upper])])
    usual = max(_observed_extent(scene), _LEAST_EXTENT * scene.wavelength)
    return float((corners.amax(dim=0) - corners.amin(dim=0)).norm()) > _USUAL_SIZE * usual


def _observed(scene: Scene) -> torch.Tensor:
    return torch.cat([scene.array.positions, scene.control_points])


def _observed_extent(scene: Scene) -> float:
    """Return the diagonal [m] of the bounding box of array and control points."""
    points = _observed(scene)
    return float((points.amax(dim=0) - points.amin(dim=0)).norm())


def _warn_of_foci_behind(scene: Scene) -> None:
    """Warn where every control point lies behind every transducer; some may, as on a sphere around all."""
    array = scene.array
    ahead = scene.control_points @ array.normals.T - (array.normals * array.positions).sum(dim=1)
    if (ahead < -LENGTH_TOLERANCE).all():
        x, y, z = (f"{entry:.3g}" for entry in array.normals[0].tolist())
        lie = "all lie behind the array" if len(ahead) > 1 else "lies behind the array"
        warn_user(f"Scene.control_points: {lie}, whose normal is ({x}, {y}, {z}); turn it, or move the array")
