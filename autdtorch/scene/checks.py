"""Checks of scenes: what is refused, and warnings of what is possible but seldom meant.

Such are lengths in mm or cm, foci behind the array, or other air.
"""

from __future__ import annotations

from collections.abc import Iterator
from operator import attrgetter

import torch

from autdtorch.scene.arrays import TransducerArray, radii_of
from autdtorch.scene.contents import SceneContents
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.obstacles.base import overlap, shared_box
from autdtorch.scene.reflectors import require_in_front
from autdtorch.utils.array_types import REAL
from autdtorch.utils.fluids import warn_if_in_grams
from autdtorch.utils.spatial import closest_pair, require_distinct
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import LENGTH_TOLERANCE, Vector, invalid

_SHORTEST = 0.1  # [wavelengths per m of wavelength] across array and control points: 1 m at 100 Hz in air
_LONGEST = 5e3  # [wavelengths] across array and control points
_USUAL_RATIO = 50.0  # of everything to array and control points, unless lengths are in mm
_LEAST_EXTENT = 15.0  # [wavelengths], for arrays and control points that are closer
_FAR = 10.0  # [m]; nearer walls and wider domains may be meant
_HIGHEST, _DENSEST_GAS = 1e6, 20.0  # [Hz, kg/m^3]; a gas absorbs what is higher within millimetres
_WIDEST, _WIDEST_WAVES = 0.5, 30.0  # [m, wavelengths] between neighbours of an array; 10 mm in cm are 1.0
_FARTHEST_FOCI, _FARTHEST_EXTENTS = 5.0, 25.0  # [m, extents of the array] from the array; 15 cm are no 15 m
_FEWEST = 4  # transducers that make an array, whose normal counts
_SAME_FREQUENCY = 0.01  # relative difference, for which the absorption changes by 2 %
_PAIRS = 2**20  # of points and normals that are held at once
_FARTHEST = 1e6  # [m] along an axis; far beyond any simulation, and volumes do not overflow
_LOWEST = 1000.0  # [Hz], below which a frequency may be in kHz
_MOST_ABSORPTION = 3.0  # [dB per wavelength]: the model assumes a small imaginary part of the wavenumber
_MOST_OF_OBSTACLE = 27.0  # [dB per wavelength], an imaginary part of half the wavenumber
_AT_ONCE = 1_000_000  # pairs of a point and a transducer whose distances are in memory at once


class OverlapWarning(UserWarning):
    """Two obstacles of different materials overlap."""


def require_places(scene: SceneContents) -> None:
    """Refuse contents behind a reflector, in an obstacle, on each other or outside the domain."""
    _require_in_front(scene)
    _require_separate_points(scene)
    _require_in_domain(scene)


def warn_of_doubts(scene: SceneContents) -> None:
    """Warn of overlaps, and of what is possible but seldom meant."""
    _warn_of_overlaps(scene.obstacles)
    _warn_of_implausible(scene)


def _contents(scene: SceneContents) -> list[tuple[str, torch.Tensor]]:
    """Return names and points (N, 3) [m] of everything that must be inside the domain."""
    positions, reach = scene.array.positions, scene.array.half_extents
    contents = [
        ("Scene.array.positions", positions),
        ("Scene.control_points", scene.control_points),
        ("Scene.array disc's lower edge", positions - reach),
        ("Scene.array disc's upper edge", positions + reach),
    ]
    if scene.observation_plane is not None:
        contents.append(("Scene.observation_plane corner", scene.observation_plane.corners))
    return contents


def everything_of(scene: SceneContents) -> list[tuple[str, torch.Tensor]]:
    """Return names and points (N, 3) [m] of the contents and of the obstacles' bounding boxes."""
    bounds = [
        (f"Scene.obstacles[{index}] corner", scene.control_points.new_tensor([body.lower, body.upper]))
        for index, body in enumerate(scene.obstacles)
    ]
    return _contents(scene) + bounds


def require_within(name: str, points: torch.Tensor) -> None:
    """Refuse points (N, 3) [m] too far away for any simulation."""
    far = ~(points.abs() <= _FARTHEST).all(dim=-1)
    if far.any():
        first = points[far][0].detach()
        raise invalid(name, first, f"every coordinate must be in {-_FARTHEST:g} to {_FARTHEST:g}", "m")


