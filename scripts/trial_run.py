"""A hardware trial: simulated, then played and measured, then reported."""

from __future__ import annotations

import argparse
import contextlib
import functools
import inspect
import logging
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from trial_bench import bench_of, settings_of, wired_device
from yaml import YAMLError

import autdtorch as at
from autdtorch import hardware
from autdtorch.hardware.sensors.sensor import checked_reading
from autdtorch.methods.solution import Solution
from autdtorch.study.report.hardware_report import write_hardware_report
from autdtorch.utils.progress import Progress, show_progress

SCENES = Path(__file__).parents[1] / "configs" / "scene"

METHODS = {"lssg": at.lssg, "gabs": at.gabs, "bo": at.bayes_opt, "identify": at.identify}
_LOG_FILE, _DRIVE_FILE = "trial.jsonl", "drive.npz"

Method = Callable[[at.Objective], Solution]


class Trial:
    """A trial that was simulated; `run` plays it.

    Attributes:
        begun: whether the device was opened, and the log is the trial's.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        """Read the scene, and run the method in the simulation, which also checks its settings."""
        path = scene_path(options.scene)
        self._scene = at.load_scene(path)
        self._limits = hardware.Limits(
            options.amplitude_limit,
            options.max_evaluations,
            options.max_seconds,
            options.max_seconds_in_a_row,
            options.duty_cycle,
        )
        method_settings = method_settings_of(options)
        self._settings = {
            "method": options.method,
            "method settings": method_settings,
            "seed": options.seed,
            **settings_of(options),
        }
        self._method = method_of(options.method, method_settings, options.seed)
        self._folder = options.output or Path("outputs") / f"hardware_{path.stem}_{options.method}"
        self._dry = options.dry_run
        self.begun = False
        device, transducers = wired_device(options, len(self._scene.array))
        simulated = at.SimulatedObjective(self._scene, at.make_propagator(self._scene))
        self._bench = bench_of(options, device, transducers, simulated)
        self._simulated = hardware.Played(simulated, device, transducers, self._limits.amplitude)
        self._settings["largest amplitude"] = round(self._simulated.largest, 4)
        self._expected = self._method(self._simulated)

    def run(self, command: str) -> None:
        """Play and measure; leave log, drive and report, unless the run is dry."""
        if self._dry:
            with tempfile.TemporaryDirectory() as nowhere:
                self._measure(Path(nowhere) / _LOG_FILE)
            return
        folder = self._folder
        folder.mkdir(parents=True, exist_ok=True)
        found, again, preflight, log = self._measure(folder / _LOG_FILE)
        at.save_drive(folder / _DRIVE_FILE, found.drive[0], self._scene.array)
        report = write_hardware_report(
            folder, log, found, again, self._simulated, self._expected, preflight, command
        )
        weakest = float(again.mean(dim=0).min())
        print(f"weakest focus {weakest:.4g} Pa, measured once more; the report is {report}")

    def _measure(
        self, log: Path
    ) -> tuple[Solution, torch.Tensor, hardware.Preflight, hardware.EvaluationLog]:
        """Check the transducers, run the method on the device, and read what it found once more (R, P)."""
        bench = self._bench
        with (
            hardware.lock_log(log),  # before a device is touched that plays for another trial
            bench.sensor() as sensor,
            bench.link() as link,
            show_progress(self._expected.history.shape[1]) as progress,
            contextlib.ExitStack() as at_the_end,
        ):
            limited = hardware.LimitedLink(link, self._limits)
            objective = hardware.HardwareObjective(
                self._scene, limited, sensor, log, self._settings, watcher(progress)
            )
            self.begun = not self._dry
            at_the_end.callback(lambda: objective.log.end(limited.seconds_on))
            at_the_end.callback(limited.off)
            if objective.log.evaluations:
                logging.info("going on after %d evaluations", len(objective.log.evaluations))
            preflight = self._preflight(limited, sensor, progress)
            found = self._method(objective)
            points = len(self._scene.control_points)
            progress.begin("the drive that was found, once more")
            limited.play(found.drive[0])
            again = torch.stack([checked_reading(sensor, points) for _ in range(bench.readings)])
            limited.require_on()
            limited.off()
            progress.begin("silence, outputs off, once more")
            with silence_expected():
                silent = hardware.hears_silence(sensor, preflight, points, bench.readings)
            if not silent:
                logging.warning("the sensor hears more than before the trial: are the outputs off?")
        return found, again, preflight, objective.log

    def _preflight(
        self, limited: hardware.LimitedLink, sensor: hardware.Sensor, progress: Progress
    ) -> hardware.Preflight:
        points, count = len(self._scene.control_points), len(self._scene.array)
        with silence_expected():
            check = hardware.check_transducers(
                limited,
                sensor,
                points,
                self._bench.readings,
                self._bench.background,
                watch=lambda what: progress.begin(f"pre-flight check: {what}"),
            )
        if len(check.dead) == count:
            loudest = ", and try a lower --loudest" if self._settings["sensor"] == "scope" else ""
            raise ValueError(
                f"the sensor hears no transducer: {float(check.pressure.max()):.3g} Pa is the most, and must "
                f"be above {check.threshold:.3g} Pa; check the device's power, and the sensor{loudest}"
            )
        logging.info("the sensor hears %d of %d", count - len(check.dead), count)
        if check.dead:
            logging.warning("not heard, counted from 0: %s", ", ".join(map(str, check.dead)))
        return check


def scene_path(text: str) -> Path:
    """The scene's file, by its path or by its name among ours."""
    path = Path(text)
    if not path.suffix and path.name == text:
        path = SCENES / f"{text}.yaml"
    if not path.is_file():
        ours = ", ".join(sorted(file.stem for file in SCENES.glob("*.yaml")))
        raise ValueError(f"--scene: {text}: no such file; must be a YAML file, or one of {ours}")
    return path


def method_settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """What `--set` says, as Python has it."""
    if unset := [word for word in options.set if "=" not in word]:
        raise ValueError(f"--set: {unset[0]}; must be KEY=VALUE, as levels=8")
    try:
        settings = OmegaConf.to_container(OmegaConf.from_dotlist(options.set))
    except (OmegaConfBaseException, YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"--set: {' '.join(options.set)}: {reason}; must be KEY=VALUE") from error
    return {str(key): value for key, value in settings.items()}


def method_of(name: str, settings: dict[str, Any], seed: int) -> Method:
    """The method with its settings bound; its seed too, where it has one."""
    function = METHODS[name]
    parameters = inspect.signature(function).parameters.keys()
    allowed = parameters - {"objective", "trials", "seed", "score"}
    for key in settings.keys() - allowed:
        raise ValueError(f"--set: unknown key {key!r}; {name} has {', '.join(sorted(allowed))}")
    return functools.partial(function, **settings, **({"seed": seed} if "seed" in parameters else {}))


@contextlib.contextmanager
def silence_expected() -> Iterator[None]:
    """Have an oscilloscope not warn that it hears nothing."""
    scope = logging.getLogger("autdtorch.hardware.sensors.oscilloscope")
    scope.setLevel(logging.ERROR)
    try:
        yield
    finally:
        scope.setLevel(logging.NOTSET)


def watcher(progress: Progress) -> Callable[[hardware.Evaluation], None]:
    """Shows every evaluation, and says when one is the best so far."""
    best = 0.0

    def watch(evaluation: hardware.Evaluation) -> None:
        nonlocal best
        progress.advance(1)
        weakest = float(evaluation.pressure.min())
        if weakest > best:
            best = weakest
            progress.begin(f"weakest focus {best:.3g} Pa")

    return watch
