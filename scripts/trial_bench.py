"""The bench of a hardware trial, from the options of the command line: device, and sensor."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

import autdtorch as at
from autdtorch import hardware
from autdtorch.hardware.sensors.by_hand import typed
from autdtorch.hardware.transport.autd3_network import autd3_kit
from autdtorch.hardware.wiring import Wiring
from autdtorch.objectives.perturbations import random_rms
from autdtorch.utils.digest import digest_of

_USUAL = "emulated"
EMULATED = (_USUAL, *(f"emulated:{name}" for name in hardware.DEVICES))
SENSORS = ("emulated", "scope", "file", "manual")
MAKERS = {"keysight": hardware.KEYSIGHT, "rigol": hardware.RIGOL}

_EMULATED_SCOPE = (0x2A8D, 0x1770)


class Bench(NamedTuple):
    """What a trial works with, and how often the pre-flight check reads a transducer and the silence."""

    link: Callable[[], hardware.Link]
    sensor: Callable[[], contextlib.AbstractContextManager[hardware.Sensor]]
    readings: int
    background: int


def device_name(options: argparse.Namespace) -> str:
    """Which of `hardware.DEVICES`, real or emulated."""
    return "sonicsurface" if options.device == _USUAL else str(options.device).removeprefix("emulated:")


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """What of the bench makes a trial what it is, beside the device."""
    kind = _sensor_kind(options)
    settings: dict[str, Any] = {"sensor": kind}
    if kind == "scope":
        settings |= {"sensitivity [V/Pa]": options.sensitivity, "captures": options.captures}
    if options.device in EMULATED:
        settings |= {"emulated": True, "snr [dB]": options.snr, "dead": options.dead}
    if device_name(options) == "openmpd" and options.boards:
        settings["boards"] = [f"{board.name} {digest_of(board)[:16]}" for board in _openmpd_boards(options)]
    return settings


def wired_device(options: argparse.Namespace, count: int) -> tuple[hardware.Device, list[int]]:
    """The device, and which of its transducers the scene's `count` are."""
    device = _device(options)
    if options.transducers is None and options.device not in EMULATED and count != device.transducers:
        raise ValueError(
            f"--transducers: none; must say which {count} of the {device.transducers} transducers of "
            f"{device.name} the scene's are"
        )
    chosen = range(count) if options.transducers is None else options.transducers
    if len(chosen) != count:
        raise ValueError(f"--transducers: {len(chosen)}; must be {count}, as many as the scene has")
    if max(options.dead, default=0) >= count:
        raise ValueError(f"--dead: {max(options.dead)}; must be 0 to {count - 1}, as the scene has them")
    return device, Wiring(device, chosen).transducers.tolist()


def bench_of(
    options: argparse.Namespace,
    device: hardware.Device,
    transducers: list[int],
    simulated: at.SimulatedObjective,
) -> Bench:
    """The bench that the options describe; nothing is opened yet."""
    on_bench = None
    if options.device in EMULATED or options.dry_run:
        on_bench = _emulated_bench(options, device, simulated.transfer_matrix, transducers)
    by_hand = _sensor_kind(options) == "manual" or options.moved
    return Bench(
        lambda: _link(options, device, transducers, on_bench),
        lambda: _sensor(options, simulated.scene, on_bench),
        *((1, 1) if by_hand else (4, 32)),
    )


def _device(options: argparse.Namespace) -> hardware.Device:
    if device_name(options) != "openmpd":
        return hardware.DEVICES[device_name(options)].with_boards(_board_count(options))
    return hardware.openmpd_boards(_openmpd_boards(options)) if options.boards else hardware.OPENMPD


def _openmpd_boards(options: argparse.Namespace) -> list[at.OpenMPDBoard]:
    for name in options.boards:
        if not Path(name).is_file():
            raise ValueError(f"--boards: {name}: no such file; must be the .pat files of the boards")
    return [at.OpenMPDBoard.load(name) for name in options.boards]


