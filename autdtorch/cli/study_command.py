"""A study, or one run of it: settings in, results in a folder, a table on stdout."""

from __future__ import annotations

import hashlib
import os
import shlex
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from autdtorch.cli.settings import folder_of, is_given, scene_of, section_of, solver_of

if TYPE_CHECKING:
    from autdtorch.scene.scene import Scene
    from autdtorch.study.results import StudyResult
    from autdtorch.study.run import StudyMethod

    _Parts: TypeAlias = tuple[dict[str, Scene], dict[str, StudyMethod]]

PLANE_FILE = "plane.png"


def study(settings: dict[str, Any], modules: list[Any], output: Any, sweep: Path | None) -> None:
    """Run a study; `sweep` is the folder of the sweep that the job belongs to, if any."""
    from autdtorch.propagators import CACHE_VARIABLE
    from autdtorch.study.run import run_study

    solver = solver_of(settings)
    if sweep is None:
        folder = folder_of("output", output)
    else:
        folder = Path(HydraConfig.get().runtime.output_dir)
        if is_given("output"):
            raise ValueError(f"output: {output}; a sweep has a folder for each job in hydra.sweep.dir")
        if solver.get("cache") is None and CACHE_VARIABLE not in os.environ:
            solver["cache"] = sweep / "matrices"  # jobs in the same scene share them
    settings["solver"] = {key: value for key, value in solver.items() if key != "cache"}  # changes no result
    single = "scenes" not in settings
    scenes, methods = (_single if single else _experiment)(settings, modules)
    results = run_study(
        scenes,
        methods,
        solver=solver,
        **{key: settings[key] for key in ("trials", "seed", "plane_spacing") if key in settings},
        folder=folder,
        config=_as_text(settings, scenes),
    )
    _show(results, scenes, folder, single)


def print_table(results: StudyResult, *more: str) -> None:
    """Print the table of results and further lines."""
    from autdtorch.study.results import summary_rows

    rows = summary_rows(results)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    # At once, so that lines of other jobs of a sweep do not come between.
    sys.stdout.write("".join(f"{line}\n" for line in (*lines, *more)))
    sys.stdout.flush()


def _single(settings: Mapping[str, Any], modules: list[Any]) -> _Parts:
    """Return the one scene and the one method, each by its name."""
    from autdtorch.cli.method_section import load_method
    from autdtorch.study.run import name_of

    scene = scene_of("scene", section_of(settings, "scene"), modules)
    method = load_method("method", section_of(settings, "method"), modules)
    return {HydraConfig.get().runtime.choices["scene"]: scene}, {name_of(method): method}


def _experiment(settings: Mapping[str, Any], modules: list[Any]) -> _Parts:
    """Return the scenes and the methods of an experiment, by name."""
    from autdtorch.cli.method_section import load_method

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
    """Return the settings as YAML, with digests of the files that they name."""
    sections = settings["scenes"] if "scenes" in settings else dict.fromkeys(scenes, settings["scene"])
    files = {name: digests for name, section in sections.items() if (digests := list(_file_digests(section)))}
    return OmegaConf.to_yaml(OmegaConf.create({**settings, **({"files": files} if files else {})}))


def _file_digests(section: Mapping[str, Any]) -> Iterator[str]:
    """Yield digests of the files of the array and of the obstacles of a scene."""
    for part in (section["array"], *(section.get("obstacles") or ())):
        if part.get("path") is not None:
            yield hashlib.sha256(Path(part["path"]).read_bytes()).hexdigest()[:16]


def _show(results: StudyResult, scenes: Mapping[str, Scene], folder: Path, single: bool) -> None:
    """Print the table of results; draw the plane of a single run, write the report of an experiment."""
    from autdtorch.plot.pressure_maps import plot_plane
    from autdtorch.study.report.study_report import write_report

    # A relative path is shorter, and the same on every machine.
    shown = Path(os.path.relpath(folder))
    if not single:
        report = write_report(results, scenes, folder, shlex.join(["autdtorch", *sys.argv[1:]]))
        print_table(results, f"The report is {shown / report.name}")
        return
    (scene,) = scenes.values()
    (result,) = results.scenes.values()
    (method,) = result.methods.values()
    if method.plane_pressure is not None and scene.observation_plane is not None:
        seen = scene.observation_plane, scene.control_points, scene.obstacles
        plot_plane(method.plane_pressure, *seen).savefig(folder / PLANE_FILE)
    print_table(results, f"The results are in {shown}")
