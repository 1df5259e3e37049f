"""The command line `autdtorch`: reads settings with Hydra, runs a study, a trial, a sequence or a live view.

Errors are one line on stderr (`errors`). Modules that take seconds to import are imported when a job starts,
so that help is quick.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import hashlib
import importlib
import logging
import os
import re
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import hydra
import psutil
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

import autdtorch
from autdtorch.cli.arguments import command_of, is_sweep, prepare_streams, quoted, settings_first
from autdtorch.cli.config_files import CONFIGS, register
from autdtorch.cli.errors import AGAIN, FULL_ERROR, FailedJob, in_one_line, stop

logger = logging.getLogger(__name__)

_LONGEST_NAME = 150  # of a job's folder; file systems allow 255 bytes
_COMMANDS = {  # modules and functions of the commands that take a config
    "explore": (__name__, "explore_scene"),
    "calibrate": ("autdtorch.cli.calibrate_command", "calibrate_scene"),
    "play": ("autdtorch.cli.play_command", "play"),
}
_EXPLORE_KEYS = ("port", "browser", "drive", "trial")
_EXPLORE_SETTINGS = re.compile(r"\+*(scene|modules|explore|hydra)\b|\+*solver\.spacing=")


class _Carrier(BaseException):
    """An exception that carries its cause past Hydra, which prints a line about any `Exception`."""


class SweepCallback(Callback):
    """Prepares a sweep; `configs/config.yaml` names it to Hydra."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Log the sweep, whose workers end with it, or on Slurm watch its jobs, which logs them."""
        launcher = config.hydra.launcher
        if launcher._target_.endswith(".SlurmLauncher"):
            from autdtorch.cli.slurm import watch_queue

            watch_queue(launcher.submitit_folder)
        else:
            end_workers_with_us()
            logger.info("sweep into %s: %s", config.hydra.sweep.dir, shlex.join(config.hydra.overrides.task))

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Leave signals as they were."""
        leave_workers_alone()


def main() -> None:
    """Run the command line; `errors.stop` has the statuses where it fails."""
    atexit.register(_end_without_cleaning_up)
    prepare_streams()
    sys.argv[1:] = map(quoted, sys.argv[1:])
    wanted = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"  # makes Hydra pass exceptions on, which it would otherwise print itself
    error: BaseException
    try:
        arguments = sys.argv[1:]
        if (command := command_of(arguments)) == "collect":
            from autdtorch.cli.study_command import collect

            collect(arguments)
        elif arguments == ["--version"]:
            print(f"autdtorch {autdtorch.__version__}")
        else:
            arguments = settings_first(arguments)
            sweep = is_sweep(arguments)
            if sweep and command:
                raise ValueError(f"{command}: a sweep; must be one scene at a time")
            sys.argv[1:] = arguments
            register()
            if command is None:
                _run()
            else:
                _run_command(*_COMMANDS[command])
            if sweep:
                print("autdtorch collect FOLDER merges the results of a sweep into one table and one report")
        sys.stdout.flush()  # whose errors are lines without a status at the end of Python
    except _Carrier as carrier:
        error = carrier.__cause__ or carrier
    except (Exception, KeyboardInterrupt) as raised:
        error = raised
    else:
        return
    finally:
        if wanted is None:
            del os.environ[FULL_ERROR]
        else:
            os.environ[FULL_ERROR] = wanted
    if wanted == "1" and not isinstance(error, KeyboardInterrupt):
        raise error
    stop(error)


def _end_without_cleaning_up() -> None:
    """Free no memory at the end, which the system does sooner.

    Python ends as it does otherwise. Its last collection of garbage is left out, and the destructors of C++
    libraries after Python's end, 0.1 s in PyTorch's.
    """
    gc.freeze()
    # glibc gives the status to functions of `on_exit`, and calls the last one first.
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "on_exit"):
        libc.on_exit(libc._exit, None)


@hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="config")
def _run(config: DictConfig) -> None:
    job = HydraConfig.get()
    swept = job.mode == RunMode.MULTIRUN
    try:
        with warnings.catch_warnings(), _named(f"job {job.job.num}: " if swept else ""):
            warnings.showwarning = _log_warning
            _job(config, Path(job.sweep.dir) if swept else None)
    except Exception as error:
        if not swept:
            raise _Carrier from error
        # The other jobs go on.
        failure = f"job {job.job.num} failed: {in_one_line(error)}"
        logger.error(failure)
        raise FailedJob(f"{failure}; {AGAIN}") from error


def _run_command(module: str, function: str) -> None:
    """Run a function of the settings, in a module that is imported then, at a composed config."""

    @hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="config")
    def run(config: DictConfig) -> None:
        try:
            with warnings.catch_warnings():
                with _importing():
                    from autdtorch.cli.settings import settings_of

                    command = getattr(importlib.import_module(module), function)
                warnings.showwarning = _log_warning
                command(*settings_of(config))
        except Exception as error:
            raise _Carrier from error

    run()


@contextlib.contextmanager
def _importing() -> Iterator[None]:
    """Pause garbage collection: imports leave none, and it takes a tenth of their time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()


