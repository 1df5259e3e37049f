"""The settings `poses`: a path of the obstacles, as scenes that follow one another."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig

from autdtorch.cli.settings import section_of
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.moving import angles_of
from autdtorch.utils.array_types import Array
from autdtorch.utils.units import angles
from autdtorch.utils.validation import finite_vector, integer_at_least, invalid, require_known, within

_KEYS = ("offset", "rotation", "rotation_degrees", "count")
_MOST = 10_000


class Poses(NamedTuple):
    """Places along a path, in mm, or in degrees where the obstacles only turn."""

    places: Array
    label: str


def along_path(settings: dict[str, Any]) -> Poses:
    """Replace scene and method in the settings by an experiment with a scene for each pose.

    The path begins at the pose of the scene. The last pose is moved by `offset` and turned by `rotation` from
    there. Shifts and angles between are evenly spaced.

    Raises:
        ValueError: a setting of `poses` that is unknown or out of range, or an experiment beside it.
    """
    poses = section_of(settings, "poses")
    require_known("poses", poses, _KEYS)
    if "scenes" in settings:
        raise invalid("poses", poses, "must not be given beside an experiment")
    with within("poses"):
        offset = np.array(finite_vector("offset", poses.get("offset", (0, 0, 0))))
        rotation = _turn("", poses)
        count = integer_at_least("count", poses.get("count"), 2)
        if count > _MOST:
            raise invalid("count", count, f"must be at most {_MOST}")
        if not (offset.any() or rotation.any()):
            raise invalid(
                "offset", offset.tolist(), "must move the obstacles, or rotation must turn them", "m"
            )
    scene, chosen = section_of(settings, "scene"), HydraConfig.get().runtime.choices
    first = section_of(scene, "pose") if scene.get("pose") else {}
    require_known("scene.pose", first, _KEYS[:3])
    start = [np.array(finite_vector("scene.pose.offset", first.get("offset", (0, 0, 0))))]
    start.append(_turn("scene.pose.", first))
    shares, digits = np.linspace(0, 1, count), len(str(count - 1))
    turns = [rotation_matrix(tuple((share * rotation).tolist())) for share in shares]
    settings["scenes"] = {
        f"{chosen['scene']}_{number:0{digits}d}": {
            **scene,
            "pose": {
                "offset": (start[0] + share * offset).tolist(),
                "rotation": angles_of(turn @ rotation_matrix(tuple(start[1].tolist()))).tolist(),
            },
        }
        for number, (share, turn) in enumerate(zip(shares, turns, strict=True))
    }
    settings["methods"] = {chosen["method"]: section_of(settings, "method")}
    del settings["scene"], settings["method"]
    if offset.any():
        return Poses(1e3 * float(np.linalg.norm(offset)) * shares, "path of the obstacles [mm]")
    cosines = [(float(torch.trace(turn)) - 1) / 2 for turn in turns]
    return Poses(np.degrees(np.arccos(np.clip(cosines, -1, 1))), "turn of the obstacles [degrees]")


def _turn(where: str, section: dict[str, Any]) -> Array:
    """Return the angles (3,) [rad] of a section, which may give them in degrees."""
    turn = angles(f"{where}rotation", section.get("rotation", (0, 0, 0)), section.get("rotation_degrees"))
    return np.array(turn)
