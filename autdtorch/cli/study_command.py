"""Studies: a run, an experiment or a path of poses, with a table on stdout; `collect` merges several."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from autdtorch.cli.settings import folder_of, is_given, load_method, scene_of, section_of, solver_of
from autdtorch.hardware import DEVICES
from autdtorch.io.drive_file import save_drive
from autdtorch.io.goal_section import goal_label, load_goal
from autdtorch.methods.catalogue import label_of
from autdtorch.propagators import CACHE_VARIABLE
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.moving import angles_of
from autdtorch.scene.scene import Scene
from autdtorch.study.folder import drive_files
from autdtorch.study.results import MethodResult, StudyResult, summary_rows, with_prefixes
from autdtorch.study.run_study import run_study
from autdtorch.study.study_method import StudyMethod, name_of
from autdtorch.utils.array_types import Array
from autdtorch.utils.text import counted, in_digits
from autdtorch.utils.units import angles
from autdtorch.utils.validation import (
    finite_vector,
    integer_at_least,
    invalid,
    require_known,
    require_one_of,
    within,
)

_HELP = """autdtorch collect FOLDER [modules=NAME]

Merges the finished studies in a folder and below it, such as those of a sweep in multirun, into one table
(summary.csv) and one report (report.md, report.html), which are written there. modules=NAME allows obstacles
of one's own, which the module NAME defines."""

_POSE_KEYS = ("offset", "rotation", "rotation_degrees", "count")
_MOST_POSES = 10_000


def study(
    settings: dict[str, Any], modules: list[Any], output: Any, sweep: Path | None, drive: Any = None
) -> None:
    """Run a study.

    Args:
        settings: of the study.
        modules: that the user trusts.
        output: folder of the results, outside a sweep.
        sweep: the folder of the sweep that the job belongs to, if any.
        drive: "full" or the name of a device, to write the best drives to files; None for no files.
    """
    solver = solver_of(settings)
    folder = folder_of("output", output) if sweep is None else Path(HydraConfig.get().runtime.output_dir)
    if solver.get("cache") is None and CACHE_VARIABLE not in os.environ:
        # A study that goes on needs them again, and jobs or runs of several methods in one scene share them.
        usual = folder if is_given("output") or len(folder.parts) == 1 else folder.parent
        solver["cache"] = (sweep or usual) / "matrices"
    settings["solver"] = {key: value for key, value in solver.items() if key != "cache"}  # changes no result
    poses = None if settings.get("poses") is None else _along_path(settings)
    scenes, methods = _parts(settings, modules)
    goal = load_goal("goal", settings.get("goal"))
    device = _device_of(drive, scenes)
    results = run_study(
        scenes,
        methods,
        solver=solver,
        **{key: settings[key] for key in ("trials", "seed", "plane_spacing") if key in settings},
        folder=folder,
        goal=goal,
        config=_as_text(settings, scenes),
        poses=poses is not None,
        scenarios=None if settings.get("scenarios") is None else section_of(settings, "scenarios"),
    )
    if drive is not None:
        _save_drives(results, scenes, folder, device)
    shown = Path(os.path.relpath(folder))  # shorter, and equal on every machine
    if poses is not None:
        _draw_poses(results, poses, folder)
        _print_table(results, f"The results are in {_quoted(shown)}")
    elif "scenes" not in settings:
        _draw_plane(results, scenes, folder)
        _print_table(results, f"The results are in {_quoted(shown)}")
    else:
        from autdtorch.study.report.study_report import write_report

        report = write_report(results, scenes, folder, shlex.join(["autdtorch", *sys.argv[1:]]))
        _print_table(results, f"The report is {_quoted(shown / report.name)}")


def collect(arguments: list[str]) -> None:
    """Merge the studies of the folder that the arguments name."""
    from autdtorch.study.report.study_report import write_report
    from autdtorch.study.report.tables import SUMMARY_FILE, save_summary
    from autdtorch.study.sweeps import collect_results

    if {"-h", "--help"} & set(arguments):
        print(_HELP)
        return
    modules = [word.removeprefix("modules=") for word in arguments if word.startswith("modules=")]
    folders = [word for word in arguments if not word.startswith("modules=")]
    wrong = [word for word in folders if re.match(r"-|.*=", word) and not Path(word).exists()]
    if len(folders) != 1 or wrong:
        raise ValueError(f"collect: {shlex.join(arguments)!r}; must be one folder, such as multirun")
    logging.basicConfig(format="%(message)s")
    folder = Path(folders[0])
    sweep = collect_results(folder, modules)
    save_summary(sweep, folder / SUMMARY_FILE)
    command = shlex.join(["autdtorch", "collect", *arguments])
    report = write_report(sweep.results, sweep.scenes, folder, command, sweep.seeds, sweep.unfinished)
    count = counted(sweep.studies, "study", "studies")
    files = f"the table is {_quoted(folder / SUMMARY_FILE)}, the report {_quoted(report)}"
    _print_table(sweep.results, f"{count}: {files}")


