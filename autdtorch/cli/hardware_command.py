"""A hardware trial: a method is simulated, then run on a device, measured and reported."""

from __future__ import annotations

import contextlib
import logging
import math
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import torch
from hydra.core.hydra_config import HydraConfig

from autdtorch import hardware
from autdtorch.cli.bench_config import Bench
from autdtorch.cli.settings import folder_of, is_given, load_method, scene_of, section_of, solver_of
from autdtorch.io.drive_file import save_drive
from autdtorch.io.goal_section import goal_section, load_goal, score_label
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.perturbations import simulated_matrix
from autdtorch.objectives.simulated import SimulatedObjective
from autdtorch.propagators import make_propagator
from autdtorch.study.report.hardware_report import write_hardware_report
from autdtorch.study.run import check_goal, name_of, solve
from autdtorch.utils.progress import Progress, show_progress

logger = logging.getLogger(__name__)

_Measured: TypeAlias = tuple[Solution, torch.Tensor, hardware.Preflight, hardware.EvaluationLog]

_LOG_FILE = "trial.jsonl"


def hardware_trial(settings: dict[str, Any], modules: list[Any], output: Any) -> None:
    """Run a method on a device, or on its emulator.

    Every error carries a note on whether the outputs are off.
    """
    trial = None
    try:
        with hardware.ended_by_signals():
            trial = _Trial(settings, modules, output)
            trial.run()
    except (Exception, KeyboardInterrupt) as error:
        if (left_on := _left_on(error)) is not None:
            if left_on is not error:
                error.add_note(str(left_on))
        elif trial is not None and trial.begun:
            then = "the same command goes on where the log ends"
            if isinstance(error, hardware.LimitError):
                then = "a higher limit goes on from here"
            error.add_note(f"the outputs are off, and {then}")
        raise


def _left_on(error: BaseException | None) -> BaseException | None:
    """Return the error that says that a device may play on: this one, or one that it followed."""
    while error is not None and not isinstance(error, hardware.OffError):
        error = error.__cause__ or error.__context__
    return error


