"""Warnings of scenes that are possible, but seldom meant: lengths in mm, foci behind the array, other air."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch

from autdtorch.scene.arrays import radii_of
from autdtorch.scene.obstacles import Obstacle
from autdtorch.utils.spatial import closest_pair
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import LENGTH_TOLERANCE

if TYPE_CHECKING:
    from autdtorch.scene.scene import Scene

_SHORTEST = 0.1  # [wavelengths per m of wavelength] across array and control points: 1 m at 100 Hz in air
_LONGEST = 5e3  # [wavelengths] across array and control points
_USUAL_RATIO = 50.0  # of everything to array and control points, unless lengths are in mm
_LEAST_EXTENT = 15.0  # [wavelengths], for arrays and control points that are closer
_FAR = 10.0  # [m]; nearer walls and wider domains may be meant
_HIGHEST, _DENSEST_GAS = 1e6, 20.0  # [Hz, kg/m^3]; a gas absorbs what is higher within millimetres
_WIDEST, _WIDEST_WAVES = 1.0, 30.0  # [m, wavelengths] between neighbours of an array
_FEWEST = 4  # transducers that make an array, whose normal counts
_SAME_FREQUENCY = 0.01  # relative difference, for which the absorption changes by 2 %
_PAIRS = 2**20  # of points and normals that are held at once


def warn_of_implausible(scene: Scene) -> None:
    """Warn of units, foci behind the array and the air of another frequency."""
    extent, wavelength, places = _diagonal(_observed(scene)), scene.wavelength, scene.array.positions
    is_absorbed = scene.medium.density < _DENSEST_GAS and scene.frequency > _HIGHEST
    if is_absorbed or not _SHORTEST * wavelength**2 <= extent <= max(_LONGEST * wavelength, _FAR):
        size = f"{extent:.4g} m from end to end of array and control points, but a wavelength of"
        ask = "are lengths in m and the frequency in Hz, 40 kHz as 40e3?"
        warn_user(f"Scene: {size} {wavelength:.4g} m; {ask}")
    elif len(places) > 1 and (pitch := closest_pair(places)[0]) > max(_WIDEST, _WIDEST_WAVES * wavelength):
        warn_user(f"Scene.array: neighbours are {pitch:.4g} m apart; are positions in m, 10 mm as 10e-3?")
    for name, hint in _too_large(scene):
        warn_user(f"Scene.{name}{hint}")
    _warn_of_foci_behind(scene)
    expected, frequency = scene.medium.absorption_frequency, scene.frequency
    if expected is not None and abs(expected / frequency - 1) > _SAME_FREQUENCY:
        fix = f"take Medium.air(..., frequency={frequency:g})"
        warn_user(f"Scene.medium: absorption is for {expected:g} Hz, the scene has {frequency:g} Hz; {fix}")


def unit_hint(scene: Scene, obstacle: Obstacle) -> str:
    """Return what to do about a refused obstacle far larger or farther than array and foci; else nothing."""
    points = _observed(scene)
    both = torch.cat([points, points.new_tensor([obstacle.lower, obstacle.upper])])
    return f"; {obstacle.unit_question}" if _diagonal(both) > _usual_reach(scene, points) else ""


def extent_of(obstacle: Obstacle) -> str:
    """Return the corners of the bounding box as text, without rounding errors."""
    bounds = obstacle.lower, obstacle.upper
    low, high = (tuple(float(f"{entry:.9g}") for entry in corner) for corner in bounds)
    return f"{low} to {high} m"


def _too_large(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield names and descriptions of parts far larger than array and control points.

    The domain is compared with everything in it.
    """
    points = _observed(scene)
    everything = [points]
    for index, obstacle in enumerate(scene.obstacles):
        corners = points.new_tensor([obstacle.lower, obstacle.upper])
        everything.append(corners)
        if _is_too_large(scene, points, _without_slabs(corners, points)):
            kind = type(obstacle).__name__
            yield f"obstacles[{index}]", f": {kind} of {extent_of(obstacle)}; {obstacle.unit_question}"
    ask = "is it in m, 100 mm as 100e-3?"
    for index, reflector in enumerate(scene.reflectors):
        gap = float(reflector.mirror.height(points).min())
        if gap > max(_usual_reach(scene, points), _FAR):
            yield (
                f"reflectors[{index}]",
                f": {gap:.3g} m from everything; is its point in m, 100 mm as 100e-3?",
            )
    if (plane := scene.observation_plane) is not None:
        everything.append(plane.corners)
        if _is_too_large(scene, points, plane.corners):
            yield "observation_plane", f": of {plane.size} m around {plane.center} m; {ask}"
    if _is_too_large(scene, torch.cat(everything), points.new_tensor(scene.domain)):
        yield "domain", f": {scene.domain[0]} to {scene.domain[1]} m; {ask}"


def _is_too_large(scene: Scene, points: torch.Tensor, part: torch.Tensor) -> bool:
    """Return whether a part (N, 3) reaches implausibly far beyond points (N, 3) [m]."""
    return _diagonal(torch.cat([points, part])) > max(_usual_reach(scene, points), _FAR)


def _usual_reach(scene: Scene, points: torch.Tensor) -> float:
    return _USUAL_RATIO * max(_diagonal(points), _LEAST_EXTENT * scene.wavelength)


def _without_slabs(corners: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return corners (2, 3) cut to the points (N, 3) on each axis along which they exceed them at both ends.

    A wall across the scene may have any width.
    """
    lower, upper = points.amin(dim=0), points.amax(dim=0)
    passes = (corners[0] < lower) & (corners[1] > upper)
    return torch.where(passes, torch.stack([lower, upper]), corners)


def _observed(scene: Scene) -> torch.Tensor:
    return torch.cat([scene.array.positions, scene.control_points])


def _diagonal(points: torch.Tensor) -> float:
    """Return the diagonal [m] of the bounding box of points (N, 3)."""
    return float((points.amax(dim=0) - points.amin(dim=0)).norm())


def _warn_of_foci_behind(scene: Scene) -> None:
    """Warn if all control points and obstacles lie behind every transducer; a few point sources face nowhere.

    Some of them may lie behind, since an obstacle ahead may reflect.
    """
    array, points = scene.array, scene.control_points
    if len(array) < _FEWEST and not radii_of(array).any():
        return
    normals, facing = torch.unique(array.normals, dim=0, return_inverse=True)  # most arrays have one
    heights = (normals[facing] * array.positions).sum(dim=1)
    start = heights.new_zeros(len(normals)).scatter_reduce(0, facing, heights, "amin", include_self=False)
    corners = [
        torch.cartesian_prod(*points.new_tensor([body.lower, body.upper]).T) for body in scene.obstacles
    ]
    for some in torch.split(torch.cat([points, *corners]), max(1, _PAIRS // len(normals))):
        if (some @ normals.T >= start - LENGTH_TOLERANCE).any():
            return
    x, y, z = (f"{entry:.3g}" for entry in normals[0].tolist())
    lie = "all lie behind the array" if len(points) > 1 else "lies behind the array"
    warn_user(f"Scene.control_points: {lie}, whose normal is ({x}, {y}, {z}); turn it, or move the array")
