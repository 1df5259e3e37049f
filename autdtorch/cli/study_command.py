"""Studies: one run or an experiment, with a table on stdout, and `collect`, which merges several."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from autdtorch.cli.poses import Poses, along_path
from autdtorch.cli.settings import folder_of, is_given, load_method, scene_of, section_of, solver_of
from autdtorch.hardware import DEVICES
from autdtorch.io.drive_file import save_drive
from autdtorch.io.goal_section import load_goal
from autdtorch.propagators import CACHE_VARIABLE
from autdtorch.scene.scene import Scene
from autdtorch.study.results import StudyResult, summary_rows
from autdtorch.study.run import StudyMethod, name_of, run_study
from autdtorch.utils.display import counted
from autdtorch.utils.validation import require_one_of

_HELP = """autdtorch collect FOLDER [modules=NAME]

Merges the finished studies in a folder and below it, such as those of a sweep in multirun, into one table
(summary.csv) and one report (report.md, report.html), which are written there. modules=NAME allows obstacles
of one's own, which the module NAME defines."""


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
    poses = None if settings.get("poses") is None else along_path(settings)
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
    single = len(scenes) == 1 and all(len(scene.methods) == 1 for scene in results.scenes.values())
    for name, result in results.scenes.items():
        for method, own in result.methods.items():
            best = own.solution.drive[int(own.solution.score.argmax())]
            path = folder / ("drive.csv" if single else f"drive_{name}_{method}.csv")
            save_drive(path, best, scenes[name].array, device)


def _draw_plane(results: StudyResult, scenes: Mapping[str, Scene], folder: Path) -> None:
    """Draw the observation plane of a single run."""
    from autdtorch.plot.pressure_maps import plot_plane

    (scene,) = scenes.values()
    (result,) = results.scenes.values()
    (method,) = result.methods.values()
    if method.plane_pressure is not None and scene.observation_plane is not None:
        seen = scene.observation_plane, scene.control_points, scene.obstacles
        plot_plane(method.plane_pressure, *seen).savefig(folder / "plane.png")


def _draw_poses(results: StudyResult, poses: Poses, folder: Path) -> None:
    """Draw the scores along the path of the obstacles."""
    from autdtorch.plot.trials import plot_poses

    found = list(results.scenes.values())
    scores = {
        name: torch.stack([scene.methods[name].solution.score for scene in found])
        for name in found[0].methods
    }
    bounds = [scene.bound for scene in found]
    plot_poses(scores, poses.places, poses.label, found[0].score_label, bounds).savefig(folder / "poses.png")


def _quoted(path: Path) -> str:
    """Return a path as a shell takes it."""
    return shlex.quote(str(path))


def _print_table(results: StudyResult, end: str) -> None:
    """Print the table of results and a last line."""
    rows = summary_rows(results)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    # At once, so that lines of other jobs of a sweep do not come between.
    sys.stdout.write("".join(f"{line}\n" for line in (*lines, end)))
    sys.stdout.flush()