class _Trial:
    """A trial that was simulated; `run` plays it. `begun`: whether the device was opened."""

    def __init__(self, settings: dict[str, Any], modules: list[Any], output: Any) -> None:
        """Check the settings, and run the method in the simulation."""
        if "scenes" in settings:
            raise ValueError("hardware: given beside an experiment; must be one scene and one method")
        seed = settings.get("seed", 0)
        self._scene = scene_of("scene", section_of(settings, "scene"), modules)
        self._method = load_method("method", section_of(settings, "method"), modules)
        self._goal = load_goal("goal", settings.get("goal"))
        check_goal(self._goal, {"scene": self._scene}, {name_of(self._method): self._method})
        self._bench = bench = Bench(section_of(settings, "hardware"), self._scene, seed)
        self._seed = seed
        choices = HydraConfig.get().runtime.choices
        usual = Path("outputs") / f"hardware_{choices['scene']}_{choices['method']}"
        self._folder = folder_of("output", output) if is_given("output") else usual
        self._settings = {
            "method": name_of(self._method),
            "method settings": settings["method"],
            "seed": seed,
            **bench.settings,
        }
        if self._goal != WEAKEST_FOCUS:  # so that logs from before there were goals go on
            self._settings["goal"] = goal_section(self._goal)
        self.begun = False
        simulated = SimulatedObjective(self._scene, make_propagator(self._scene, **solver_of(settings)))
        bench.emulate(simulated)
        self._simulated = hardware.Played(simulated, bench.device, bench.transducers, bench.limits.amplitude)
        self._settings["largest amplitude"] = round(self._simulated.largest, 4)
        self._expected = solve(self._method, self._simulated, [0], seed, self._goal)

    def run(self) -> None:
        """Play and measure; leave log, drive and report, unless the run is dry."""
        if self._bench.is_dry:
            with tempfile.TemporaryDirectory() as nowhere:
                self._measure(Path(nowhere) / _LOG_FILE)
            return
        folder = self._folder
        folder.mkdir(parents=True, exist_ok=True)
        solution, again, preflight, log = self._measure(folder / _LOG_FILE)
        save_drive(folder / "drive.npz", solution.drive[0], self._scene.array)
        command = shlex.join(["autdtorch", *sys.argv[1:]])
        report = write_hardware_report(
            folder, log, solution, again, self._simulated, self._expected, preflight, self._goal, command
        )
        score = _shown(self._goal, again.mean(dim=0))
        print(f"{score}, measured once more; the report is {report}")

    def _measure(self, log: Path) -> _Measured:
        """Check the transducers, run the method on the device, and read its drive again (R, P) [Pa]."""
        bench, points = self._bench, len(self._scene.control_points)
        readings = 1 if bench.by_hand else 4
        with (
            hardware.lock_log(log),  # before a device is touched that plays for another trial
            bench.sensor() as sensor,
            bench.link() as link,
            show_progress(self._expected.history.shape[1]) as progress,
            contextlib.ExitStack() as at_the_end,
        ):
            limited = hardware.LimitedLink(link, bench.limits)
            objective = hardware.HardwareObjective(
                self._scene,
                limited,
                sensor,
                log,
                self._settings,
                _watcher(progress, self._goal),
                simulated_matrix(self._simulated),
            )
            self.begun = not bench.is_dry
            at_the_end.callback(lambda: objective.log.end(limited.seconds_on))
            at_the_end.callback(limited.off)
            if objective.evaluations:
                logger.info("going on after %d evaluations", objective.evaluations)
            progress.begin("checking the transducers, one by one")
            preflight = self._preflight(limited, sensor, readings, progress)
            progress.begin(f"running {name_of(self._method)} on {bench.device.name}")
            solution = solve(self._method, objective, [0], self._seed, self._goal)
            progress.begin("the drive of the method, once more")
            limited.play(solution.drive[0])
            again = torch.stack([limited.reading(sensor, points) for _ in range(readings)])
            limited.off()
            progress.begin("silence, outputs off, once more")
            with _silence_expected():
                silent = hardware.hears_silence(sensor, preflight, points, readings)
            if not silent:
                logger.warning("the sensor reads more than before the trial: are the outputs off?")
        return solution, again, preflight, objective.log

    def _preflight(
        self, limited: hardware.LimitedLink, sensor: hardware.Sensor, readings: int, progress: Progress
    ) -> hardware.Preflight:
        count = len(self._scene.array)
        show = progress.begin if self._bench.by_hand else progress.describe
        with _silence_expected():
            check = hardware.check_transducers(
                limited,
                sensor,
                len(self._scene.control_points),
                readings,
                1 if self._bench.by_hand else 32,
                watch=lambda what: show(f"pre-flight check: {what}"),
            )
        if len(check.failed) == count:
            loudest = ", and try a lower loudest" if self._settings["sensor"] == "scope" else ""
            strongest = f"{float(check.pressure.max()):.3g} Pa from the strongest transducer"
            accepted = f"above {check.threshold:.3g} Pa; check the device's power, and the sensor{loudest}"
            raise ValueError(f"hardware.sensor: {strongest}; must be {accepted}")
        logger.info("%d of %d transducers work", count - len(check.failed), count)
        if check.failed:
            logger.warning("failed transducers, counted from 0: %s", ", ".join(map(str, check.failed)))
        return check


@contextlib.contextmanager
def _silence_expected() -> Iterator[None]:
    """Keep an oscilloscope from warning of silence."""
    scope = logging.getLogger("autdtorch.hardware.sensors")
    scope.setLevel(logging.ERROR)
    try:
        yield
    finally:
        scope.setLevel(logging.NOTSET)


def _shown(goal: Goal, pressure: torch.Tensor) -> str:
    """Return the score of pressures (P,) [Pa] as text, such as "weakest focus 812 Pa"."""
    return f"{score_label(goal.name)} {float(goal(pressure)):.4g} {goal.unit}".rstrip()


def _watcher(progress: Progress, goal: Goal) -> Callable[[hardware.Evaluation], None]:
    """Return a function that shows every evaluation, and the best so far."""
    best = -math.inf

    def watch(evaluation: hardware.Evaluation) -> None:
        nonlocal best
        progress.advance(1)
        score = float(goal(evaluation.pressure))
        if score > best:
            best = score
            progress.describe(_shown(goal, evaluation.pressure))

    return watch
