"""The command line: ``autdtorch scene=three_cubes method=gabs``, ``autdtorch collect multirun``.

Hydra reads the settings from ``configs/``, from files of the user's choice and from the command line. What
takes seconds to import is imported when a study starts, so that help is quick.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shlex
import sys
import traceback
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import autdtorch
from autdtorch.cli.config_files import CONFIGS, register
from autdtorch.io.yaml_file import plain
from autdtorch.utils.trusted import TARGET
from autdtorch.utils.validation import require_known

if TYPE_CHECKING:
    from autdtorch.scene.scene import Scene
    from autdtorch.study.results import StudyResult
    from autdtorch.study.run import StudyMethod

logger = logging.getLogger(__name__)

PLANE_FILE = "plane.png"

_FAILED = 1
_REFUSED = 2
_REFUSALS = (ValueError, OSError, HydraException, OmegaConfBaseException)
_INTERRUPTED = 130  # as a shell reports a process that SIGINT ended
_FULL_ERROR = "HYDRA_FULL_ERROR"
_SETTINGS = ("scene", "method", "scenes", "methods", "solver", "trials", "seed", "plane_spacing")
_PLACES = ("modules", "output")  # settings that change no result
_CALLS = (TARGET, "_args_", "_convert_", "_partial_", "_recursive_")  # keys by which Hydra calls functions

_TARGETS = re.compile(rf"(method|methods\.[^.]+|(scene|scenes\.[^.]+)\.obstacles\.\d+)\.{TARGET}")

_LONGEST_NAME = 150  # of a job's folder; file systems allow 255 bytes

_AGAIN = "the same command repeats what is not finished"
_NO_SLURM = 'Could not detect "srun"'  # submitit, where it is to hand jobs to a Slurm that is not there
# Of submitit, which may be missing: classes of errors, and a job that never came to report its own.
_SUBMITIT_ERRORS = ("FailedJobError", "UncompletedJobError")
_LOST_JOB = re.compile(r" (/.*/(\d[\d_]*))/\2_\d+_(?:result\.pkl|log\.err)$", re.MULTILINE)

_COLLECT_HELP = """autdtorch collect FOLDER [modules=NAME]

Merges the finished studies in a folder and below it, such as those of a sweep in multirun, into one table
(summary.csv) and one report (report.md, report.html), which are written there. modules=NAME allows obstacles
of one's own, which the module NAME defines."""


class _Refusal(BaseException):
    """Carries its cause past Hydra, which would print a line of its own about any `Exception`."""

    def __init__(self, cause: Exception) -> None:
        super().__init__(cause)
        self.cause = cause


class _FailedJob(Exception):
    """Tells Hydra that a job of a sweep failed."""


class SlurmCallback(Callback):
    """Prepares a sweep on Slurm; `configs/config.yaml` names it to Hydra."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Have the sweep's jobs watched by `squeue`."""
        launcher = config.hydra.launcher
        if launcher._target_.endswith(".SlurmLauncher"):
            from autdtorch.cli.slurm import watch_queue

            watch_queue(launcher.submitit_folder)


def main() -> None:
    """Run the command line.

    Raises:
        SystemExit: after one line on stderr: with status 2 where a setting is refused or a file cannot be
            written, with status 1 after any other error, such as of a method of one's own, with status 130
            after Ctrl-C.
    """
    wanted = os.environ.get(_FULL_ERROR)
    os.environ[_FULL_ERROR] = "1"  # has Hydra pass exceptions on, where it would print them in its own way
    error: Exception
    try:
        if sys.argv[1:2] == ["collect"]:
            _collect(sys.argv[2:])
        elif sys.argv[1:] == ["--version"]:
            print(f"autdtorch {autdtorch.__version__}")
        else:
            register()
            _run()
            if {"-m", "--multirun"} & set(sys.argv[1:]):
                print("autdtorch collect merges the results of a sweep into one table and one report")
    except KeyboardInterrupt:
        _stop(_INTERRUPTED, "interrupted; finished trials are kept, and the same command goes on after them")
    except _Refusal as refusal:
        error = refusal.cause
    except Exception as failed:
        error = failed
    else:
        return
    finally:
        if wanted is None:
            del os.environ[_FULL_ERROR]
        else:
            os.environ[_FULL_ERROR] = wanted
    if wanted == "1":
        raise error
    _stop(_REFUSED if _is_refusal(error) else _FAILED, _in_one_line(error))


