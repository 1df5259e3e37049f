"""A hardware trial: a method is simulated, then run on the bench of a config, measured and reported."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra.core.hydra_config import HydraConfig

from autdtorch import hardware
from autdtorch.cli.configured_bench import Bench
from autdtorch.cli.settings import (
    folder_of,
    given_readings,
    is_given,
    load_method,
    scene_of,
    section_of,
    solver_of,
)
from autdtorch.hardware.camera.picture import turned
from autdtorch.hardware.log import read_log
from autdtorch.hardware.objective import goal_of_sensor
from autdtorch.hardware.sensors.sensor import AnySensor
from autdtorch.io.drive_file import save_drive
from autdtorch.io.goal_section import goal_section, load_goal, score_label
from autdtorch.io.picture_file import AGAIN, EVALUATION, PICTURES, pictures_of_evaluations, save_picture
from autdtorch.io.readings_file import load_readings
from autdtorch.methods.base import Method
from autdtorch.methods.calibration.calibrate import calibrate
from autdtorch.methods.calibration.calibration import Calibration
from autdtorch.methods.problem import Problem
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.objectives.perturbations import simulated_matrix
from autdtorch.objectives.readings import Readings
from autdtorch.propagators import make_propagator
from autdtorch.study.report.hardware_report import write_hardware_report
from autdtorch.study.study_method import check_goal, name_of, solve
from autdtorch.utils.array_types import REAL
from autdtorch.utils.digest import digest_of
from autdtorch.utils.progress import Progress, show_progress
from autdtorch.utils.validation import invalid, within

logger = logging.getLogger(__name__)

_LOG_FILE = "trial.jsonl"
_MOST_PICTURES = 24  # of 249 transducers and 500 places, these take some 30 s
_SEEN_APART = 0.5  # of places in pictures, in wavelengths
_MOST_FITTED = 200  # evaluations: of 249 transducers and 4 points, these take 40 s on two busy cores


def hardware_trial(settings: dict[str, Any], modules: list[Any], output: Any, readings: object) -> None:
    """Run a method on a device, or on its emulator, from earlier readings in a file, if any.

    Every error carries a note on whether the outputs are off.
    """
    trial = None
    try:
        with hardware.ended_by_signals():
            trial = _Trial(settings, modules, output, readings)
            trial.run()
    except (Exception, KeyboardInterrupt) as error:
        then = "the same command goes on where the log ends"
        if isinstance(error, hardware.LimitError):
            then = "a higher limit goes on from here"
        note_outputs(error, trial is not None and trial.begun, f", and {then}")
        raise


def note_outputs(error: BaseException, begun: bool, then: str = "") -> None:
    """Add a note to an error on whether the outputs are off, if a device was opened."""
    left_on: BaseException | None = error  # says that a device may play on: this one, or one that it followed
    while left_on is not None and not isinstance(left_on, hardware.OffError):
        left_on = left_on.__cause__ or left_on.__context__
    if left_on is None and begun:
        error.add_note(f"the outputs are off{then}")
    elif left_on not in (None, error):
        error.add_note(str(left_on))


class _Measured(NamedTuple):
    """A trial as it was measured; the drive of the solution was read `again` (R, P)."""

    solution: Solution
    again: torch.Tensor
    goal: Goal
    preflight: hardware.Preflight
    log: hardware.EvaluationLog


class _Trial:
    """A trial that was simulated; `run` plays it. `begun`: whether the device was opened."""

    def __init__(self, settings: dict[str, Any], modules: list[Any], output: Any, readings: object) -> None:
        """Check the settings, and run the method in the simulation."""
        if "scenes" in settings:
            raise ValueError("hardware: given beside an experiment; must be one scene and one method")
        seed = settings.get("seed", 0)
        self._scene = scene_of("scene", section_of(settings, "scene"), modules)
        self._method = load_method("method", section_of(settings, "method"), modules)
        goal = load_goal("goal", settings.get("goal"))
        if not isinstance(goal, Goal):
            raise invalid("goal", goal.name, "must be of pressures, which the sensor of a bench reads")
        self._goal = goal
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
        self._propagator = make_propagator(self._scene, **solver_of(settings))
        simulated = SimulatedObjective(self._scene, self._propagator)
        bench.emulate(simulated, self._propagator)
        played = bench.device, bench.transducers, bench.limits.amplitude
        with within("hardware.limits"):  # the transducers are checked
            self._simulated = hardware.Played(simulated, *played)
        self._settings["largest amplitude"] = round(self._simulated.largest, 4)
        simulated_readings = self._with_readings(readings)
        self._expected = solve(
            self._method, self._simulated, [0], seed, self._goal, readings=simulated_readings
        )

    def _with_readings(self, value: object) -> Readings | None:
        """Read the earlier readings of a file, if any, and return the simulated ones of these drives."""
        self._readings = given_readings(value)
        if self._readings is None:
            return None
        self._require_alike(Path(str(value)))
        self._readings = replace(self._readings, deviation=None)  # the sensor's are those of all
        self._settings["readings"] = digest_of(self._readings)[:16]
        earlier = Problem.of(self._simulated, readings=self._readings).readings
        assert earlier is not None
        magnitudes = self._simulated(earlier.drives).masked_fill(earlier.pressure.isnan(), torch.nan)
        return Readings(earlier.drives, magnitudes)

    def _require_alike(self, path: Path) -> None:
        """Refuse a trial whose drives of amplitude 1 were others: no method sees that from its pressures."""
        folder = path.parent if path.name == PICTURES else path
        log = folder / _LOG_FILE if folder.is_dir() else folder
        if log.suffix.lower() != ".jsonl":
            return
        origin, bench = read_log(log)[0], self._bench
        ours = {"device": bench.device.name, "transducers": bench.transducers, **self._settings}
        for name in ("device", "transducers", "largest amplitude"):
            if origin.get(name, ours[name]) != ours[name]:
                accepted = f"must be of one with the {name} {ours[name]}, as this has"
                raise invalid("readings", f"a trial with the {name} {origin[name]}", accepted)

    def run(self) -> None:
        """Play and measure; leave log, drive and report, unless the run is dry."""
        if self._bench.is_dry:
            with tempfile.TemporaryDirectory() as nowhere:
                self._measure(Path(nowhere) / _LOG_FILE)
            return
        folder = self._folder
        folder.mkdir(parents=True, exist_ok=True)
        measured = self._measure(folder / _LOG_FILE)
        save_drive(folder / "drive.npz", measured.solution.drive[0], self._scene.array)
        command = shlex.join(["autdtorch", *sys.argv[1:]])
        report = write_hardware_report(
            folder,
            measured.log,
            measured.solution,
            measured.again,
            self._propagator,
            self._simulated,
            self._expected,
            measured.preflight,
            measured.goal,
            command,
            self._calibration(measured),
        )
        goal, mean = measured.goal, measured.again.mean(dim=0)
        score, first = _shown(goal, mean), measured.log.evaluations[0].pressure
        if goal(mean) < goal(first) and len(measured.log.evaluations) > 1:
            logger.warning("the first drive of the search read more: %s", _shown(goal, first))
        print(f"{score}, measured once more; the report is {report}")

    def _measure(self, log: Path) -> _Measured:
        """Check the transducers, run the method on the device, and read its drive again (R, P)."""
        bench, points = self._bench, len(self._scene.control_points)
        usual = 1 if bench.by_hand else 4
        with (
            hardware.lock_log(log),  # before a device is touched that plays for another trial
            bench.sensor() as sensor,
            bench.link() as link,
            show_progress(self._expected.history.shape[1]) as progress,
            contextlib.ExitStack() as at_the_end,
        ):
            limited, goal = hardware.LimitedLink(link, bench.limits), self._goal_of(sensor)
            readings = 2 if isinstance(sensor, hardware.PulsedSensor) else usual  # a pulse takes seconds
            pictures = _Pictures(log.parent / PICTURES, sensor)
            objective = hardware.HardwareObjective(
                self._scene,
                limited,
                sensor,
                log,
                self._settings,
                _watcher(progress, goal, pictures),
                simulated_matrix(self._simulated) if goal.of_pressures else None,
            )
            if isinstance(self._method, Method):  # before anything is played
                self._method.check(Problem.of(objective, goal, readings=self._readings))
            self.begun = not bench.is_dry
            at_the_end.callback(lambda: objective.log.end(limited.seconds_on))
            at_the_end.callback(limited.off)
            if objective.evaluations:
                logger.info("going on after %d evaluations", objective.evaluations)
            preflight = self._preflight(limited, sensor, readings, progress)
            pictures.skip()
            progress.begin(f"running {name_of(self._method)} on {bench.device.name}")
            with objective.continued():  # of a method that is a function, too
                solution = solve(self._method, objective, [0], self._seed, goal, readings=self._readings)
            progress.begin("the drive of the method, once more")
            rows = []
            for number in range(readings):
                rows.append(limited.measure(solution.drive[0], sensor, points)[0])
                pictures.keep(f"{AGAIN}_{number}", solution.drive[0])
            again = torch.stack(rows)
            limited.off()
            progress.begin("silence, outputs off, once more")
            with _silence_expected():
                silent = hardware.hears_silence(sensor, preflight, points, readings)
            if not silent:
                logger.warning("the sensor reads more than before the trial: are the outputs off?")
        return _Measured(solution, again, goal, preflight, objective.log)

    def _goal_of(self, sensor: AnySensor) -> Goal:
        """Return the goal of the trial, or for a sensor of another quantity than the pressure its own."""
        if (goal := goal_of_sensor(sensor)).of_pressures:
            return self._goal
        if self._goal != WEAKEST_FOCUS:
            accepted = f"must be {WEAKEST_FOCUS.name} with a sensor of {goal.name}, for its least reading"
            raise invalid("goal", self._goal.name, accepted)
        return goal

    def _calibration(self, measured: _Measured) -> Calibration | str:
        """Return the simulation fitted to the evaluations, or the reason why there is none."""
        if not measured.goal.of_pressures:
            return f"the sensor reads {measured.goal.name}, and the simulation gives pressures"
        pictures, plane = self._folder / PICTURES, self._scene.observation_plane
        if plane is not None and pictures_of_evaluations(pictures):  # they see more than the points
            places = plane.points(_SEEN_APART * self._scene.wavelength).reshape(-1, 3)
            readings, most = load_readings(pictures, points=places), _MOST_PICTURES
        else:
            readings, most = load_readings(self._folder / _LOG_FILE), _MOST_FITTED
        if len(readings.drives) == 1:
            return "one evaluation does not tell the transducers apart"
        drives = readings.drives.clone()
        drives[:, measured.preflight.failed] = 0
        rows = torch.linspace(0, len(drives) - 1, min(len(drives), most), **REAL).round().long()
        try:
            return calibrate(self._propagator, replace(readings, drives=drives)[rows])
        except Exception as error:  # the trial has succeeded, and its report does not need a fit
            logger.warning("no calibration: %s", error)
            return str(error)

    def _preflight(
        self, limited: hardware.LimitedLink, sensor: AnySensor, readings: int, progress: Progress
    ) -> hardware.Preflight:
        count, points = len(self._scene.array), len(self._scene.control_points)
        if isinstance(sensor, hardware.PulsedSensor) or not goal_of_sensor(sensor).of_pressures:
            logger.info("the sensor does not see a transducer alone: silence and one drive are checked")
            progress.begin("a first reading, of the simulated drive")
            check = hardware.check_picture(limited, sensor, points, self._expected.drive[0], readings)
            self._warn_of_turned(getattr(sensor, "picture", None))
            return check
        progress.begin("checking the transducers, one by one")
        show = progress.begin if self._bench.by_hand else progress.describe
        with _silence_expected():
            check = hardware.check_transducers(
                limited,
                sensor,
                points,
                readings,
                1 if self._bench.by_hand else 32,
                watch=lambda what: show(f"pre-flight check: {what}"),
            )
        if len(check.failed) == count:
            loudest = ", and try a lower loudest" if self._settings["sensor"] == "scope" else ""
            strongest = f"{float(check.pressure.max()):.3g} {check.unit} from the strongest transducer"
            accepted = f"must be above {check.threshold:.3g} {check.unit}"
            advice = f"check the device's power, and the sensor{loudest}"
            raise ValueError(f"hardware.sensor: {strongest}; {accepted}; {advice}")
        logger.info("%d of %d transducers work", count - len(check.failed), count)
        if check.failed:
            logger.warning("failed transducers, counted from 0: %s", ", ".join(map(str, check.failed)))
        return check

    def _warn_of_turned(self, picture: object) -> None:
        """Warn if a picture of the simulated drive looks like the simulated plane once it is turned."""
        if not isinstance(picture, hardware.Picture):
            return
        field = self._propagator.field(self._expected.drive, picture.points)[0]
        if how := turned(picture, field.abs().reshape(picture.pressure.shape)):
            logger.warning("the first picture is %s, by the simulation: check the order of the corners", how)


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
    return f"{score_label(goal.name)} {float(goal(pressure)):.4g} {goal.unit}".rstrip()


class _Pictures:
    """A folder for the pictures of a sensor that takes any."""

    def __init__(self, folder: Path, sensor: AnySensor) -> None:
        self._folder, self._sensor = folder, sensor
        self._last: object = None

    def keep(self, name: str, drive: torch.Tensor) -> None:
        """Write the sensor's picture of a drive, unless it is the last one that was written or skipped."""
        picture = getattr(self._sensor, "picture", None)
        if isinstance(picture, hardware.Picture) and picture is not self._last:
            self._folder.mkdir(exist_ok=True)
            save_picture(self._folder / f"{name}.npz", picture, drive)
        self._last = picture

    def skip(self) -> None:
        """Leave the sensor's picture out."""
        self._last = getattr(self._sensor, "picture", None)


def _watcher(progress: Progress, goal: Goal, pictures: _Pictures) -> Callable[[hardware.Evaluation], None]:
    """Return a function that shows every evaluation, and the best so far, and keeps its picture."""
    best, numbers = -math.inf, itertools.count()

    def watch(evaluation: hardware.Evaluation) -> None:
        nonlocal best
        pictures.keep(f"{EVALUATION}_{next(numbers):05d}", evaluation.drive)
        progress.advance(1)
        score = float(goal(evaluation.pressure))
        if score > best:
            best = score
            progress.describe(_shown(goal, evaluation.pressure))

    return watch
