"""The command line: ``autdtorch scene=three_cubes method=gabs``, ``autdtorch experiment=paper``.

The only module that knows Hydra, which reads the settings from ``configs/`` and from the command line. What
takes seconds to import is imported when a study starts, so that help is quick.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

import hydra
import hydra.utils
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

if TYPE_CHECKING:
    from autdtorch.results import StudyResult
    from autdtorch.scene import Scene

Method: TypeAlias = "functools.partial[Any]"

PLANE_FILE = "plane.png"

_REFUSED = 2
_REFUSALS = (ValueError, OSError, HydraException, OmegaConfBaseException)
_INTERRUPTED = 130  # as a shell reports a process that SIGINT ended
_NO_METHOD_SETTINGS = ("objective", "trials", "seed", "score")  # the first three are the study's to give
_FULL_ERROR = "HYDRA_FULL_ERROR"
_SETTINGS = ("scene", "method", "scenes", "methods", "solver", "trials", "seed", "plane_spacing", "output")

_HERE = Path(__file__).parent
# A wheel carries the configs inside the package, a checkout beside it.
CONFIGS = _HERE / "configs" if (_HERE / "configs").is_dir() else _HERE.parent / "configs"


class _Refusal(BaseException):
    """Carries its cause past Hydra, which would print a line of its own about any `Exception`."""

    def __init__(self, cause: Exception) -> None:
        super().__init__(cause)
        self.cause = cause


def main() -> None:
    """Run the command line.

    Raises:
        SystemExit: with status 2, after one line on stderr, where a setting is refused or a file cannot be
            written; with status 130 after Ctrl-C.
    """
    wanted = os.environ.get(_FULL_ERROR)
    os.environ[_FULL_ERROR] = "1"  # has Hydra pass exceptions on, where it would print them in its own way
    try:
        _run()
    except KeyboardInterrupt:
        _stop(_INTERRUPTED, "interrupted; finished trials are kept, and the same command goes on after them")
    except _Refusal as refusal:
        error = refusal.cause
    except _REFUSALS as refused:
        error = refused
    else:
        return
    finally:
        if wanted is None:
            del os.environ[_FULL_ERROR]
        else:
            os.environ[_FULL_ERROR] = wanted
    if wanted == "1":
        raise error
    _stop(_REFUSED, _in_one_line(error))


def _stop(status: int, line: str) -> NoReturn:
    print(f"autdtorch: {line}", file=sys.stderr)
    sys.exit(status)


def _in_one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    text = str(error)
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return f"{group}: {name!r}; must be one of {', '.join(error.options)}"
    # Hydra would advise to add the key, which we would then refuse.
    if unknown := re.match(r"Could not override '(.+)'", text):
        return f"{unknown[1]}: unknown key; autdtorch --help lists the settings"
    lines = [line.strip() for line in text.splitlines()]
    return "; ".join(line for line in lines if line and not line.startswith("See https://"))


@hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="config")
def _run(config: DictConfig) -> None:
    try:
        _study(config)
    except _REFUSALS as error:
        raise _Refusal(error) from error


def _study(config: DictConfig) -> None:
    from autdtorch.study import run_study

    settings: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    _require_known("settings", settings, _SETTINGS)
    folder = Path(HydraConfig.get().runtime.output_dir)
    solver = _solver(settings)
    del settings["output"]  # it is Hydra's folder by now, and changes no result
    settings["solver"] = {key: value for key, value in solver.items() if key != "cache"}  # nor does that
    single = "scenes" not in settings
    scenes, methods = _single(settings) if single else _experiment(settings)
    results = run_study(
        scenes,
        methods,
        solver=solver,
        **{key: settings[key] for key in ("trials", "seed", "plane_spacing") if key in settings},
        folder=folder,
        config=_as_text(settings, scenes),
    )
    _show(results, scenes, folder, single)


def _single(settings: Mapping[str, Any]) -> tuple[dict[str, Scene], dict[str, Method]]:
    """The one scene and the one method, each by its name."""
    scene = _scene("scene", _section(settings, "scene"))
    method = _method("method", _section(settings, "method"))
    return {HydraConfig.get().runtime.choices["scene"]: scene}, {method.func.__name__: method}


def _experiment(settings: Mapping[str, Any]) -> tuple[dict[str, Scene], dict[str, Method]]:
    """The scenes and the methods of an experiment, by name."""
    for key in ("scene", "method"):
        if key in settings:
            names = ", ".join(_section(settings, f"{key}s"))
            raise ValueError(f"{key}: given beside an experiment, which has its own {key}s: {names}")
    scenes = {name: _scene(f"scenes.{name}", part) for name, part in _section(settings, "scenes").items()}
    methods = {name: _method(f"methods.{name}", part) for name, part in _section(settings, "methods").items()}
    return scenes, methods


def _scene(where: str, section: Mapping[str, Any]) -> Scene:
    from autdtorch.scene_file import load_scene

    try:
        return load_scene(section)
    except ValueError as error:
        raise ValueError(f"{where}: {str(error).removeprefix('scene mapping: ')}") from error


def _as_text(settings: Mapping[str, Any], scenes: Mapping[str, Scene]) -> str:
    """The settings as YAML, and digests of what they name only by the path of a file."""
    from autdtorch.obstacles import Mesh, VoxelMask

    contents = {
        name: [obstacle.digest for obstacle in scene.obstacles if isinstance(obstacle, Mesh | VoxelMask)]
        for name, scene in scenes.items()
    }
    files = {name: digests for name, digests in contents.items() if digests}
    return OmegaConf.to_yaml(OmegaConf.create({**settings, **({"obstacle_files": files} if files else {})}))


def _solver(settings: Mapping[str, Any]) -> dict[str, Any]:
    from autdtorch.propagator import make_propagator

    solver = _section(settings, "solver")
    _require_known("solver", solver, _parameters(make_propagator, but=("scene",)))
    return solver


def _method(where: str, section: Any) -> Method:
    """The optimiser that a section names by `_target_`, with the section's settings."""
    method = hydra.utils.instantiate(section, _partial_=True)
    if not isinstance(method, functools.partial):
        raise ValueError(f"{where}: no _target_; must name a function such as autdtorch.gabs")
    _require_known(where, method.keywords, _parameters(method.func, but=_NO_METHOD_SETTINGS))
    return method