def _is_refusal(error: Exception) -> bool:
    of_submitit = type(error).__name__ in _SUBMITIT_ERRORS or _NO_SLURM in str(error)
    return of_submitit or isinstance(error, (_FailedJob, *_REFUSALS))


def _stop(status: int, line: str) -> NoReturn:
    print(f"autdtorch: {line}", file=sys.stderr)
    sys.exit(status)


def _in_one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    text = str(error)
    if not _is_refusal(error):
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{os.path.relpath(where.filename)}, line {where.lineno}, in {where.name}"
        text = f"{type(error).__name__}: {text} ({place}); with {_FULL_ERROR}=1 comes the traceback"
    if lost := _LOST_JOB.search(text):
        return f"job {lost[2]} ended without results; its log is in {os.path.relpath(lost[1])}; {_AGAIN}"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        more = "; pip install 'autdtorch[cluster]' brings more, hydra.searchpath=[FOLDER] your own"
        more = more if group == "hydra/launcher" else ""
        return f"{group}: {name!r}; must be one of {', '.join(error.options)}{more}"
    # Hydra would advise to add the key, which we would then refuse.
    if unknown := re.match(r"Could not override '(.+)'", text):
        key = getattr(error.__cause__, "full_key", None) or unknown[1]
        return f"{key}: unknown key; autdtorch --help lists the settings"
    if found := re.match(r"(Error merging override [^,\n]+)", text):
        text = f"{found[1]}: {error.__cause__}"
    if "missing EQUAL" in text and (word := re.search(r"'(.*?)'", text)):
        return f"{word[1]}: must be key=value, such as scene=three_cubes; autdtorch --help lists the settings"
    lines = [line.strip() for line in text.splitlines()]
    return "; ".join(line for line in lines if line and not line.startswith("See https://"))


@hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="config")
def _run(config: DictConfig) -> None:
    job = HydraConfig.get()
    swept = job.mode == RunMode.MULTIRUN
    if swept:
        logger.info("job %s: %s", job.job.num, ", ".join(job.overrides.task))
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: logger.warning("%s", message)  # without our source
            _study(config, Path(job.sweep.dir) if swept else None)
    except Exception as error:
        if not swept:
            raise _Refusal(error) from error
        # The other jobs go on.
        failure = f"job {job.job.num} failed: {_in_one_line(error)}"
        logger.error(failure)
        raise _FailedJob(f"{failure}; {_AGAIN}") from error


def _job_folder(overrides: str) -> str:
    """Name of the folder of a sweep's job, short and of characters that folders can have."""
    name = re.sub(r"[^\w.,=+-]+", "_", overrides, flags=re.ASCII)
    if name == overrides and len(name) <= _LONGEST_NAME:
        return name or "job"
    # What was lost may be all that tells two jobs apart.
    digest = hashlib.sha256(overrides.encode()).hexdigest()[:12]
    return f"{name[: _LONGEST_NAME - len(digest) - 1]}-{digest}"


OmegaConf.register_new_resolver("job_folder", _job_folder, replace=True)


