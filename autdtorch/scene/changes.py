"""Named changes of a scene, such as a shift of its obstacles or warmer air, by amounts in SI units.

A name is a part of the scene and a kind: "obstacles[0].x", "array.turn_z", "temperature". `KINDS` lists all.
Amounts of several changes, by name, are applied together: each obstacle first turns about its own centre and
is shifted, then all of them as one body. Turns about x, y and z follow each other in this order.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import torch

from autdtorch.scene.arrays import TransducerArray, radii_of
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.medium import ZERO_CELSIUS, Medium
from autdtorch.scene.obstacles import Obstacle, Sphere
from autdtorch.scene.obstacles.moving import circumscribed, is_movable, moved
from autdtorch.scene.reflectors import Reflector, is_panel
from autdtorch.scene.scene import OverlapWarning, ScaleWarning, Scene
from autdtorch.utils.array_types import REAL, triple
from autdtorch.utils.hints import did_you_mean
from autdtorch.utils.mirror_images import Image
from autdtorch.utils.validation import Vector, finite_vector, invalid, within

Amounts: TypeAlias = Mapping[str, float]

_AXES = "xyz"


class ChangeKind(NamedTuple):
    """A kind of change: the unit of its amounts, and its meaning."""

    unit: str
    meaning: str


def _shifts(part: str) -> dict[str, ChangeKind]:
    return {axis: ChangeKind("m", f"shift of {part} along {axis}") for axis in _AXES}


def _moves(part: str, pivot: str) -> dict[str, ChangeKind]:
    turns = {
        f"turn_{axis}": ChangeKind("rad", f"turn of {part} about {axis} through {pivot}") for axis in _AXES
    }
    return _shifts(part) | turns


_PARTS = {
    "obstacles": _moves("all obstacles, as one body,", "the centre of the sphere around them"),
    "obstacles[i]": _moves("one obstacle", "the centre of the sphere around it"),
    "array": _moves("the array, and of a panel that it stands in,", "the mean of its positions"),
    "points": _shifts("all points of observation"),
    "points[i]": _shifts("one point of observation"),
    "reflectors[i]": {"distance": ChangeKind("m", "shift of a plane along its normal")},
}

KINDS = {f"{part}.{kind}": each for part, kinds in _PARTS.items() for kind, each in kinds.items()}
"""KINDS: the accepted names, with i for an index, with unit and meaning."""
KINDS["temperature"] = ChangeKind("K", "rise of the temperature of the air, whose absorption stays")
KINDS["radius"] = ChangeKind("m", "growth of the transducers' discs")


def unit_of(name: str) -> str:
    """Return the unit of the amounts of a change."""
    return KINDS[_general(name)].unit


def require_change(name: object, scene: Scene, points: int) -> None:
    """Check the name of a change of a scene with so many points of observation.

    Raises:
        ValueError: a name that `KINDS` does not have, or a change that this scene cannot make.
    """
    if not isinstance(name, str) or _general(name) not in KINDS:
        parts = ", ".join(f"{part}.({' '.join(kinds)})" for part, kinds in _PARTS.items())
        accepted = f"must be a change{did_you_mean(name, KINDS)}: {parts}, temperature, radius"
        raise invalid("names", name, accepted)
    part, index = re.split(r"[\[.]", name)[0], _index_of(name)
    counts = {"obstacles": len(scene.obstacles), "reflectors": len(scene.reflectors), "points": points}
    if (count := counts.get(part, 1)) == 0:
        raise invalid("names", name, f"the scene has no {part}")
    if index is not None and index >= count:
        raise invalid("names", name, f"the index must be in 0 to {count - 1}")
    if reason := _obstruction(name, part, index, scene):
        raise invalid("names", name, reason)


def lever(name: str, scene: Scene) -> float:
    """Return about how far something in a scene is shifted by a change, for each unit of its amount [m]."""
    part, _, kind = name.rpartition(".")
    if name == "temperature":
        apart = torch.cdist(scene.control_points, scene.array.positions).max()
        return float(apart) / (2 * (scene.medium.temperature + ZERO_CELSIUS))
    if not kind.startswith("turn_"):
        return 1.0
    if part == "array":
        reach = (scene.array.positions - scene.array.positions.mean(dim=0)).norm(dim=1) + radii_of(
            scene.array
        )
        return float(reach.max())
    index = _index_of(name)
    return circumscribed(scene.obstacles if index is None else scene.obstacles[index : index + 1])[1]


def _obstruction(name: str, part: str, index: int | None, scene: Scene) -> str:
    """Return why a part of a scene cannot make a change, or changes nothing by it; empty if it can."""
    array, turns = scene.array, ".turn_" in name
    if part == "obstacles":
        bodies = scene.obstacles if index is None else (scene.obstacles[index],)
        for body in bodies:
            if not is_movable(body) or (turns and body.orientation_field is None):
                return f"a {type(body).__name__} cannot be {'turned' if turns else 'moved'}"
        if turns and len(bodies) == 1 and isinstance(bodies[0], Sphere):
            return "a sphere that turns about its centre stays what it is"
    if part == "reflectors" and index is not None and is_panel(scene.reflectors[index], array):
        return "the array stands in this plane, which array.x, array.y and array.z move along with it"
    if part == "radius" and not radii_of(array).all():
        return "needs an array of discs; a point has no radius"
    if part == "temperature" and not scene.medium.is_air:
        return "needs a medium of air: of other fluids the change with temperature is not known"
    if part == "array" and turns and len(array) == 1 and not radii_of(array).any():
        return "a single point source that turns stays what it is"
    return ""


def changed_scene(scene: Scene, amounts: Amounts) -> Scene:
    """Return a scene after changes by amounts.

    The domain grows with what leaves it, unless an obstacle reaches its edge. Obstacles of the medium's own
    material remain of it.

    Raises:
        ValueError: the amounts, and why they make no scene.
    """
    listed = ", ".join(f"{name} {amount:.4g} {unit_of(name)}" for name, amount in amounts.items())
    with within(f"scene changed by {listed}"), warnings.catch_warnings():
        warnings.simplefilter("ignore", OverlapWarning)  # of the scene before
        warnings.simplefilter("ignore", ScaleWarning)
        medium, array = changed_medium(scene.medium, amounts), changed_array(scene.array, amounts)
        points = changed_points(scene.control_points, amounts)
        return replace(
            scene,
            array=array,
            medium=medium,
            control_points=points,
            obstacles=changed_obstacles(_in_medium(scene, medium), amounts),
            reflectors=changed_reflectors(scene, amounts),
            domain=_domain_with(scene, array, points),
        )


def changed_and_seen(scene: Scene, amounts: Amounts) -> tuple[Scene, Image]:
    """Return a changed scene seen from its obstacles, and the map from its places to those seen.

    The obstacles' moves as one body are undone, and all else moves back. Pressures are those of the changed
    scene.
    """
    changed = changed_scene(scene, amounts)
    alone = {name: amount for name, amount in amounts.items() if not name.startswith("obstacles.")}
    obstacles = changed_obstacles(_in_medium(scene, changed.medium), alone)
    return seen_from_obstacles(changed, obstacles, *move_of("obstacles", amounts))


def seen_from_obstacles(
    scene: Scene, obstacles: tuple[Obstacle, ...], offset: torch.Tensor, rotation: Vector
) -> tuple[Scene, Image]:
    """Return a scene, whose obstacles have moved as one body, seen from these; see `changed_and_seen`.

    The domain grows with all that leaves it: in boxes, obstacles end where they do.
    `obstacles` are those before, offset (3,) [m] and rotation [rad] as in `Scene.moved`.
    """
    (center, _), turn = circumscribed(obstacles), rotation_matrix(rotation)
    view = Image(turn.mT, center - (center + offset) @ turn, 1.0)
    array, planes = scene.array, []
    for plane in scene.reflectors:
        point, normal = torch.tensor([plane.point, plane.normal], **REAL)
        planes.append(Reflector(view.of(point), normal @ turn, plane.reflection))
    array = replace(array, positions=view.of(array.positions), normals=array.normals @ turn)
    points = view.of(scene.control_points)
    with warnings.catch_warnings():  # of the scene before
        warnings.simplefilter("ignore", OverlapWarning)
        warnings.simplefilter("ignore", ScaleWarning)
        seen = replace(
            scene,
            array=array,
            control_points=points,
            obstacles=obstacles,
            reflectors=tuple(planes),
            domain=_grown(torch.tensor(scene.domain, **REAL), array, points),
            observation_plane=None,
        )
    return seen, view


def changed_points(points: torch.Tensor, amounts: Amounts) -> torch.Tensor:
    """Return points of observation (P, 3) [m] after changes by amounts."""
    places = points + move_of("points", amounts)[0]
    for part in {name.partition(".")[0] for name in amounts if name.startswith("points[")}:
        places[_index_of(part)] += move_of(part, amounts)[0]
    return places


def changed_array(array: TransducerArray, amounts: Amounts) -> TransducerArray:
    """Return an array after changes by amounts."""
    shift, angles = move_of("array", amounts)
    growth = amounts.get("radius", 0.0)
    if not growth and not shift.any() and not any(angles):
        return array
    turn, center = rotation_matrix(angles), array.positions.mean(dim=0)
    places = center + shift + (array.positions - center) @ turn.mT
    return replace(array, positions=places, normals=array.normals @ turn.mT, radius=radii_of(array) + growth)


def changed_obstacles(obstacles: tuple[Obstacle, ...], amounts: Amounts) -> tuple[Obstacle, ...]:
    """Return obstacles after changes by amounts."""
    each = [
        _moved((obstacle,), f"obstacles[{index}]", amounts)[0] for index, obstacle in enumerate(obstacles)
    ]
    return _moved(tuple(each), "obstacles", amounts)


def changed_medium(medium: Medium, amounts: Amounts) -> Medium:
    """Return the medium after changes by amounts."""
    kelvin = amounts.get("temperature", 0.0)
    return medium.warmed(kelvin) if kelvin else medium


def changed_reflectors(scene: Scene, amounts: Amounts) -> tuple[Reflector, ...]:
    """Return the reflectors of a scene after changes by amounts."""
    shift, angles = move_of("array", amounts)
    turn, center = rotation_matrix(angles), scene.array.positions.mean(dim=0)
    reflectors = []
    for index, plane in enumerate(scene.reflectors):
        point, normal = torch.tensor([plane.point, plane.normal], **REAL)
        point = point + amounts.get(f"reflectors[{index}].distance", 0.0) * normal
        if is_panel(plane, scene.array):
            point, normal = center + shift + turn @ (point - center), turn @ normal
        reflectors.append(Reflector(point, normal, plane.reflection))
    return tuple(reflectors)


def move_of(part: str, amounts: Amounts) -> tuple[torch.Tensor, Vector]:
    """Return shift (3,) [m] and turn, angles (3,) [rad] about the fixed axes, of a part."""
    shift = torch.tensor([amounts.get(f"{part}.{axis}", 0.0) for axis in _AXES], **REAL)
    return shift, triple(amounts.get(f"{part}.turn_{axis}", 0.0) for axis in _AXES)


def _moved(obstacles: tuple[Obstacle, ...], part: str, amounts: Amounts) -> tuple[Obstacle, ...]:
    shift, angles = move_of(part, amounts)
    return moved(obstacles, shift, angles) if shift.any() or any(angles) else obstacles


def _in_medium(scene: Scene, medium: Medium) -> tuple[Obstacle, ...]:
    """Return the obstacles of a scene in another medium, which those of the medium's material share."""
    before = scene.medium.density, scene.medium.sound_speed, 0.0
    return tuple(
        replace(obstacle, density=medium.density, sound_speed=medium.sound_speed)
        if (obstacle.density, obstacle.sound_speed, obstacle.absorption) == before
        else obstacle
        for obstacle in scene.obstacles
    )


def _domain_with(scene: Scene, array: TransducerArray, points: torch.Tensor) -> tuple[Vector, Vector]:
    """Return the domain [m] of a scene, grown to hold an array and points.

    It stays where an obstacle reaches its edge, which may go on beyond it.
    """
    domain = torch.tensor(scene.domain, **REAL)
    lower, upper = domain
    for obstacle in scene.obstacles:
        below, above = lower.new_tensor(obstacle.lower) <= lower, upper.new_tensor(obstacle.upper) >= upper
        if below.any() or above.any():
            return scene.domain
    return _grown(domain, array, points)


def _grown(domain: torch.Tensor, array: TransducerArray, points: torch.Tensor) -> tuple[Vector, Vector]:
    """Return a domain (2, 3) [m] grown to hold an array and points."""
    reach = array.half_extents
    everything = torch.cat([domain, points, array.positions - reach, array.positions + reach])
    return finite_vector("domain", everything.amin(dim=0)), finite_vector("domain", everything.amax(dim=0))


def _index_of(name: str) -> int | None:
    place = re.search(r"\d+", name)
    return int(place[0]) if place else None


def _general(name: str) -> str:
    """Return the name of a change with i in place of an index."""
    return re.sub(r"\[\d+\]", "[i]", name)