def _section(settings: Mapping[str, Any], key: str) -> dict[str, Any]:
    section = settings.get(key)
    if not isinstance(section, dict):
        raise ValueError(f"{key}: {section!r}; must be a mapping of keys to values")
    return section


def _parameters(function: Callable[..., Any], but: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in inspect.signature(function).parameters if name not in but)


def _require_known(where: str, given: Mapping[str, Any], allowed: tuple[str, ...]) -> None:
    for key in given:
        if key not in allowed:
            raise ValueError(f"{where}: unknown key {key!r}; allowed keys: {', '.join(allowed)}")


def _show(results: StudyResult, scenes: Mapping[str, Scene], folder: Path, single: bool) -> None:
    """Print the results' table; draw the plane of a single run, write the report of an experiment."""
    from autdtorch.plot import plot_plane
    from autdtorch.report import write_report
    from autdtorch.report_tables import summary_rows

    rows = summary_rows(results)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    # A relative path is shorter, and the same on every machine.
    shown = Path(os.path.relpath(folder))
    if not single:
        report = write_report(results, scenes, folder, shlex.join(["autdtorch", *sys.argv[1:]]))
        print(f"The report is {shown / report.name}")
        return
    (scene,) = scenes.values()
    (result,) = results.scenes.values()
    (method,) = result.methods.values()
    if method.plane_pressure is not None and scene.observation_plane is not None:
        figure = plot_plane(
            method.plane_pressure, scene.observation_plane, scene.control_points, scene.obstacles
        )
        figure.savefig(folder / PLANE_FILE)
    print(f"The results are in {shown}")