def _study(config: DictConfig, sweep: Path | None) -> None:
    """Run a study; `sweep` is the folder of the sweep that it is a job of."""
    from autdtorch.propagators import CACHE_VARIABLE
    from autdtorch.study.run import run_study

    settings = plain(config, "settings")
    require_known("settings", settings, (*_SETTINGS, *_PLACES))
    _require_no_calls(settings)
    modules, output = (settings.pop(key, None) for key in _PLACES)
    if modules and not _is_given("modules"):
        raise ValueError(f"modules: {modules!r}; must be given on the command line, as modules=NAME")
    solver = _solver(settings)
    if sweep is None:
        folder = _folder("output", output)
    else:
        folder = Path(HydraConfig.get().runtime.output_dir)
        if _is_given("output"):
            raise ValueError(f"output: {output}; a sweep has a folder for each job in hydra.sweep.dir")
        if solver.get("cache") is None and CACHE_VARIABLE not in os.environ:
            solver["cache"] = sweep / "matrices"  # jobs in the same scene share them
    settings["solver"] = {key: value for key, value in solver.items() if key != "cache"}  # changes no result
    single = "scenes" not in settings
    build = _single if single else _experiment
    scenes, methods = build(settings, modules if isinstance(modules, list) else [modules])
    results = run_study(
        scenes,
        methods,
        solver=solver,
        **{key: settings[key] for key in ("trials", "seed", "plane_spacing") if key in settings},
        folder=folder,
        config=_as_text(settings, scenes),
    )
    _show(results, scenes, folder, single)


def _collect(arguments: list[str]) -> None:
    from autdtorch.study.report.study_report import write_report
    from autdtorch.study.report.summary_table import SUMMARY_FILE, save_summary
    from autdtorch.study.sweeps import collect_results

    if {"-h", "--help"} & set(arguments):
        print(_COLLECT_HELP)
        return
    modules = [word.removeprefix("modules=") for word in arguments if word.startswith("modules=")]
    folders = [word for word in arguments if not word.startswith("modules=")]
    if len(folders) != 1 or folders[0].startswith("-"):
        raise ValueError(f"collect: {shlex.join(arguments)!r}; must be one folder, such as multirun")
    logging.basicConfig(format="%(message)s")
    folder = Path(folders[0])
    sweep = collect_results(folder, modules)
    save_summary(sweep.results, sweep.swept, folder / SUMMARY_FILE)
    command = shlex.join(["autdtorch", "collect", *arguments])
    report = write_report(sweep.results, sweep.scenes, folder, command, sweep.seeds)
    count = "1 study" if sweep.studies == 1 else f"{sweep.studies} studies"
    end = f"{count}: the table is {folder / SUMMARY_FILE}, the report {report}"
    _print([*_table_lines(sweep.results), end])


def _single(
    settings: Mapping[str, Any], modules: list[Any]
) -> tuple[dict[str, Scene], dict[str, StudyMethod]]:
    """Return the one scene and the one method, each by its name."""
    from autdtorch.cli.method_section import load_method
    from autdtorch.study.run import name_of

    scene = _scene("scene", _section(settings, "scene"), modules)
    method = load_method("method", _section(settings, "method"), modules)
    return {HydraConfig.get().runtime.choices["scene"]: scene}, {name_of(method): method}


def _experiment(
    settings: Mapping[str, Any], modules: list[Any]
) -> tuple[dict[str, Scene], dict[str, StudyMethod]]:
    """Return the scenes and the methods of an experiment, by name."""
    from autdtorch.cli.method_section import load_method

    for key in ("scene", "method"):
        if key in settings:
            names = ", ".join(_section(settings, f"{key}s"))
            raise ValueError(f"{key}: given beside an experiment, which has its own {key}s: {names}")
    parts = _section(settings, "scenes")
    scenes = {name: _scene(f"scenes.{name}", part, modules) for name, part in parts.items()}
    sections = _section(settings, "methods")
    methods = {name: load_method(f"methods.{name}", _section(sections, name), modules) for name in sections}
    return scenes, methods


def _scene(where: str, section: Mapping[str, Any], modules: list[Any]) -> Scene:
    from autdtorch.io.scene_file import load_scene

    try:
        return load_scene(section, modules)
    except ValueError as error:
        raise ValueError(f"{where}: {str(error).removeprefix('scene mapping: ')}") from error


