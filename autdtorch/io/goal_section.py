"""Goals as sections of configs and results: a name and settings, of which none names a function."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

from autdtorch.objectives.forces import ForceGoal, GoalOfForce
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.kinds import GOALS
from autdtorch.objectives.over_scenes import OverScenes
from autdtorch.scene.particle import Particle
from autdtorch.utils.files import require_name
from autdtorch.utils.validation import invalid, require_known, require_one_of, within


def load_goal(where: str, section: object) -> Goal | ForceGoal:
    """Make the goal of a section such as ``{name: target_pressures, targets: [400, 200]}``.

    Args:
        where: name of the section in messages.
        section: a mapping of `name` and the settings of that goal, or a name alone. A config file may have
            written it. Consecutive points can be text such as "4-67"; a particle is ``{material: EPS,
            radius: 1e-3}``, or has a density and a sound speed in place of a material.

    Raises:
        ValueError: an unknown name or setting, or a setting out of range.
    """
    if isinstance(section, str):
        section = {"name": section}
    if not isinstance(section, Mapping):
        raise invalid(where, section, "must be the name of a goal, or a mapping of its name and settings")
    name = section.get("name")
    require_one_of(f"{where}.name", name, GOALS)
    kind = GOALS[str(name)]
    defaults = {field.name: field.default for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    require_known(where, section, ["name", *defaults])
    settings: dict[str, Any] = {
        field: section.get(field, None if default is dataclasses.MISSING else default)
        for field, default in defaults.items()
    }
    if isinstance(points := settings.get("points"), str):
        settings["points"] = _span(f"{where}.points", points)
    if "goal" in settings:
        settings["goal"] = load_goal(f"{where}.goal", settings["goal"])
    if "particle" in section:
        settings["particle"] = _particle(f"{where}.particle", section["particle"])
    try:
        return kind(**settings)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _particle(where: str, section: object) -> Particle:
    fields = [field.name for field in dataclasses.fields(Particle)]
    if not isinstance(section, Mapping):
        raise invalid(where, section, "must be a mapping, such as {material: EPS, radius: 1e-3}")
    require_known(where, section, ["material", *fields])
    settings = {field: section.get(field) for field in fields}
    with within(where):
        if (material := section.get("material")) is None:
            return Particle(**settings)  # type: ignore[arg-type]
        radius = settings.pop("radius")
        if any(value is not None for value in settings.values()):
            raise invalid("material", material, "must be null where density and sound_speed are given")
        return Particle.of(material, radius)  # type: ignore[arg-type]


def _span(where: str, text: str) -> range:
    """Return the indices of text such as "4-67"."""
    span = re.fullmatch(r"(\d{1,6})-(\d{1,6})", text)
    if span is None or int(span[2]) < int(span[1]):
        raise invalid(
            where, text, 'must be indices, such as [4, 5, 6], or their first and last, such as "4-6"'
        )
    return range(int(span[1]), int(span[2]) + 1)


def goal_section(goal: Goal | ForceGoal) -> dict[str, Any]:
    """Return the section of a goal, from which `load_goal` makes it again.

    For readings of a force it is the section of the trap, lift or push that they measure.
    """
    if isinstance(goal, GoalOfForce):
        return goal_section(goal.of)
    return {"name": goal.name} | _entries(goal)


def _entries(of: Any) -> dict[str, Any]:
    return {field.name: _entry(getattr(of, field.name)) for field in dataclasses.fields(of)}


def _entry(value: object) -> object:
    if isinstance(value, Goal):
        return goal_section(value)
    if isinstance(value, Particle):
        return _entries(value)
    return [_entry(each) for each in value] if isinstance(value, tuple) else value


def require_score(name: object, unit: object) -> None:
    """Check the name of a goal and the unit of its scores, which reports and figures show."""
    require_name("goal", name)
    if unit != "":
        for part in unit.split("/") if isinstance(unit, str) else [unit]:  # as of N/m
            require_name("goal.unit", part)


def score_label(name: str, unit: str = "") -> str:
    """Return the name and unit of scores for tables and figures, such as "weakest focus [Pa]"."""
    return name.replace("_", " ") + (f" [{unit}]" if unit else "")


def goal_label(section: Mapping[str, Any], unit: str = "") -> str:
    """Return the name and unit of the scores of a goal's section, such as "worst weakest focus [Pa]"."""
    if section["name"] != OverScenes.name:
        return score_label(section["name"], unit)
    by, inner = section["by"], section["goal"]["name"]
    return score_label(f"{inner}, {by if isinstance(by, str) else f'quantile {by:g}'} of scenes", unit)


PAPERS_GOAL = goal_section(WEAKEST_FOCUS)
"""Section of the paper's goal."""