def _parts(
    settings: Mapping[str, Any], modules: list[Any]
) -> tuple[dict[str, Scene], dict[str, StudyMethod]]:
    """Return scenes and methods by name: the one of each, or those of an experiment."""
    if "scenes" not in settings:
        scene = scene_of("scene", section_of(settings, "scene"), modules)
        method = load_method("method", section_of(settings, "method"), modules)
        return {HydraConfig.get().runtime.choices["scene"]: scene}, {name_of(method): method}
    for key in ("scene", "method"):
        if key in settings:
            names = ", ".join(section_of(settings, f"{key}s"))
            raise ValueError(f"{key}: given beside an experiment, which has its own {key}s: {names}")
    parts = section_of(settings, "scenes")
    scenes = {name: scene_of(f"scenes.{name}", part, modules) for name, part in parts.items()}
    sections = section_of(settings, "methods")
    methods = {name: load_method(f"methods.{name}", section_of(sections, name), modules) for name in sections}
    return scenes, methods


def _as_text(settings: Mapping[str, Any], scenes: Mapping[str, Scene]) -> str:
    """Return the settings as YAML, with digests of the files of arrays and obstacles that scenes name."""
    sections = settings["scenes"] if "scenes" in settings else dict.fromkeys(scenes, settings["scene"])
    files = {}
    for name, section in sections.items():
        boards = [section["array"]] if isinstance(section["array"], Mapping) else section["array"]
        parts = (*boards, *(section.get("obstacles") or ()))
        paths = [Path(part["path"]) for part in parts if part.get("path") is not None]
        if paths:
            files[name] = [hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in paths]
    return OmegaConf.to_yaml(OmegaConf.create({**settings, **({"files": files} if files else {})}))


def _device_of(drive: Any, scenes: Mapping[str, Scene]) -> str | None:
    """Return the device whose levels the files of drives have; None for full precision."""
    if drive is None or drive == "full":
        return None
    require_one_of("drive", drive, ("full", *DEVICES))
    for name, scene in scenes.items():
        if len(scene.array) % (board := DEVICES[drive].board):
            count = f"{len(scene.array)} transducers of the scene {name}"
            raise ValueError(f"drive: {drive!r}, {count}; must be a multiple of {board}, or drive=full")
    return str(drive)


def _save_drives(results: StudyResult, scenes: Mapping[str, Scene], folder: Path, device: str | None) -> None:
    """Write the drive of the best trial of each method in each scene."""
    for (name, method), file in drive_files(results).items():
        solution = results.scenes[name].methods[method].solution
        best = solution.drive[int(solution.score.argmax())]
        save_drive(folder / file, best, scenes[name].array, device)


def _draw_plane(results: StudyResult, scenes: Mapping[str, Scene], folder: Path) -> None:
    from autdtorch.plot.plane_maps import plot_plane
    from autdtorch.plot.style import readable

    ((name, scene),) = scenes.items()
    (result,) = results.scenes.values()
    ((label, method),) = result.methods.items()
    if method.plane_pressure is not None and scene.observation_plane is not None:
        seen = scene.observation_plane, scene.control_points, scene.obstacles
        score = result.in_unit(in_digits(float(method.solution.score[method.shown_trial]), 3))
        title = f"{readable(name)}, {label_of(label)}\n{goal_label(result.goal)} {score}{_shown_of(method)}"
        figure = plot_plane(method.plane_pressure, *seen, reflectors=scene.reflectors, title=title)
        figure.savefig(folder / "plane.png")


def _shown_of(method: MethodResult) -> str:
    """Return which of its trials is shown, for a title; nothing of a single one."""
    if method.trials == 1:
        return ""
    which = "median" if method.trials % 2 else "one next to the median"
    return f", {which} of {method.trials} trials"


def _draw_poses(results: StudyResult, poses: Poses, folder: Path) -> None:
    from autdtorch.plot.trials import plot_poses

    outcomes = list(with_prefixes(results).scenes.values())
    scores = {
        name: torch.stack([scene.methods[name].solution.score for scene in outcomes])
        for name in outcomes[0].methods
    }
    bounds = [scene.bound for scene in outcomes]
    plot_poses(scores, poses.places, poses.label, outcomes[0].score_label, bounds).savefig(
        folder / "poses.png"
    )


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def _print_table(results: StudyResult, end: str) -> None:
    rows = summary_rows(results)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    # At once, so that lines of other jobs of a sweep do not come between.
    sys.stdout.write("".join(f"{line}\n" for line in (*lines, end)))
    sys.stdout.flush()


class Poses(NamedTuple):
    """Places along a path, in mm, or in degrees where the obstacles only turn."""

    places: Array
    label: str


def _along_path(settings: dict[str, Any]) -> Poses:
    """Replace scene and method in the settings by an experiment with a scene for each pose.

    The path begins at the pose of the scene. The last pose is moved by `offset` and turned by `rotation` from
    there. Shifts and angles between are evenly spaced.

    Raises:
        ValueError: a setting of `poses` that is unknown or out of range, or an experiment beside it.
    """
    poses = section_of(settings, "poses")
    require_known("poses", poses, _POSE_KEYS)
    if "scenes" in settings:
        raise invalid("poses", poses, "must not be given beside an experiment")
    with within("poses"):
        offset = np.array(finite_vector("offset", poses.get("offset", (0, 0, 0))))
        rotation = _turn("", poses)
        count = integer_at_least("count", poses.get("count"), 2)
        if count > _MOST_POSES:
            raise invalid("count", count, f"must be at most {_MOST_POSES}")
        if not (offset.any() or rotation.any()):
            raise invalid(
                "offset", offset.tolist(), "must move the obstacles, or rotation must turn them", "m"
            )
    scene, chosen = section_of(settings, "scene"), HydraConfig.get().runtime.choices
    first = section_of(scene, "pose") if scene.get("pose") else {}
    require_known("scene.pose", first, _POSE_KEYS[:3])
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