def require_waves(scene: SceneContents) -> None:
    """Refuse absorptions that leave no wave, in the medium or in an obstacle."""
    most = _MOST_ABSORPTION / scene.wavelength
    if scene.medium.absorption > most:
        limit = f"{_MOST_ABSORPTION:g} dB per wavelength"
        if scene.frequency < _LOWEST and scene.medium.absorption <= 1e3 * most:  # a frequency in kHz
            absorbed = scene.medium.absorption * scene.wavelength
            accepted = f"the medium absorbs {absorbed:.3g} dB per wavelength, must be at most {limit}"
            accepted += f"; is it in Hz, {scene.frequency:g} kHz as {scene.frequency:g}e3?"
            raise invalid("Scene.frequency", scene.frequency, accepted, "Hz")
        accepted = f"must be at most {most:.4g} dB/m, {limit}"
        raise invalid("Scene.medium.absorption", scene.medium.absorption, accepted, "dB/m")
    for index, obstacle in enumerate(scene.obstacles):
        if obstacle.absorption and obstacle.sound_speed is not None:
            most = _MOST_OF_OBSTACLE * scene.frequency / obstacle.sound_speed.real
            if obstacle.absorption > most:
                accepted = f"must be at most {most:.4g} dB/m, {_MOST_OF_OBSTACLE:g} dB per wavelength inside"
                accepted += "; porous() and impedance= describe what absorbs more"
                raise invalid(f"Scene.obstacles[{index}].absorption", obstacle.absorption, accepted, "dB/m")


def _require_in_front(scene: SceneContents) -> None:
    """Refuse what lies behind a reflector; obstacles that cross one are cut."""
    if not scene.reflectors:
        return
    contents = [*_contents(scene)[:2], ("Scene.array.nodes", scene.array.nodes.positions.reshape(-1, 3))]
    if scene.observation_plane is not None:
        contents.append(("Scene.observation_plane corner", scene.observation_plane.corners))
    for number, reflector in enumerate(scene.reflectors):
        for name, places in contents:
            require_in_front([reflector], name, places, number)
        for index, obstacle in enumerate(scene.obstacles):
            highest = float(reflector.mirror.height(obstacle.surface()[0]).max())
            if highest <= LENGTH_TOLERANCE:
                accepted = f"is wholly behind reflector {number}, must be in front of it, at least in part"
                raise ValueError(f"Scene.obstacles[{index}]: {extent_of(obstacle)}; {accepted}")


def _require_separate_points(scene: SceneContents) -> None:
    """Refuse coincident points and points in or on an obstacle; on it, rounding would choose the side."""
    require_distinct("Scene.control_points", scene.control_points)
    array, points = scene.array, scene.control_points
    require_clear(array, "Scene.control_points", points)
    groups = {"array.positions": array.positions, "control_points": points}
    radius = float(radii_of(array).max())
    if any(obstacle.near(array.positions, radius).any() for obstacle in scene.obstacles):
        groups["array.nodes"] = array.nodes[0]
    for name, group in groups.items():
        for index, obstacle in enumerate(scene.obstacles):
            if _is_of_medium(scene, obstacle):
                continue
            inside = obstacle.contains(group, margin=LENGTH_TOLERANCE)
            if inside.any():
                inside &= ~_in_later_medium(scene, index, group)
            if inside.any():
                first = tuple(inside.nonzero()[0].tolist())
                accepted = f"lies in or on obstacle {index}, {extent_of(obstacle)}, must be outside it"
                accepted += unit_hint(scene, obstacle)
                raise invalid(f"Scene.{name}{list(first)}", group[first], accepted, "m")


def _is_of_medium(scene: SceneContents, obstacle: Obstacle) -> bool:
    """Return whether an obstacle is of the medium's material: it cuts earlier ones, and hides no point."""
    material = obstacle.density, obstacle.sound_speed, obstacle.absorption
    return material == (scene.medium.density, scene.medium.sound_speed, 0.0)


def _in_later_medium(scene: SceneContents, index: int, points: torch.Tensor) -> torch.Tensor:
    """Return whether points (..., 3) are within an obstacle of the medium's material that follows `index`."""
    cleared = torch.zeros(points.shape[:-1], dtype=torch.bool, device="cpu")
    for later in scene.obstacles[index + 1 :]:
        if _is_of_medium(scene, later):
            cleared |= later.signed_distance(points) < -LENGTH_TOLERANCE
    return cleared