def explore_scene(settings: dict[str, Any], modules: list[Any], _: Any) -> None:
    """Show the scene of the settings until Ctrl+C or SIGTERM, which a job in the background gets, ends it.

    Raises:
        ValueError: a setting of `explore` that is unknown or out of range, or one that has no effect here.
    """
    from autdtorch.cli.settings import given_file, require_effective, scene_of, section_of, solver_of
    from autdtorch.io.drive_file import load_drive
    from autdtorch.plot.explore import explore
    from autdtorch.utils.process import signals_restored
    from autdtorch.utils.validation import require_known, within

    require_effective("explore", _EXPLORE_SETTINGS, "scene, modules, solver.spacing or explore.KEY")
    section = section_of(settings, "explore")
    require_known("explore", section, _EXPLORE_KEYS)
    drive = None
    if (file := given_file("explore.drive", section.get("drive"))) is not None:
        with within("explore.drive"):
            drive = load_drive(file)
    trial = given_file("explore.trial", section.get("trial"))
    scene = scene_of("scene", section_of(settings, "scene"), modules)
    spacing, port, browser = solver_of(settings)["spacing"], section["port"], section["browser"]
    with signals_restored():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        explorer = explore(scene, drive, spacing=spacing, port=port, open_browser=browser, trial=trial)
        try:
            print(f"The live view is at {explorer.address}\nCtrl+C ends it.", flush=True)
            explorer.wait()
        except KeyboardInterrupt:
            explorer.close()


def _log_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Log a warning without the line of our source, and without what the scene of a config is a part of."""
    logger.warning("%s", str(message).removeprefix("scene mapping: "))


@contextlib.contextmanager
def _named(prefix: str) -> Iterator[None]:
    """Put the name of a job in front of its log lines; jobs that run side by side share stderr."""

    def name(record: logging.LogRecord) -> bool:
        record.msg, record.args = f"{prefix}{record.getMessage()}", None
        return True

    handlers = logging.getLogger().handlers if prefix else []
    for handler in handlers:
        handler.addFilter(name)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(name)


def _job(config: DictConfig, sweep: Path | None) -> None:
    """Run a study, or a hardware trial if there is a section `hardware`."""
    with _importing():
        from autdtorch.cli.settings import settings_of

    settings, modules, output = settings_of(config)
    for unused in ("explore", "calibrate", "play", "path"):
        settings.pop(unused, None)
    drive, readings = settings.pop("drive", None), settings.pop("readings", None)
    if settings.get("hardware") is None:
        from autdtorch.cli.study_command import study

        if readings is not None:
            raise ValueError(f"readings: {readings!r}; must be null: only a hardware trial uses them")
        settings.pop("hardware", None)
        study(settings, modules, output, sweep, drive)
        return
    from autdtorch.cli.hardware_command import hardware_trial

    if drive is not None:
        raise ValueError(f"drive: {drive!r}; must be null: a hardware trial writes its drive as drive.npz")
    if sweep is not None:
        raise ValueError("hardware: a sweep; must be one trial at a time")
    hardware_trial(settings, modules, output, readings)


def _job_folder(overrides: str) -> str:
    """Return the name of the folder of a sweep's job: short, of characters that folders can have."""
    name = re.sub(r"[^\w.,=+-]+", "_", overrides, flags=re.ASCII)
    if name == overrides and len(name) <= _LONGEST_NAME:
        return name or "job"
    # The characters that were lost may be the only difference between two jobs.
    digest = hashlib.sha256(overrides.encode()).hexdigest()[:12]
    return f"{name[: _LONGEST_NAME - len(digest) - 1]}-{digest}"


OmegaConf.register_new_resolver("job_folder", _job_folder, replace=True)


_ENDING = ("SIGTERM", "SIGHUP")  # at Ctrl-C joblib ends its workers


def end_workers_with_us() -> None:
    """Kill the workers of this process at signals that end it; others would go on, and hold their folders.

    Signals that are ignored, as by ``nohup``, or handled, stay so.
    """
    if threading.current_thread() is not threading.main_thread():  # which alone receives signals
        return
    for number in _signals():
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)


def leave_workers_alone() -> None:
    """Take back `end_workers_with_us`."""
    for number in _signals():
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.SIG_DFL)


def _signals() -> list[signal.Signals]:
    return [getattr(signal, name) for name in _ENDING if hasattr(signal, name)]


def _end(number: int, _: FrameType | None) -> None:
    for worker in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has ended
            worker.kill()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
