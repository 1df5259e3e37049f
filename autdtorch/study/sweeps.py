"""Merge the studies of a sweep into one, with the trials of all seeds."""

from __future__ import annotations

import json
import logging
import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import torch

from autdtorch.io.scene_file import load_scene
from autdtorch.io.yaml_file import parse_yaml, unresolved
from autdtorch.methods.catalogue import METHODS
from autdtorch.methods.solution import joined
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.scene.scene import Scene
from autdtorch.study.folder import PREVIOUS
from autdtorch.study.results import PROVENANCE_FILE, MethodResult, SceneResult, StudyResult, median_trial
from autdtorch.study.results_file import RESULTS_FILE, load_results
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import path_of
from autdtorch.utils.validation import members

logger = logging.getLogger(__name__)

Settings: TypeAlias = Mapping[str, Any]
"""Settings by dotted keys, such as ``solver.spacing``."""

_FILES = "files"  # key of the digests of files that the settings name by their paths
_LONGEST_NAME = 100  # bytes of a scene's or method's name, which becomes part of file names


@dataclass(frozen=True, eq=False)
class Sweep:
    """The merged studies of a sweep.

    Attributes:
        results: results of all studies. Swept settings other than scene, method and seed are part of the
            names, such as ``gabs,levels=8``. The provenance is from the first study, with all settings.
        scenes: the scenes of the results, by the same names.
        swept: settings that differ between equal names, by names of scene and method.
        studies: number of studies.
        seeds: seeds of the studies, each once.
        unfinished: studies and scenes that were left out, by their folders.
    """

    results: StudyResult
    scenes: dict[str, Scene]
    swept: dict[tuple[str, str], Settings]
    studies: int
    seeds: tuple[int, ...]
    unfinished: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Part:
    """The result of one method in one scene of one study, and the settings that it depends on."""

    scene: str
    method: str
    section: Mapping[str, Any]  # the scene's settings as in YAML
    scene_settings: Settings
    method_settings: Settings
    seed: int
    in_scene: SceneResult

    @property
    def result(self) -> MethodResult:
        return self.in_scene.methods[self.method]


def collect_results(folder: str | os.PathLike[str], modules: Collection[str] = ()) -> Sweep:
    """Merge the studies in a folder and its subfolders, such as those of a sweep.

    Studies that differ only in seed and number of trials become one, with the trials of all seeds. A method
    without random choices keeps one trial. Unfinished studies are left out, with a warning.

    Args:
        folder: folder of the studies.
        modules: names of trusted modules, whose obstacles scenes may name by `_target_`; see `load_scene`.

    Raises:
        FileNotFoundError: no such folder, no finished study in it, or no file of a name in a scene's settings
            (its path starts from the working directory, as in the sweep).
        ValueError: results of another version, or of a study that was not run from the command line.
    """
    folder, modules = path_of("folder", folder, "a folder"), members("modules", modules, str)
    started = [file.parent for file in _files(folder, PROVENANCE_FILE)]
    unfinished = [str(path) for path in started if not (path / RESULTS_FILE).exists()]
    for name in unfinished:
        logger.warning("%s: not finished, left out; repeat its command to finish it", name)
    studies = {file.parent: load_results(file) for file in _files(folder, RESULTS_FILE)}
    if not studies:
        raise FileNotFoundError(f"{folder}: no finished study ({RESULTS_FILE}) there or below")
    if len({study.provenance.source_digest for study in studies.values()}) > 1:
        logger.warning("%s: the studies were made with different versions of the source", folder)
    first: dict[str, Path] = {}
    for path, study in studies.items():
        if (other := first.setdefault(study.provenance.origin, path)) != path:
            logger.warning("%s: a copy of the study in %s, counted once", path, other)
    parts: list[_Part] = []
    settings = {path: _settings_of(path, study) for path, study in studies.items()}
    for path, study in studies.items():
        finished, missing = _parts(path, study, settings[path])
        parts += finished
        unfinished += [f"{path}: {scene}" for scene in missing]
    groups, swept = _groups(parts)
    results = {scene: _merged_scene(methods) for scene, methods in groups.items()}
    sections = {scene: next(iter(methods.values()))[0].section for scene, methods in groups.items()}
    scenes = {scene: load_scene(section, modules) for scene, section in sections.items()}
    origin = next(iter(studies.values())).provenance
    merged = StudyResult(replace(origin, config=_text_of(studies, settings)), results)
    seeds = sorted({part.seed for part in parts})
    return Sweep(merged, scenes, swept, len(studies), tuple(seeds), tuple(unfinished))