def _warn_of_overlaps(obstacles: tuple[Obstacle, ...]) -> None:
    """Warn of overlapping pairs of different material, where the order of the list matters."""
    material = attrgetter("density", "sound_speed", "rigid", "absorption", "impedance")
    pairs = [
        f"{index} overlaps {earlier}"
        for index, obstacle in enumerate(obstacles)
        for earlier, other in enumerate(obstacles[:index])
        if material(obstacle) != material(other) and overlap(obstacle, other)
    ]
    if pairs:
        text = f"{', '.join(pairs)}, of another material; where both are, the later counts"
        warn_user(f"Scene.obstacles: {text}", OverlapWarning)


def require_clear(array: TransducerArray, name: str, points: torch.Tensor) -> None:
    """Refuse points (N, 3) [m] on a transducer."""
    reach = radii_of(array)[:, None]
    axes = torch.cat([torch.eye(3, **REAL), array.normals[:1]])  # flat arrays are thin along their normal
    half = reach * (1 - (array.normals @ axes.mT) ** 2).clamp(min=0).sqrt() + LENGTH_TOLERANCE
    centers, along = array.positions @ axes.mT, points.cpu() @ axes.mT
    near = (along >= (centers - half).amin(dim=0)) & (along <= (centers + half).amax(dim=0))
    for some in torch.split(near.all(dim=1).nonzero()[:, 0], 1 + _AT_ONCE // len(array)):
        between = points[some].cpu()[:, None] - array.positions
        height = (between * array.normals).sum(dim=-1).abs()
        on = (height < LENGTH_TOLERANCE) & (between.norm(dim=-1) < reach[:, 0] + LENGTH_TOLERANCE)
        if on.any():
            row, transducer = on.nonzero()[0].tolist()
            accepted = f"lies on transducer {transducer}, must be at least {LENGTH_TOLERANCE:g} m away"
            raise invalid(f"{name}[{int(some[row])}]", points[some[row]], accepted, "m")


def require_inside(domain: tuple[Vector, Vector], name: str, points: torch.Tensor, fix: str = "") -> None:
    """Refuse points (N, 3) [m] outside the corners (lower, upper) of a domain; `fix` says what would help."""
    lower, upper = (torch.tensor(corner, **REAL) for corner in domain)
    outside = ((points < lower - LENGTH_TOLERANCE) | (points > upper + LENGTH_TOLERANCE)).any(dim=-1)
    if outside.any():
        first = int(outside.nonzero()[0, 0])
        accepted = f"must be inside the domain, {domain[0]} to {domain[1]} m{fix}"
        raise invalid(f"{name}[{first}]", points[first], accepted, "m")


def _require_in_domain(scene: SceneContents) -> None:
    for name, points in _contents(scene):
        require_inside(scene.domain, name, points, "; domain=None fits it to the scene")
    for index, obstacle in enumerate(scene.obstacles):
        if shared_box((obstacle.lower, obstacle.upper), scene.domain) is None:
            accepted = f"must be at least partly inside the domain, {scene.domain[0]} to {scene.domain[1]} m"
            accepted += unit_hint(scene, obstacle)
            raise ValueError(f"Scene.obstacles[{index}]: {extent_of(obstacle)}; {accepted}")


def _warn_of_implausible(scene: SceneContents) -> None:
    """Warn of units, foci behind the array and the air of another frequency."""
    extent, wavelength, places = _diagonal(_observed(scene)), scene.wavelength, scene.array.positions
    is_absorbed = scene.medium.density < _DENSEST_GAS and scene.frequency > _HIGHEST
    if is_absorbed or not _SHORTEST * wavelength**2 <= extent <= max(_LONGEST * wavelength, _FAR):
        size = f"{extent:.4g} m from end to end of array and control points, but a wavelength of"
        ask = "are lengths in m and the frequency in Hz, 40 kHz as 40e3?"
        warn_user(f"Scene: {size} {wavelength:.4g} m; {ask}")
    elif len(places) > 1 and (pitch := closest_pair(places)[0]) > max(_WIDEST, _WIDEST_WAVES * wavelength):
        warn_user(f"Scene.array: neighbours are {pitch:.4g} m apart; are positions in m, 10 mm as 10e-3?")
    elif len(places) >= _FEWEST and (gap := _gap(places, scene.control_points)) > _farthest_foci(scene):
        shown = f"{gap:.4g} m from an array of {_diagonal(places):.3g} m"
        warn_user(f"Scene.control_points: {shown}, too far for foci; are they in m, 150 mm as 150e-3?")
    for name, hint in _too_large(scene):
        warn_user(f"Scene.{name}{hint}")
    for index, obstacle in enumerate(scene.obstacles):
        if (material := obstacle.fluid_at(scene.frequency)) is not None:
            warn_if_in_grams(f"Scene.obstacles[{index}]", material[0].real, material[1].real)
    _warn_of_foci_behind(scene)
    expected, frequency = scene.medium.absorption_frequency, scene.frequency
    if expected is not None and abs(expected / frequency - 1) > _SAME_FREQUENCY:
        fix = f"take Medium.air(..., frequency={frequency:g})"
        warn_user(f"Scene.medium: absorption is for {expected:g} Hz, the scene has {frequency:g} Hz; {fix}")


def unit_hint(scene: SceneContents, obstacle: Obstacle) -> str:
    """Return what to do about a refused obstacle far larger or farther than array and foci; else nothing."""
    points = _observed(scene)
    both = torch.cat([points, points.new_tensor([obstacle.lower, obstacle.upper])])
    return f"; {obstacle.unit_question}" if _diagonal(both) > _usual_reach(scene, points) else ""


def extent_of(obstacle: Obstacle) -> str:
    """Return the corners of the bounding box as text, without rounding errors."""
    bounds = obstacle.lower, obstacle.upper
    low, high = (tuple(float(f"{entry:.9g}") for entry in corner) for corner in bounds)
    return f"{low} to {high} m"


def _too_large(scene: SceneContents) -> Iterator[tuple[str, str]]:
    """Yield names and descriptions of parts far larger than array and control points.

    The domain is compared with everything in it.
    """
    points = _observed(scene)
    everything = [points]
    for index, obstacle in enumerate(scene.obstacles):
        corners = points.new_tensor([obstacle.lower, obstacle.upper])
        everything.append(corners)
        if obstacle.has_unsure_units:  # no wall: these seldom come as meshes
            is_large = _diagonal(torch.cat([points, corners])) > _usual_reach(scene, points)
        else:
            is_large = _is_too_large(scene, points, _without_slabs(corners, points))
        if is_large:
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


def _is_too_large(scene: SceneContents, points: torch.Tensor, part: torch.Tensor) -> bool:
    """Return whether a part (N, 3) reaches implausibly far beyond points (N, 3) [m]."""
    return _diagonal(torch.cat([points, part])) > max(_usual_reach(scene, points), _FAR)


def _usual_reach(scene: SceneContents, points: torch.Tensor) -> float:
    return _USUAL_RATIO * max(_diagonal(points), _LEAST_EXTENT * scene.wavelength)


def _gap(places: torch.Tensor, points: torch.Tensor) -> float:
    """Return the least distance [m] of points (P, 3) to the bounding box of places (M, 3)."""
    nearest = torch.minimum(torch.maximum(points, places.amin(dim=0)), places.amax(dim=0))
    return float((points - nearest).norm(dim=1).min())


def _farthest_foci(scene: SceneContents) -> float:
    """Return the usual limit [m] of distances of foci; sound of an array spreads far before."""
    extent = max(_diagonal(scene.array.positions), _LEAST_EXTENT * scene.wavelength)
    return max(_FARTHEST_FOCI, _FARTHEST_EXTENTS * extent)


def _without_slabs(corners: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return corners (2, 3) cut to the points (N, 3) on each axis along which they exceed them at both ends.

    A wall across the scene may have any width.
    """
    lower, upper = points.amin(dim=0), points.amax(dim=0)
    passes = (corners[0] < lower) & (corners[1] > upper)
    return torch.where(passes, torch.stack([lower, upper]), corners)


def _observed(scene: SceneContents) -> torch.Tensor:
    return torch.cat([scene.array.positions, scene.control_points])


def _diagonal(points: torch.Tensor) -> float:
    """Return the diagonal [m] of the bounding box of points (N, 3)."""
    return float((points.amax(dim=0) - points.amin(dim=0)).norm())


def _warn_of_foci_behind(scene: SceneContents) -> None:
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