def _as_text(settings: Mapping[str, Any], scenes: Mapping[str, Scene]) -> str:
    """The settings as YAML, and digests of what they name only by the path of a file."""
    sections = settings["scenes"] if "scenes" in settings else dict.fromkeys(scenes, settings["scene"])
    files = {name: digests for name, section in sections.items() if (digests := list(_file_digests(section)))}
    return OmegaConf.to_yaml(OmegaConf.create({**settings, **({"files": files} if files else {})}))


def _file_digests(section: Mapping[str, Any]) -> Iterator[str]:
    """Digests of the files of the array and of the obstacles of a scene."""
    for part in (section["array"], *(section.get("obstacles") or ())):
        if part.get("path") is not None:
            yield hashlib.sha256(Path(part["path"]).read_bytes()).hexdigest()[:16]


def _solver(settings: Mapping[str, Any]) -> dict[str, Any]:
    from autdtorch.cli.method_section import parameters
    from autdtorch.propagators import make_propagator

    solver = _section(settings, "solver")
    require_known("solver", solver, parameters(make_propagator, but=("scene",)))
    if isinstance(cache := solver.get("cache"), str):
        solver["cache"] = _folder("solver.cache", cache)
    return solver


def _require_no_calls(value: object, *path: str) -> None:
    """Refuse the keys by which Hydra calls functions, except the target of a method or obstacle."""
    if isinstance(value, list):
        value = dict(enumerate(value))
    for key, entry in value.items() if isinstance(value, dict) else ():
        place = (*path, str(key))
        if key in _CALLS and not _TARGETS.fullmatch(".".join(place)):
            accepted = "must not be given; only a method or an obstacle has a _target_"
            raise ValueError(f"{'.'.join(place)}: {entry!r}; {accepted}")
        _require_no_calls(entry, *place)


def _is_given(key: str) -> bool:
    """Whether the command line itself sets the key, and no config file."""
    return any(re.match(rf"\+*{re.escape(key)}=", override) for override in HydraConfig.get().overrides.task)


def _folder(key: str, value: object) -> Path:
    """The folder that a setting names: below the working directory, where a config file does."""
    folder = Path(str(value))
    if not _is_given(key) and (folder.is_absolute() or ".." in folder.parts or not folder.parts):
        accepted = f"must be below the working directory, or given on the command line, as {key}=FOLDER"
        raise ValueError(f"{key}: {value!r}; {accepted}")
    return folder


def _section(settings: Mapping[str, Any], key: str) -> dict[str, Any]:
    section = settings.get(key)
    if not isinstance(section, dict):
        raise ValueError(f"{key}: {section!r}; must be a mapping of keys to values")
    return section


def _show(results: StudyResult, scenes: Mapping[str, Scene], folder: Path, single: bool) -> None:
    """Print the results' table; draw the plane of a single run, write the report of an experiment."""
    from autdtorch.plot.pressure_maps import plot_plane
    from autdtorch.study.report.study_report import write_report

    lines = _table_lines(results)
    # A relative path is shorter, and the same on every machine.
    shown = Path(os.path.relpath(folder))
    if not single:
        report = write_report(results, scenes, folder, shlex.join(["autdtorch", *sys.argv[1:]]))
        _print([*lines, f"The report is {shown / report.name}"])
        return
    (scene,) = scenes.values()
    (result,) = results.scenes.values()
    (method,) = result.methods.values()
    if method.plane_pressure is not None and scene.observation_plane is not None:
        figure = plot_plane(
            method.plane_pressure, scene.observation_plane, scene.control_points, scene.obstacles
        )
        figure.savefig(folder / PLANE_FILE)
    _print([*lines, f"The results are in {shown}"])


def _table_lines(results: StudyResult) -> list[str]:
    from autdtorch.study.results import summary_rows

    rows = summary_rows(results)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _print(lines: list[str]) -> None:
    """Print at once, so that jobs of a sweep do not come between each other's lines."""
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()
