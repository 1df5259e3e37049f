"""The studies of a sweep, merged into one: scenes and methods side by side, trials of all seeds together."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import torch

from autdtorch.io.scene_file import load_scene
from autdtorch.io.yaml_file import parse_yaml, unresolved
from autdtorch.methods.catalogue import METHODS
from autdtorch.methods.solution import Solution, joined
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.scene.scene import Scene
from autdtorch.study.folder import PREVIOUS
from autdtorch.study.provenance import PROVENANCE_FILE
from autdtorch.study.results import MethodResult, SceneResult, StudyResult, median_trial
from autdtorch.study.results_file import RESULTS_FILE, load_results
from autdtorch.utils.digest import digest_of
from autdtorch.utils.validation import members, path_of

logger = logging.getLogger(__name__)

Settings: TypeAlias = Mapping[str, Any]
"""Flat, by dotted keys such as ``solver.spacing``."""

_Named: TypeAlias = tuple[str, Settings]

_METHODS = list(METHODS)
_FILES = "files"  # digests of what the settings name only by the path of a file
_LONGEST_NAME = 100  # of a scene or a method; it becomes part of the names of files


@dataclass(frozen=True, eq=False)
class Sweep:
    """The studies of a sweep as one.

    Attributes:
        results: of all studies. What was swept beside scene, method and seed is part of the names, such as
            ``gabs,levels=8``. The provenance is that of the first study, with the settings of all.
        scenes: the scenes of the results, by the same names.
        swept: the settings that tell names apart, by name of scene and name of method.
        studies: how many were merged.
        seeds: of these, each once.
    """

    results: StudyResult
    scenes: dict[str, Scene]
    swept: dict[tuple[str, str], Settings]
    studies: int
    seeds: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Part:
    """What one study found with one method in one scene, and the settings that it depends on."""

    scene: str
    method: str
    section: Mapping[str, Any]
    place: Settings
    search: Settings
    seed: int
    found: SceneResult

    @property
    def result(self) -> MethodResult:
        return self.found.methods[self.method]


def collect_results(folder: str | os.PathLike[str], modules: Collection[str] = ()) -> Sweep:
    """Merge the studies in a folder and in the folders below it, such as those that a sweep left.

    Studies that differ in nothing but seed and number of trials are taken as one, with the trials of all
    seeds; a method without random choices keeps one trial. Studies that are not finished are left out, and
    logged.

    Args:
        folder: where to look.
        modules: names of trusted modules, whose obstacles scenes may name by `_target_`; see `load_scene`.

    Returns:
        The merged studies.

    Raises:
        FileNotFoundError: there is no such folder, no finished study in it, or a file that a scene names
            is not there (paths start from the working directory, as they did for the sweep).
        ValueError: results of another version, or of a study that did not come from the command line.
    """
    folder, modules = path_of("folder", folder, "a folder"), members("modules", modules, str)
    _log_unfinished(folder)
    studies = {file.parent: load_results(file) for file in _files(folder, RESULTS_FILE)}
    if not studies:
        raise FileNotFoundError(f"{folder}: no finished study ({RESULTS_FILE}) there or below")
    if len({study.provenance.source_digest for study in studies.values()}) > 1:
        logger.warning("%s: the studies were made with different versions of the source", folder)
    first: dict[str, Path] = {}
    for path, study in studies.items():
        if (other := first.setdefault(study.provenance.origin, path)) != path:
            logger.warning("%s: the same study as %s, counted once", path, other)
    parts = [part for path, study in studies.items() for part in _parts(path, study)]
    groups, swept = _groups(parts)
    results = {scene: _merged_scene(methods) for scene, methods in groups.items()}
    sections = {scene: next(iter(methods.values()))[0].section for scene, methods in groups.items()}
    scenes = {scene: load_scene(section, modules) for scene, section in sections.items()}
    origin = next(iter(studies.values())).provenance
    texts = (f"# {path}\n{study.provenance.config.strip()}" for path, study in studies.items())
    merged = StudyResult(replace(origin, config="\n\n".join(texts)), results)
    return Sweep(merged, scenes, swept, len(studies), tuple(sorted({part.seed for part in parts})))


def _files(folder: Path, name: str) -> list[Path]:
    """Files of that name in the folder and below, but for those of earlier studies."""
    return sorted(file for file in folder.rglob(name) if not file.parent.name.startswith(PREVIOUS))


def _log_unfinished(folder: Path) -> None:
    for file in _files(folder, PROVENANCE_FILE):
        if not file.with_name(RESULTS_FILE).exists():
            logger.warning("%s: not finished, left out; the command that began it goes on", file.parent)


def _parts(path: Path, study: StudyResult) -> list[_Part]:
    where = f"{path / RESULTS_FILE}: settings"
    settings = unresolved(parse_yaml(study.provenance.config, where), where)
    try:
        return list(_parts_by(settings, path, study))
    except (KeyError, TypeError, AttributeError) as error:
        accepted = "must come from the command line"
        raise ValueError(f"{path / RESULTS_FILE}: no settings of a study in it; {accepted}") from error


def _parts_by(settings: Any, path: Path, study: StudyResult) -> Iterator[_Part]:
    if missing := [name for name in settings.get("scenes", ()) if name not in study.scenes]:
        logger.warning("%s: scenes that are not finished are left out: %s", path, ", ".join(missing))
    common = {key: settings[key] for key in ("solver", "plane_spacing") if key in settings}
    for name, found in study.scenes.items():
        section = settings["scenes"][name] if "scenes" in settings else settings["scene"]
        place = dict(_flat({"scene": section, _FILES: settings.get(_FILES, {}).get(name), **common}))
        for method in found.methods:
            search = settings["methods"][method] if "methods" in settings else settings["method"]
            flat = dict(_flat({"method": search}))
            yield _Part(name, method, section, place, flat, study.provenance.seed, found)


def _flat(value: object, key: str = "") -> Iterator[tuple[str, Any]]:
    items: Iterable[tuple[object, object]]
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
        items = enumerate(value)
    else:
        yield key, [_whole(entry) for entry in value] if isinstance(value, list) else _whole(value)
        return
    for name, entry in items:
        yield from _flat(entry, f"{key}.{name}" if key else str(name))


def _whole(value: object) -> object:
    """A whole number as an int, so that 4 and 4.0 are alike also to the eye."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _groups(
    parts: Sequence[_Part],
) -> tuple[dict[str, dict[str, list[_Part]]], dict[tuple[str, str], Settings]]:
    """Parts of the same settings, by scene and method, and the settings that make their names."""
    places = _told_apart([(part.scene, part.place) for part in parts])
    searches = _told_apart([(part.method, part.search) for part in parts])
    groups: dict[str, dict[str, list[_Part]]] = {}
    swept: dict[tuple[str, str], Settings] = {}
    named = zip(_names(places), _names(searches), places, searches, parts, strict=True)
    for scene, method, (_, place), (_, search), part in sorted(named, key=_rank):
        groups.setdefault(scene, {}).setdefault(method, []).append(part)
        swept[scene, method] = {**place, **search}
    return groups, swept