def _emulated_bench(
    options: argparse.Namespace, device: hardware.Device, matrix: torch.Tensor, transducers: list[int]
) -> hardware.EmulatedBench:
    """A bench whose transducers are wired and deviate as the boards' files say."""
    wired = torch.tensor(transducers)
    if device_name(options) == "openmpd" and options.boards:
        boards = _openmpd_boards(options)
        each = device.transducers // len(boards)
        asked = torch.ones(each, dtype=torch.complex128)
        corrections = torch.cat([board.calibrated(asked) for board in boards])[wired]
        matrix = torch.where(corrections == 0, 0, matrix / corrections)
        pins = torch.tensor(
            [each * number + pin for number, board in enumerate(boards) for pin in board.pins]
        )
        wired = pins[wired]
    return hardware.EmulatedBench(device, matrix, wired, dead=options.dead)


def _board_count(options: argparse.Namespace) -> int:
    match options.boards:
        case None:
            return 1
        case [text] if text.isdecimal():
            return int(text)
    raise ValueError(f"--boards: {' '.join(options.boards)}; must be the number of boards, an integer")


def _link(
    options: argparse.Namespace,
    device: hardware.Device,
    transducers: list[int],
    bench: hardware.EmulatedBench | None,
) -> hardware.Link:
    """The link, open."""
    on_network, settle = device_name(options) == "autd3", options.settle
    if bench is None:
        if on_network:
            return hardware.open_autd3(_board_count(options), transducers, _network(options.network), settle)
        return hardware.open_link(device, transducers, options.serial, settle=settle)
    # Imported here, as both need pyusb: without it, no more than its hint is to be shown.
    if options.dry_run:
        from autdtorch.hardware.emulator.dry_run import DryPort

        port: hardware.Port = DryPort(bench, print)
    elif on_network:
        from autdtorch.hardware.emulator.emulated_autd3 import EmulatedAutd3Port

        port = EmulatedAutd3Port(_board_count(options), bench)
    else:
        return hardware.open_link(device, transducers, backend=bench.bus, settle=settle)
    return hardware.Link(device, port, transducers, settle, bench.bus.sleep)


def _network(network: str | int | None) -> Any:
    """What the kit of AUTD3 takes for `--network`."""
    if network is None:
        return None
    autd3 = autd3_kit()
    return autd3.ServerLink(network) if isinstance(network, int) else autd3.UdpOption(network)


def _sensor_kind(options: argparse.Namespace) -> str:
    """Which of `SENSORS`; what it needs besides is given."""
    if options.dry_run:
        return "emulated"
    kind = options.sensor or "emulated"
    if kind == "emulated" and options.device not in EMULATED:
        given = options.sensor or "none"
        raise ValueError(f"--sensor: {given}; must be scope, file or manual on a real device")
    if kind == "file" and options.readings_file is None:
        raise ValueError("--readings-file: none; must be the file of the readings")
    if kind == "scope" and options.device not in EMULATED and options.scope_chip is None:
        raise ValueError("--scope-chip: none; must be the VID:PID of the oscilloscope, as lsusb shows it")
    return str(kind)


@contextlib.contextmanager
def _sensor(options: argparse.Namespace, scene: at.Scene, bench: hardware.EmulatedBench | None) -> Any:
    """The sensor, open."""
    points = scene.control_points
    match _sensor_kind(options):
        case "emulated":
            yield hardware.EmulatedSensor(bench, options.snr, options.seed)
        case "manual":
            yield hardware.ManualSensor(points, _ask)
        case "file":
            yield hardware.FileSensor(options.readings_file, len(points))
        case "scope":
            with _scope(options, scene, bench) as scope:
                inputs = range(1, 2 if options.moved else len(points) + 1)
                microphones = [
                    hardware.Microphone(number, options.sensitivity, options.loudest) for number in inputs
                ]
                sensor = hardware.ScopeSensor(scope, scene.frequency, microphones, options.captures)
                yield hardware.MovedMicrophone(sensor, points, _ask) if options.moved else sensor


def _ask(question: str) -> str:
    """Below the bar of the progress, which says what is played."""
    return typed(f"\n{question}")


def _scope(
    options: argparse.Namespace, scene: at.Scene, bench: hardware.EmulatedBench | None
) -> hardware.Oscilloscope:
    dialect = MAKERS[options.scope_maker]
    if bench is None:
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
    chip = options.scope_chip or _EMULATED_SCOPE
    emulated.plug_into(bench, chip)
    return hardware.open_scope(chip, dialect, backend=bench.bus)