def _files(folder: Path, name: str) -> list[Path]:
    """Return the files of a name in the folder and below, except those of earlier studies."""
    return sorted(file for file in folder.rglob(name) if not file.parent.name.startswith(PREVIOUS))


def _settings_of(path: Path, study: StudyResult) -> Any:
    """Return the settings of the study in a folder, as its file has them."""
    where = f"{path / RESULTS_FILE}: settings"
    return unresolved(parse_yaml(study.provenance.config, where), where)


def _text_of(studies: Mapping[Path, StudyResult], settings: Mapping[Path, Any]) -> str:
    """Return the settings of the first study as its file has them, and of the others what differs."""
    (first, of_first), *others = ((path, dict(_flat(each))) for path, each in settings.items())
    texts = [f"# {first}\n{studies[first].provenance.config.strip()}"]
    for path, each in others:
        keys = [key for key in {**of_first, **each} if of_first.get(key, ...) != each.get(key, ...)]
        lines = [f"{key}: {_as_yaml(each[key]) if key in each else '(left out)'}" for key in keys]
        texts.append("\n".join([f"# {path}, otherwise like {first}", *lines]))
    return "\n\n".join(texts)


def _as_yaml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, default=str)


def _parts(path: Path, study: StudyResult, settings: Any) -> tuple[list[_Part], list[str]]:
    """Return the parts of a study of some settings, and the scenes that it has not finished."""
    file = path / RESULTS_FILE
    try:
        if missing := [name for name in settings.get("scenes", ()) if name not in study.scenes]:
            logger.warning("%s: unfinished scenes are left out: %s", path, ", ".join(missing))
        common = {key: settings[key] for key in ("solver", "plane_spacing") if key in settings}
        parts = []
        for name, result in study.scenes.items():
            section = settings["scenes"][name] if "scenes" in settings else settings["scene"]
            files = settings.get(_FILES, {}).get(name)
            of_scene = dict(_flat({"scene": section, _FILES: files, **common}))
            of_scene |= dict(_flat_goal(result.goal))
            for method in result.methods:
                chosen = settings["methods"][method] if "methods" in settings else settings["method"]
                of_method = dict(_flat({"method": chosen}))
                seed = study.provenance.seed
                parts.append(_Part(name, method, section, of_scene, of_method, seed, result))
        return parts, missing
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: no settings of a study; must come from the command line") from error


