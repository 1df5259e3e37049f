"""Run a method on a device, or on its emulator; an interrupted trial goes on with the same command.

python scripts/hardware_trial.py --device emulated --method gabs --amplitude-limit 1
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import inspect
import logging
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from trial_bench import Bench, add_options, bench_of, settings_of

import autdtorch as at
from autdtorch import hardware
from autdtorch.hardware_report import write_hardware_report
from autdtorch.optim.base import Solution
from autdtorch.progress import Progress, show_progress

ROOT = Path(__file__).parents[1]

METHODS = {"lssg": at.lssg, "gabs": at.gabs, "bo": at.bayes_opt, "identify": at.identify}
_REFUSED, _LIMITED = 2, 3
_LOG_FILE, _DRIVE_FILE = "trial.jsonl", "drive.npz"

Method = Callable[[at.Objective], Solution]


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = parser.add_argument
    add("--scene", default="three_cubes", help="a YAML file, or one of configs/scene by its name")
    add("--method", required=True, choices=list(METHODS))
    add("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings of the method, as levels=8")
    add("--seed", type=int, default=0)
    limits = parser.add_argument_group("limits")
    limit = functools.partial(limits.add_argument, type=float, metavar="X")
    limit("--amplitude-limit", required=True, help="the most that a transducer is driven at, above 0 up to 1")
    limit("--max-evaluations", type=int, default=hardware.Limits.evaluations, help="(%(default)s)")
    limit("--max-seconds", default=hardware.Limits.seconds, help="outputs on in all (%(default)s s)")
    limit(
        "--max-seconds-in-a-row",
        default=hardware.Limits.seconds_in_a_row,
        help="outputs on without a rest (%(default)s s)",
    )
    limit("--duty-cycle", default=hardware.Limits.duty_cycle, help="share of the time on (%(default)s)")
    add("--output", type=Path, help="folder of log, drive and report; outputs/hardware_SCENE_METHOD")
    add("--dry-run", action="store_true", help="show the frames of an emulated trial; no device is opened")
    add_options(parser)
    return parser.parse_args(words)


def run(options: argparse.Namespace, command: str) -> None:
    """Make the trial, from the scene to the report."""
    path = scene_path(options.scene)
    scene = at.load_scene(path)
    name = path.stem
    limits = hardware.Limits(
        options.amplitude_limit,
        options.max_evaluations,
        options.max_seconds,
        options.max_seconds_in_a_row,
        options.duty_cycle,
    )
    settings = {
        "method": options.method,
        "method settings": dict(OmegaConf.from_dotlist(options.set)),
        "seed": options.seed,
        **settings_of(options),
    }
    method = method_of(options.method, settings["method settings"], options.seed)
    simulated = at.SimulatedObjective(scene, at.make_propagator(scene))
    bench = bench_of(options, simulated)
    on_levels = at.Quantised(simulated, **bench.device.quantised)
    expected = method(on_levels)
    folder = options.output or Path("outputs") / f"hardware_{name}_{options.method}"
    if options.dry_run:
        with tempfile.TemporaryDirectory() as nowhere:
            measure(scene, bench, limits, method, Path(nowhere), settings, expected)
        return
    folder.mkdir(parents=True, exist_ok=True)
    found, preflight, log = measure(scene, bench, limits, method, folder, settings, expected)
    at.save_drive(folder / _DRIVE_FILE, found.drive[0], scene.array)
    report = write_hardware_report(
        folder, log.evaluations, found, on_levels, expected, preflight, log.origin, command
    )
    print(f"weakest focus {float(found.pressure.min()):.4g} Pa as measured; the report is {report}")


def scene_path(text: str) -> Path:
    """The scene's file, by its path or by its name among ours."""
    folder = ROOT / "configs" / "scene"
    path = Path(text) if Path(text).suffix else folder / f"{text}.yaml"
    if not path.is_file():
        ours = ", ".join(sorted(file.stem for file in folder.glob("*.yaml")))
        raise ValueError(f"--scene: {text}: no such file; must be a YAML file, or one of {ours}")
    return path


def method_of(name: str, settings: dict[str, Any], seed: int) -> Method:
    """The method with its settings bound; its seed too, where it has one."""
    function = METHODS[name]
    parameters = inspect.signature(function).parameters.keys()
    allowed = parameters - {"objective", "trials", "seed", "score"}
    for key in settings.keys() - allowed:
        raise ValueError(f"--set: unknown key {key!r}; {name} has {', '.join(sorted(allowed))}")
    return functools.partial(function, **settings, **({"seed": seed} if "seed" in parameters else {}))


def measure(
    scene: at.Scene,
    bench: Bench,
    limits: hardware.Limits,
    method: Method,
    folder: Path,
    settings: dict[str, Any],
    expected: Solution,
) -> tuple[Solution, hardware.Preflight, hardware.EvaluationLog]:
    """Check the transducers, and run the method on the device; it is silent afterwards."""
    steps = expected.history.shape[1]
    points = len(scene.control_points)
    with (
        bench.sensor() as sensor,
        bench.link() as link,
        show_progress(steps) as progress,
    ):
        limited = hardware.LimitedLink(link, limits)
        objective = hardware.HardwareObjective(
            scene, limited, sensor, folder / _LOG_FILE, settings, watcher(progress)
        )
        if objective.log.evaluations:
            logging.info("going on after %d evaluations", len(objective.log.evaluations))
        progress.begin("pre-flight check")
        with silence_expected():
            preflight = hardware.check_transducers(limited, sensor, points, bench.readings, bench.background)
        if len(preflight.dead) == len(scene.array):
            raise ValueError("the sensor hears no transducer; check the device's power, and the sensor")
        logging.info("the sensor hears %d of %d", len(scene.array) - len(preflight.dead), len(scene.array))
        if preflight.dead:
            logging.warning("not heard, counted from 0: %s", ", ".join(map(str, preflight.dead)))
        found = method(at.Quantised(objective, **bench.device.quantised))
        limited.off()
        with silence_expected():
            silent = hardware.hears_silence(sensor, preflight, points, bench.readings)
        if not silent:
            logging.warning("the sensor hears more than before the trial: are the outputs off?")
    return found, preflight, objective.log


@contextlib.contextmanager
def silence_expected() -> Iterator[None]:
    """Have an oscilloscope not warn that it hears nothing."""
    scope = logging.getLogger("autdtorch.hardware.scope")
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


def main() -> int:
    """Run the command line; returns the status for the shell."""
    options = arguments()
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    command = shlex.join(["python", *sys.argv])
    goes_on = "the outputs are off, and the same command goes on where the log ends"
    try:
        with hardware.ended_by_signals():
            run(options, command)
    except hardware.Signalled as signalled:
        logging.error("hardware_trial: %s: %s", signalled, goes_on)
        return 128 + signalled.number
    except hardware.LimitError as error:
        logging.error("hardware_trial: %s: the outputs are off; a higher limit goes on from here", error)
        return _LIMITED
    except (ValueError, OSError, ImportError) as error:
        logging.error("hardware_trial: %s", error)
        return _REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