def _rank(named: tuple[str, str, _Named, _Named, _Part]) -> tuple[object, ...]:
    """Scenes by name, methods in the order of ours, and each in the order of what was swept."""
    _, _, (scene, place), (method, search), _ = named
    rank = _METHODS.index(method) if method in _METHODS else len(_METHODS)
    return scene, _order(place), rank, method, _order(search)


def _order(settings: Settings) -> list[tuple[str, bool, float, str]]:
    """For sorting: numbers by their size, and before all else."""
    return [
        (key, False, value, "") if isinstance(value, int | float) else (key, True, 0.0, str(value))
        for key, value in sorted(settings.items())
    ]


def _told_apart(named: Sequence[_Named]) -> list[_Named]:
    """The same names with those settings alone in which others of the name are not all alike."""
    first: dict[str, Settings] = {}
    varying: dict[str, set[str]] = {}
    for name, settings in named:
        other = first.setdefault(name, settings)
        keys = settings.keys() | other.keys()
        varying.setdefault(name, set()).update(key for key in keys if settings.get(key) != other.get(key))
    return [
        (name, {key: value for key, value in settings.items() if key in varying[name]})
        for name, settings in named
    ]


def _names(named: Sequence[_Named]) -> list[str]:
    """The names with what was swept, different where that is, in characters that names of files can have."""
    names = [_name(name, swept) for name, swept in named]
    digests = [digest_of(sorted(swept.items()))[:8] for _, swept in named]
    bearers: dict[str, set[str]] = {}
    for name, digest in zip(names, digests, strict=True):
        bearers.setdefault(name, set()).add(digest)
    return [
        f"{name[:_LONGEST_NAME]}-{digest}" if len(name) > _LONGEST_NAME or len(bearers[name]) > 1 else name
        for name, digest in zip(names, digests, strict=True)
    ]