def _flat(value: object, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
        value = dict(enumerate(value))
    if isinstance(value, dict):
        for name, entry in value.items():
            yield from _flat(entry, f"{key}.{name}" if key else str(name))
    else:
        yield key, [_whole(entry) for entry in value] if isinstance(value, list) else _whole(value)


def _flat_goal(goal: Mapping[str, Any], key: str = "goal") -> Iterator[tuple[str, Any]]:
    """Yield the name of a goal as ``goal``, and its settings as ``goal.targets``."""
    yield key, goal["name"]
    for name, entry in goal.items():
        if isinstance(entry, dict) and "name" in entry:
            yield from _flat_goal(entry, f"{key}.{name}")
        elif name != "name":
            yield from _flat(entry, f"{key}.{name}")


def _whole(value: object) -> object:
    """Return a whole number as an int, so that 4 and 4.0 are equal also as text."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _groups(
    parts: Sequence[_Part],
) -> tuple[dict[str, dict[str, list[_Part]]], dict[tuple[str, str], Settings]]:
    """Group parts of equal settings by new names of scene and method; return also the swept settings."""
    scenes = _swept([(part.scene, part.scene_settings) for part in parts])
    methods = _swept([(part.method, part.method_settings) for part in parts])
    order = {method: place for place, method in enumerate(METHODS)}

    def rank(index: int) -> tuple[object, ...]:
        """Sort by scene, then by our order of methods, each by its swept settings."""
        (scene, of_scene), (method, of_method) = scenes[index], methods[index]
        return scene, _order(of_scene), order.get(method, len(order)), method, _order(of_method)

    groups: dict[str, dict[str, list[_Part]]] = {}
    swept: dict[tuple[str, str], Settings] = {}
    scene_names, method_names = _names(scenes), _names(methods)
    for index in sorted(range(len(parts)), key=rank):
        scene, method = scene_names[index], method_names[index]
        groups.setdefault(scene, {}).setdefault(method, []).append(parts[index])
        swept[scene, method] = {**scenes[index][1], **methods[index][1]}
    return groups, swept


def _order(settings: Settings) -> list[tuple[str, bool, float, str]]:
    return [
        (key, False, value, "") if isinstance(value, int | float) else (key, True, 0.0, str(value))
        for key, value in sorted(settings.items())
    ]


def _swept(named: Sequence[tuple[str, Settings]]) -> list[tuple[str, Settings]]:
    """Keep only the settings that differ between entries of equal name."""
    first: dict[str, Settings] = {}
    varying: dict[str, set[str]] = {}
    for name, settings in named:
        other = first.setdefault(name, settings)
        keys = settings.keys() | other.keys()
        varying.setdefault(name, set()).update(key for key in keys if settings.get(key) != other.get(key))
    return [(name, {key: values[key] for key in values if key in varying[name]}) for name, values in named]


def _names(named: Sequence[tuple[str, Settings]]) -> list[str]:
    """Return names with the swept settings, distinct for distinct settings, fit for file names."""
    digested = [(_name(name, swept), digest_of(sorted(swept.items()))[:8]) for name, swept in named]
    bearers = Counter(name for name, _ in set(digested))
    return [
        f"{name[:_LONGEST_NAME]}-{digest}" if len(name) > _LONGEST_NAME or bearers[name] > 1 else name
        for name, digest in digested
    ]


def _name(name: str, swept: Settings) -> str:
    shown = {key: value for key, value in swept.items() if key != _FILES}  # paths say more
    ends = [key.rpartition(".")[2] for key in shown]
    alone = [ends.count(end) == 1 and end != "method" for end in ends]  # the solver has a method too
    keys = [end if short else key for key, end, short in zip(shown, ends, alone, strict=True)]
    values = (
        "x".join(map(str, value)) or "none" if isinstance(value, list) else value for value in shown.values()
    )
    swept_to = (f"{_word(key)}={_word(value)}" for key, value in zip(keys, values, strict=True))
    return ",".join([name, *swept_to])


def _word(text: object) -> str:
    """Return a text with only single-byte characters that file names can have."""
    return re.sub(r"[^\w.+-]+", "_", str(text), flags=re.ASCII).strip("_")


def _merged_scene(methods: Mapping[str, Sequence[_Part]]) -> SceneResult:
    scenes = [part.in_scene for same in methods.values() for part in same]
    simulated = max((scene.simulation for scene in scenes), key=lambda simulation: len(simulation.runs))
    results = {name: _merged_trials(same) for name, same in methods.items()}
    return replace(scenes[0], simulation=simulated, methods=results)


def _merged_trials(parts: Sequence[_Part]) -> MethodResult:
    """Join the trials of all seeds, for each seed those of its longest study."""
    longest = sorted(parts, key=lambda part: (part.seed, part.result.trials))
    by_seed = list({part.seed: part.result for part in longest}.values())
    first, *others = [result.solution for result in by_seed]
    if all(torch.equal(first.drive, it.drive) and torch.equal(first.history, it.history) for it in others):
        by_seed = by_seed[:1]  # the method makes no random choices
    solution = joined([result.solution for result in by_seed])
    # A study keeps the observation plane of one trial. The one nearest to the joint median is shown.
    median = float(solution.score[median_trial(solution.score)])
    shown = [float(result.solution.score[result.shown_trial]) for result in by_seed]
    nearest = min(range(len(by_seed)), key=lambda place: abs(shown[place] - median))
    return MethodResult(
        solution,
        _joined_metrics([result.metrics for result in by_seed]),
        torch.cat([result.seconds for result in by_seed]),
        sum(result.trials for result in by_seed[:nearest]) + by_seed[nearest].shown_trial,
        by_seed[nearest].plane_pressure,
    )


def _joined_metrics(every: Sequence[FocusMetrics | None]) -> FocusMetrics | None:
    metrics = [foci for foci in every if foci is not None]
    if not metrics:
        return None
    areas = [foci.area for foci in metrics if foci.area is not None]
    names = ("mean", "min", "std", "uniformity")
    joint = {name: torch.cat([getattr(foci, name) for foci in metrics]) for name in names}
    return FocusMetrics(**joint, area=torch.cat(areas) if len(areas) == len(metrics) else None)
