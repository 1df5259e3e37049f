"""Run a method on a device, or on its emulator; an interrupted trial goes on with the same command.

python scripts/hardware_trial.py --device emulated --method gabs --amplitude-limit 1
"""

from __future__ import annotations

import argparse
import functools
import inspect
import logging
import shlex
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import OmegaConf

import autdtorch as at
from autdtorch import hardware
from autdtorch.hardware.dry_run import DryPort
from autdtorch.hardware_report import write_hardware_report
from autdtorch.optim.base import Solution
from autdtorch.progress import Progress, show_progress

ROOT = Path(__file__).parents[1]

METHODS = {"lssg": at.lssg, "gabs": at.gabs, "bo": at.bayes_opt, "identify": at.identify}
DEVICES = {
    "sonicsurface": hardware.SONICSURFACE,
    "openmpd": hardware.OPENMPD,
    "ultraino": hardware.ULTRAINO,
}
EMULATED = {
    "emulated": hardware.SONICSURFACE,
    **{f"emulated:{name}": device for name, device in DEVICES.items()},
}

_REFUSED, _LIMITED = 2, 3
_LOG_FILE, _DRIVE_FILE = "trial.jsonl", "drive.npz"

Method = Callable[[at.Objective], Solution]


class Bench(NamedTuple):
    """What a trial works with."""

    device: hardware.Device
    open_link: Callable[[], hardware.Link]
    sensor: hardware.Sensor


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = parser.add_argument
    add("--device", required=True, choices=[*DEVICES, *EMULATED])
    add("--serial", help="number of the USB chip, where several are plugged in")
    add(
        "--transducers",
        type=indices,
        help="which of the device's the scene's are, as 102-105,118; by default the first",
    )
    add("--sensor", choices=["emulated"], default="emulated")
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
    emulated = parser.add_argument_group("emulated bench")
    emulated.add_argument("--snr", type=float, help="of the microphones [dB]; none: no noise")
    emulated.add_argument("--dead", type=indices, default=[], help="transducers of the scene that are silent")
    return parser.parse_args(words)


def indices(text: str) -> list[int]:
    """Numbers of transducers: `3,7-9` is 3, 7, 8, 9."""
    parts = [part.partition("-") for part in text.split(",")]
    return [one for low, _, high in parts for one in range(int(low), int(high or low) + 1)]


def run(options: argparse.Namespace, command: str) -> None:
    """Make the trial, from the scene to the report."""
    path = Path(options.scene)
    scene = at.load_scene(path if path.suffix else ROOT / "configs" / "scene" / f"{options.scene}.yaml")
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
        "sensor": options.sensor,
        "snr [dB]": options.snr,
        "dead": options.dead,
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


def method_of(name: str, settings: dict[str, Any], seed: int) -> Method:
    """The method with its settings bound; its seed too, where it has one."""
    function = METHODS[name]
    parameters = inspect.signature(function).parameters.keys()
    allowed = parameters - {"objective", "trials", "seed", "score"}
    for key in settings.keys() - allowed:
        raise ValueError(f"--set: unknown key {key!r}; {name} has {', '.join(sorted(allowed))}")
    return functools.partial(function, **settings, **({"seed": seed} if "seed" in parameters else {}))


def bench_of(options: argparse.Namespace, simulated: at.SimulatedObjective) -> Bench:
    """The device, how it is opened, and the sensor."""
    count = len(simulated.scene.array)
    device = {**DEVICES, **EMULATED}[options.device]
    transducers = options.transducers or list(range(count))
    emulated = options.dry_run or options.device in EMULATED
    if not emulated:
        if options.transducers is None and count != device.transducers:
            raise ValueError(
                f"--transducers: none; must say which {count} of the {device.transducers} transducers of "
                f"{device.name} the scene's are"
            )
        raise ValueError("--sensor: none for a real device yet")
    matrix = simulated.transfer_matrix
    bench = hardware.EmulatedBench(device, matrix, transducers, dead=options.dead)
    sensor = hardware.EmulatedSensor(bench, options.snr, options.seed)
    if options.dry_run:
        return Bench(
            device, lambda: hardware.Link(device, DryPort(bench, device, print), transducers), sensor
        )
    return Bench(device, lambda: hardware.open_link(device, transducers, backend=bench.bus), sensor)


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
    with hardware.ended_by_signals(), bench.open_link() as link, show_progress(steps) as progress:
        limited = hardware.LimitedLink(link, limits)
        objective = hardware.HardwareObjective(
            scene, limited, bench.sensor, folder / _LOG_FILE, settings, watcher(progress)
        )
        if objective.log.evaluations:
            logging.info("going on after %d evaluations", len(objective.log.evaluations))
        progress.begin("pre-flight check")
        preflight = hardware.check_transducers(limited, bench.sensor, len(scene.control_points))
        if len(preflight.dead) == len(scene.array):
            raise ValueError("the sensor hears no transducer; check the device's power, and the sensor")
        logging.info("the sensor hears %d of %d", len(scene.array) - len(preflight.dead), len(scene.array))
        if preflight.dead:
            logging.warning("not heard, counted from 0: %s", ", ".join(map(str, preflight.dead)))
        found = method(at.Quantised(objective, **bench.device.quantised))
        limited.off()
        if not hardware.hears_silence(bench.sensor, preflight, len(scene.control_points)):
            logging.warning("the sensor hears more than before the trial: are the outputs off?")
    return found, preflight, objective.log


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
        run(options, command)
    except hardware.Signalled as signalled:
        logging.error("hardware_trial: %s: %s", signalled, goes_on)
        return 128 + signalled.number
    except hardware.LimitError as error:
        logging.error("hardware_trial: %s: the outputs are off; a higher limit goes on from here", error)
        return _LIMITED
    except (ValueError, OSError) as error:
        logging.error("hardware_trial: %s", error)
        return _REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
