"""The settings `poses`: a path of the obstacles, as scenes that follow one another."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from hydra.core.hydra_config import HydraConfig

from autdtorch.cli.settings import section_of
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import finite_vector, integer_at_least, invalid, require_known, within

_KEYS = ("offset", "rotation", "count")
_MOST = 10_000


class Poses(NamedTuple):
    """Places along a path, in mm, or in degrees where the obstacles only turn."""

    places: Array
    label: str


def along_path(settings: dict[str, Any]) -> Poses:
    """Replace scene and method in the settings by an experiment with a scene for each pose.

    The first pose is that of the scene, the last is moved by `offset` and turned by `rotation`; those between
    are evenly spaced.

    Raises:
        ValueError: a setting of `poses` that is unknown or out of range, or an experiment beside it.
    """
    poses = section_of(settings, "poses")
    require_known("poses", poses, _KEYS)
    if "scenes" in settings:
        raise invalid("poses", poses, "must not be given beside an experiment")
    with within("poses"):
        offset = np.array(finite_vector("offset", poses.get("offset", (0, 0, 0))))
        rotation = np.array(finite_vector("rotation", poses.get("rotation", (0, 0, 0)), "rad"))
        count = integer_at_least("count", poses.get("count"), 2)
        if count > _MOST:
            raise invalid("count", count, f"must be at most {_MOST}")
    scene, chosen = section_of(settings, "scene"), HydraConfig.get().runtime.choices
    first = scene.get("pose") or {}
    start = [np.array(finite_vector(f"scene.pose.{key}", first.get(key, (0, 0, 0)))) for key in _KEYS[:2]]
    shares, digits = np.linspace(0, 1, count), len(str(count - 1))
    settings["scenes"] = {
        f"{chosen['scene']}_{number:0{digits}d}": {
            **scene,
            "pose": {
                "offset": (start[0] + share * offset).tolist(),
                "rotation": (start[1] + share * rotation).tolist(),
            },
        }
        for number, share in enumerate(shares)
    }
    settings["methods"] = {chosen["method"]: section_of(settings, "method")}
    del settings["scene"], settings["method"]
    if offset.any():
        return Poses(1e3 * float(np.linalg.norm(offset)) * shares, "path of the obstacles [mm]")
    return Poses(np.degrees(float(np.linalg.norm(rotation))) * shares, "turn of the obstacles [degrees]")
