"""The file ``summary.csv``: one line of numbers for each method in each scene."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Mapping
from pathlib import Path

from autdtorch.study.results import MethodResult, StudyResult
from autdtorch.study.statistics import bound_gap
from autdtorch.study.sweeps import Settings
from autdtorch.utils.files import replacing

SUMMARY_FILE = "summary.csv"

_COLUMNS: dict[str, Callable[[MethodResult, float], float | None]] = {
    "trials": lambda method, _: method.trials,
    "median score [Pa]": lambda method, bound: bound_gap(method, bound).score.value,
    "best score [Pa]": lambda method, _: float(method.solution.score.max()),
    "bound [Pa]": lambda _, bound: bound,
    "gap to the bound": lambda method, bound: bound_gap(method, bound).gap.value,
    "mean of the foci [Pa]": lambda method, _: float(method.metrics.mean.mean()),
    "std among the foci [Pa]": lambda method, _: float(method.metrics.std.mean()),
    "area a focus [m^2]": lambda method, _: (
        None if method.metrics.area is None else float(method.metrics.area.mean())
    ),
    "evaluations": lambda method, _: float(method.solution.evaluations.double().mean()),
    "median seconds a trial": lambda method, _: float(method.seconds.median()),
}


def save_summary(
    results: StudyResult, swept: Mapping[tuple[str, str], Settings], path: str | os.PathLike[str]
) -> None:
    """Write a CSV table, one line for each method in each scene.

    The swept settings, by names of scene and method, are columns and are left out of the names.
    """
    keys = sorted({key for settings in swept.values() for key in settings})
    with replacing(Path(path)) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(["scene", "method", *keys, *_COLUMNS])
        for name, scene in results.scenes.items():
            for method, result in scene.methods.items():
                settings = swept[name, method]
                numbers = [column(result, scene.bound) for column in _COLUMNS.values()]
                names = (full.partition(",")[0] for full in (name, method))
                lines.writerow([*names, *(settings.get(key) for key in keys), *numbers])