def _name(name: str, swept: Settings) -> str:
    shown = {key: value for key, value in swept.items() if key != _FILES}  # of which the paths say more
    ends = [key.rpartition(".")[2] for key in shown]
    alone = [ends.count(end) == 1 and end != "method" for end in ends]  # the solver has a method too
    keys = [end if short else key for key, end, short in zip(shown, ends, alone, strict=True)]
    values = ("x".join(map(str, value)) if isinstance(value, list) else value for value in shown.values())
    swept_to = (f"{_word(key)}={_word(value)}" for key, value in zip(keys, values, strict=True))
    return ",".join([name, *swept_to])


def _word(text: object) -> str:
    """A text in characters that names of files can have, in one byte each."""
    return re.sub(r"[^\w.+-]+", "_", str(text), flags=re.ASCII).strip("_")


def _merged_scene(methods: Mapping[str, Sequence[_Part]]) -> SceneResult:
    found = [part.found for same in methods.values() for part in same]
    simulated = max((scene.simulation for scene in found), key=lambda simulation: len(simulation.runs))
    results = {name: _merged_trials(same) for name, same in methods.items()}
    return replace(found[0], simulation=simulated, methods=results)


def _merged_trials(parts: Sequence[_Part]) -> MethodResult:
    """The trials of all seeds, of a seed those of the longest study."""
    by_seed = {
        part.seed: part.result for part in sorted(parts, key=lambda part: (part.seed, part.result.trials))
    }
    kept = list(by_seed.values())
    if all(_same_trials(kept[0].solution, other.solution) for other in kept[1:]):
        kept = kept[:1]  # no chance in it
    solution = joined([result.solution for result in kept])
    metrics = _joined_metrics([result.metrics for result in kept])
    # A study keeps the observation plane of one trial: of those, the one nearest to the median is shown.
    median = float(solution.score[median_trial(solution.score)])
    shown = [float(result.solution.score[result.shown_trial]) for result in kept]
    nearest = min(range(len(kept)), key=lambda index: abs(shown[index] - median))
    before = sum(result.trials for result in kept[:nearest])
    return MethodResult(
        solution,
        metrics,
        torch.cat([result.seconds for result in kept]),
        before + kept[nearest].shown_trial,
        kept[nearest].plane_pressure,
    )


def _same_trials(one: Solution, other: Solution) -> bool:
    """Whether all is alike that was tried, not only what was found."""
    return torch.equal(one.drive, other.drive) and torch.equal(one.history, other.history)


def _joined_metrics(metrics: Sequence[FocusMetrics]) -> FocusMetrics:
    names = ("mean", "min", "std", "uniformity")
    areas = [area for each in metrics if (area := each.area) is not None]
    return FocusMetrics(
        **{name: torch.cat([getattr(each, name) for each in metrics]) for name in names},
        area=torch.cat(areas) if len(areas) == len(metrics) else None,
    )
