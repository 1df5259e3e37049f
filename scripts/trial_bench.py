"""The bench of a hardware trial, from the options of the command line: device, and sensor."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import autdtorch as at
from autdtorch import hardware
from autdtorch.conditions import random_rms
from autdtorch.hardware.dry_run import DryPort

DEVICES = {
    "sonicsurface": hardware.SONICSURFACE,
    "openmpd": hardware.OPENMPD,
    "ultraino": hardware.ULTRAINO,
}
EMULATED = {
    "emulated": hardware.SONICSURFACE,
    **{f"emulated:{name}": device for name, device in DEVICES.items()},
}
SENSORS = ("emulated", "scope", "file", "manual")
MAKERS = {"keysight": hardware.KEYSIGHT, "rigol": hardware.RIGOL}

_EMULATED_SCOPE = (0x2A8D, 0x1770)


class Bench(NamedTuple):
    """What a trial works with, and how often the pre-flight check reads a transducer and the silence."""

    device: hardware.Device
    link: Callable[[], hardware.Link]
    sensor: Callable[[], contextlib.AbstractContextManager[hardware.Sensor]]
    readings: int
    background: int


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that say what the bench is."""
    device = parser.add_argument_group("device").add_argument
    device("--device", required=True, choices=[*DEVICES, *EMULATED])
    device("--serial", help="number of its USB chip, where several are plugged in")
    device("--transducers", type=indices, help="which of the device's the scene's are, as 102-105,118-121")
    sensor = parser.add_argument_group("sensor").add_argument
    sensor("--sensor", choices=SENSORS, help="by default emulated, on an emulated device")
    sensor("--readings-file", help="of the sensor `file`: where another program writes each reading [Pa]")
    sensor("--scope-chip", type=chip, help="of the sensor `scope`: VID:PID, as 2a8d:1770")
    sensor("--scope-maker", choices=list(MAKERS), default="keysight", help="(%(default)s)")
    sensor("--sensitivity", type=float, default=0.01, help="with the amplifier (%(default)s V/Pa)")
    sensor("--loudest", type=float, default=20.0, help="that the inputs must take (%(default)s Pa)")
    sensor("--captures", type=int, default=1, help="to average over (%(default)s)")
    sensor("--moved", action="store_true", help="one microphone, moved from control point to control point")
    emulated = parser.add_argument_group("emulated device").add_argument
    emulated("--snr", type=float, help="of a reading, or of a scope's sample [dB]; without it, no noise")
    emulated("--dead", type=indices, default=[], help="transducers of the scene that are silent")


def indices(text: str) -> list[int]:
    """Numbers of transducers: `3,7-9` is 3, 7, 8, 9."""
    parts = [part.partition("-") for part in text.split(",")]
    ranges = [range(int(low), int(high or low) + 1) for low, _, high in parts]
    if not all(ranges):
        raise argparse.ArgumentTypeError(f"{text!r}; must be numbers and ranges that go up, as 3,7-9")
    return [one for some in ranges for one in some]


def chip(text: str) -> tuple[int, int]:
    """IdVendor and idProduct of `2a8d:1770`."""
    vendor, product = text.split(":")
    return int(vendor, 16), int(product, 16)


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """What of the bench makes a trial what it is, beside the device."""
    kind = _kind(options)
    settings: dict[str, Any] = {"sensor": kind}
    if kind == "scope":
        settings |= {"sensitivity [V/Pa]": options.sensitivity, "captures": options.captures}
    if options.device in EMULATED:
        settings |= {"snr [dB]": options.snr, "dead": options.dead}
    return settings


def bench_of(options: argparse.Namespace, simulated: at.SimulatedObjective) -> Bench:
    """The bench that the options describe; nothing is opened yet."""
    count = len(simulated.scene.array)
    device = {**DEVICES, **EMULATED}[options.device]
    emulated = options.device in EMULATED
    if options.transducers is None and not emulated and count != device.transducers:
        raise ValueError(
            f"--transducers: none; must say which {count} of the {device.transducers} transducers of "
            f"{device.name} the scene's are"
        )
    transducers = list(range(count)) if options.transducers is None else options.transducers
    on_bench = None
    if emulated or options.dry_run:
        on_bench = hardware.EmulatedBench(device, simulated.transfer_matrix, transducers, dead=options.dead)
    backend = None if on_bench is None else on_bench.bus

    def link() -> hardware.Link:
        if options.dry_run:
            return hardware.Link(device, DryPort(on_bench, device, print), transducers, sleep=backend.sleep)
        return hardware.open_link(device, transducers, options.serial, backend)

    kind = _kind(options)
    by_hand = kind == "manual" or (kind == "scope" and options.moved)
    check = (1, 1) if by_hand else (4, 32)
    return Bench(device, link, lambda: _sensor(options, simulated.scene, on_bench), *check)


def _kind(options: argparse.Namespace) -> str:
    if options.dry_run:
        return "emulated"
    kind = options.sensor or "emulated"
    if kind == "emulated" and options.device not in EMULATED:
        raise ValueError(f"--sensor: {options.sensor}; must be scope, file or manual on a real device")
    return kind


@contextlib.contextmanager
def _sensor(options: argparse.Namespace, scene: at.Scene, bench: hardware.EmulatedBench | None) -> Any:
    """The sensor, open."""
    points = scene.control_points
    match _kind(options):
        case "emulated":
            yield hardware.EmulatedSensor(bench, options.snr, options.seed)
        case "manual":
            yield hardware.ManualSensor(points)
        case "file":
            if options.readings_file is None:
                raise ValueError("--readings-file: none; must be the file of the readings")
            yield hardware.FileSensor(options.readings_file, len(points))
        case "scope":
            with _scope(options, scene, bench) as scope:
                inputs = range(1, 2 if options.moved else len(points) + 1)
                microphones = [
                    hardware.Microphone(number, options.sensitivity, options.loudest) for number in inputs
                ]
                sensor = hardware.ScopeSensor(scope, scene.frequency, microphones, options.captures)
                yield hardware.MovedMicrophone(sensor, points) if options.moved else sensor


def _scope(
    options: argparse.Namespace, scene: at.Scene, bench: hardware.EmulatedBench | None
) -> hardware.Oscilloscope:
    dialect = MAKERS[options.scope_maker]
    if bench is None:
        if options.scope_chip is None:
            raise ValueError("--scope-chip: none; must be the VID:PID of the oscilloscope, as lsusb shows it")
        return hardware.open_scope(options.scope_chip, dialect)
    rms = random_rms(bench.transfer_matrix)
    emulated = hardware.EmulatedScope(
        bench.pressure,
        scene.frequency,
        options.sensitivity,
        range(len(scene.control_points)),
        dialect.name.partition(" ")[0],
        noise=0.0 if options.snr is None else options.sensitivity * rms * 10 ** (-options.snr / 20),
        seed=options.seed,
    )
    emulated.plug_into(bench, _EMULATED_SCOPE)
    return hardware.open_scope(_EMULATED_SCOPE, dialect, backend=bench.bus)
