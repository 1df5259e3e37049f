"""Goals as sections of configs and results: a name and settings, of which none names a function."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

from autdtorch.objectives.goals import (
    WEAKEST_FOCUS,
    Goal,
    MeanPressure,
    TargetPressures,
    WeakestFocus,
)
from autdtorch.objectives.over_scenes import OverScenes
from autdtorch.objectives.quiet import Contrast, QuietPoints, SeenPoints
from autdtorch.utils.validation import invalid, require_known, require_name, require_one_of

GOALS: dict[str, type[Goal]] = {
    goal.name: goal
    for goal in (WeakestFocus, MeanPressure, TargetPressures, QuietPoints, SeenPoints, Contrast, OverScenes)
}
"""The goals by name."""


def load_goal(where: str, section: object) -> Goal:
    """Make the goal of a section such as ``{name: target_pressures, targets: [400, 200]}``.

    Args:
        where: name of the section in messages.
        section: a mapping of `name` and the settings of that goal, or a name alone. A config file may have
            written it. Consecutive points can be text such as "4-67".

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
    fields = [field.name for field in dataclasses.fields(kind)]
    require_known(where, section, ["name", *fields])
    settings = {field: section.get(field) for field in fields}
    if isinstance(points := settings.get("points"), str):
        settings["points"] = _span(f"{where}.points", points)
    if "goal" in fields:
        settings["goal"] = load_goal(f"{where}.goal", settings["goal"])
    try:
        return kind(**settings)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _span(where: str, text: str) -> range:
    """Return the indices of text such as "4-67"."""
    span = re.fullmatch(r"(\d{1,6})-(\d{1,6})", text)
    if span is None or int(span[2]) < int(span[1]):
        raise invalid(
            where, text, 'must be indices, such as [4, 5, 6], or their first and last, such as "4-6"'
        )
    return range(int(span[1]), int(span[2]) + 1)


def goal_section(goal: Goal) -> dict[str, Any]:
    """Return the section of a goal, from which `load_goal` makes it again."""
    return {"name": goal.name} | {
        field.name: _entry(getattr(goal, field.name)) for field in dataclasses.fields(goal)
    }


def _entry(value: object) -> object:
    if isinstance(value, Goal):
        return goal_section(value)
    return list(value) if isinstance(value, tuple) else value


def require_score(name: object, unit: object) -> None:
    """Check the name of a goal and the unit of its scores, which reports and figures show."""
    require_name("goal", name)
    if unit != "":
        require_name("goal.unit", unit)


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
