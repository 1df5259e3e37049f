"""The bench of a hardware trial, from the section `hardware` of a config: device, sensor and limits."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

from autdtorch import hardware
from autdtorch.cli.settings import section_of
from autdtorch.hardware.devices.openmpd_board import OpenMPDBoard
from autdtorch.hardware.sensors.by_hand import typed
from autdtorch.objectives.perturbations import random_rms
from autdtorch.objectives.simulated import SimulatedObjective
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.digest import digest_of
from autdtorch.utils.validation import (
    boolean,
    finite_number,
    indices,
    integer_at_least,
    invalid,
    require_known,
    require_one_of,
)

_MAKERS = {"keysight": hardware.KEYSIGHT, "rigol": hardware.RIGOL}
_EMULATED_SCOPE = "2a8d:1770"

_SENSORS = {
    "emulated": ("kind", "snr"),
    "scope": ("kind", "chip", "maker", "sensitivity", "loudest", "captures", "moved", "snr"),
    "file": ("kind", "path"),
    "manual": ("kind",),
}
"""Keys of the section `hardware.sensor`, by its `kind`."""

_KEYS = (
    "device", "emulated", "boards", "transducers", "failed", "port", "serial", "network", "settle",
    "dry_run", "limits", "sensor",
)  # fmt: skip


class Bench:
    """The device and the sensor that a config describes; nothing is opened yet.

    `transducers` are the device's for each of the scene's. `settings` identify the trial beside its device.
    """

    def __init__(self, section: Mapping[str, Any], scene: Scene, seed: int) -> None:
        """Check the section `hardware` of a config; `seed` is the seed of emulated noise."""
        _require_keys("hardware", section, _KEYS)
        require_one_of("hardware.device", section["device"], hardware.DEVICES)
        self._section, self._scene, self._seed = section, scene, seed
        limits = section_of(section, "limits")
        _require_keys("hardware.limits", limits, [field.name for field in fields(hardware.Limits)])
        self.limits = hardware.Limits(**limits)
        self.is_dry = boolean("hardware.dry_run", section["dry_run"])  # frames are printed, nothing is opened
        self._emulated = boolean("hardware.emulated", section["emulated"]) or self.is_dry
        self._sensor: dict[str, Any] = (
            {"kind": "emulated", "snr": None} if self.is_dry else section_of(section, "sensor")
        )
        _require_sensor(self._sensor, self._emulated)
        _require_fit(section, self._emulated)
        self.device, self._boards = _device(section)
        self.transducers = self._wired(len(scene.array))
        failed = section["failed"]
        self._failed = indices_of("hardware.failed", failed, len(scene.array)) if failed else []
        self.by_hand = self._sensor["kind"] == "manual" or bool(self._sensor.get("moved"))
        self._bench: hardware.EmulatedBench | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that identify the trial beside its device."""
        settings: dict[str, Any] = {"sensor": self._sensor["kind"]}
        if self._sensor["kind"] == "scope":
            settings["sensitivity [V/Pa]"] = self._sensor["sensitivity"]
            settings["captures"] = self._sensor["captures"]
        if self._emulated:
            settings |= {"emulated": True, "snr [dB]": self._sensor.get("snr"), "failed": self._failed}
        if self._boards:
            settings["boards"] = [f"{board.name} {digest_of(board)[:16]}" for board in self._boards]
        return settings

    def emulate(self, simulated: SimulatedObjective) -> None:
        """Make the emulated bench, if there is one, with the transfer matrix of a simulated objective."""
        if self._emulated and simulated.transfer_matrix is not None:
            matrix, wired = _deviating(simulated.transfer_matrix, self._boards, self.transducers)
            self._bench = hardware.EmulatedBench(self.device, matrix, wired, dead=self._failed)

    def link(self) -> hardware.Link:
        """Open the link to the device or its emulator."""
        section, settle, bench = self._section, self._section["settle"], self._bench
        boards, on_network = self.device.boards, section["device"] == "autd3"
        if bench is None and on_network:
            return hardware.open_autd3(boards, self.transducers, _network(section["network"]), settle)
        if bench is None:
            serial, port = (None if section[key] is None else str(section[key]) for key in ("serial", "port"))
            return hardware.open_link(self.device, self.transducers, serial, settle=settle, port=port)
        if not (self.is_dry or on_network):
            return hardware.open_link(self.device, self.transducers, backend=bench.bus, settle=settle)
        from autdtorch.hardware.emulator.bench import DryPort, EmulatedAutd3Port  # needs pyusb

        opened = DryPort(bench, print) if self.is_dry else EmulatedAutd3Port(boards, bench)
        return hardware.Link(self.device, opened, self.transducers, settle, bench.bus.sleep)

    @contextlib.contextmanager
    def sensor(self) -> Iterator[hardware.Sensor]:
        """Open the sensor."""
        given, points = self._sensor, self._scene.control_points
        match given["kind"]:
            case "emulated" if self._bench is not None:
                yield hardware.EmulatedSensor(self._bench, given["snr"], self._seed)
            case "manual":
                yield hardware.ManualSensor(points, _ask)
            case "file":
                yield hardware.FileSensor(given["path"], len(points))
            case _:
                with self._scope() as scope:
                    inputs = range(1, 2 if given["moved"] else len(points) + 1)
                    each = given["sensitivity"], given["loudest"]
                    heads = [hardware.Microphone(number, *each) for number in inputs]
                    sensor = hardware.ScopeSensor(scope, self._scene.frequency, heads, given["captures"])
                    yield hardware.MovedMicrophone(sensor, points, _ask) if given["moved"] else sensor

    def _wired(self, count: int) -> list[int]:
        """Return the device's transducers for the scene's `count`."""
        field, given, most = "hardware.transducers", self._section["transducers"], self.device.transducers
        if count > most:
            accepted = f"must be at most {most}, as {self.device.name} has"
            raise invalid("scene", f"{count} transducers", accepted)
        if given is None and not self._section["emulated"] and count != most:
            accepted = (
                f"must say which {count} of the {most} transducers of {self.device.name} the scene's are"
            )
            raise invalid(field, None, accepted)
        chosen = list(range(count)) if given is None else indices_of(field, given, most)
        if len(chosen) != count:
            raise invalid(field, f"{len(chosen)} transducers", f"must be {count}, as many as the scene has")
        return chosen

    def _scope(self) -> hardware.Oscilloscope:
        given = self._sensor
        dialect = _MAKERS[given["maker"]]
        chip = _chip(given["chip"] or _EMULATED_SCOPE)
        if self._bench is None:
            return hardware.open_scope(chip, dialect)
        snr = given["snr"]
        rms = random_rms(self._bench.transfer_matrix)
        emulated = hardware.EmulatedScope(
            self._bench.pressure,
            self._scene.frequency,
            given["sensitivity"],
            range(len(self._scene.control_points)),
            dialect.name.partition(" ")[0],
            noise=0.0 if snr is None else given["sensitivity"] * rms * 10 ** (-snr / 20),
            seed=self._seed,
        )
        emulated.plug_into(self._bench, chip)
        return hardware.open_scope(chip, dialect, backend=self._bench.bus)


def indices_of(field: str, value: object, count: int) -> list[int]:
    """Return indices below `count`, each once, from a list or from text such as "3,7-9"."""
    if not isinstance(value, list):
        try:
            parts = [part.partition("-") for part in str(value).split(",")]
            ranges = [range(int(low), int(high or low) + 1) for low, _, high in parts]
        except ValueError:
            ranges = []
        if not ranges or not all(ranges) or sum(map(len, ranges)) > count:
            accepted = f"must be numbers from 0 to {count - 1}, each once, and ranges that go up, as 3,7-9"
            raise invalid(field, value, accepted)
        value = [one for some in ranges for one in some]
    return indices(field, value, count)


def _require_keys(where: str, section: Mapping[str, Any], keys: Collection[str]) -> None:
    require_known(where, section, keys)
    if missing := [key for key in keys if key not in section]:
        accepted = "must be there, as by `defaults: [base, sensor: scope, _self_]`"
        raise ValueError(f"{where}: no {', '.join(missing)}; {accepted}")


def _require_sensor(section: Mapping[str, Any], emulated: bool) -> None:
    kind = section.get("kind")
    require_one_of("hardware.sensor.kind", kind, _SENSORS)
    _require_keys("hardware.sensor", section, _SENSORS[str(kind)])
    if kind == "emulated" and not emulated:
        raise invalid("hardware.sensor", kind, "must be scope, file or manual on a real device")
    if section.get("snr") is not None:
        if not emulated:
            raise invalid("hardware.sensor.snr", section["snr"], "must be null: it is for an emulated device")
        finite_number("hardware.sensor.snr", section["snr"])
    if kind == "file" and section["path"] is None:
        raise invalid("hardware.sensor.path", None, "must be the file that holds the readings")
    if kind == "scope":
        require_one_of("hardware.sensor.maker", section["maker"], _MAKERS)
        boolean("hardware.sensor.moved", section["moved"])
        if not emulated and section["chip"] is None:
            accepted = "the oscilloscope's VID:PID, as lsusb shows it; or hardware/sensor=file or manual"
            raise invalid("hardware.sensor.chip", None, f"must be {accepted}")
        if emulated and section["moved"]:
            raise invalid("hardware.sensor.moved", True, "must be false: it is for a real device")


def _require_fit(section: Mapping[str, Any], emulated: bool) -> None:
    """Check that no key is given that has no meaning for the device."""
    device = section["device"]
    fits = {
        "boards": (device != "sonicsurface", "openmpd, ultraino and autd3"),
        "network": (device == "autd3" and not emulated, "AUTD3"),
        "serial": (device != "autd3" and not emulated, "a real device on USB"),
        "port": (device != "autd3" and not emulated, "a real device at a serial port"),
        "failed": (emulated, "an emulated device"),
    }
    for key, (fit, bench) in fits.items():
        if section[key] not in (None, []) and not fit:
            raise invalid(f"hardware.{key}", section[key], f"must be null: it is for {bench}")


def _device(section: Mapping[str, Any]) -> tuple[hardware.Device, list[OpenMPDBoard]]:
    """Return the device, and the boards of OpenMPD from their .pat files, if there are any."""
    given = section["boards"]
    if section["device"] != "openmpd" or given is None:
        count = integer_at_least("hardware.boards", 1 if given is None else given, 1)
        return hardware.DEVICES[section["device"]].with_boards(count), []
    if not isinstance(given, list) or not given:
        raise invalid("hardware.boards", given, "must be a list of the boards' .pat files")
    for name in given:
        if not Path(str(name)).is_file():
            raise invalid("hardware.boards", name, "no such file; must be the .pat files of the boards")
    boards = [OpenMPDBoard.load(str(name)) for name in given]
    return hardware.openmpd_boards(boards), boards


def _deviating(
    matrix: torch.Tensor, boards: list[OpenMPDBoard], transducers: list[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return transfer matrix and wiring of transducers that deviate as the boards' files say."""
    wired = torch.tensor(transducers, dtype=torch.int64, device="cpu")
    if not boards:
        return matrix, wired
    each = len(boards[0].pins)
    asked = torch.ones(each, **COMPLEX)
    corrections = torch.cat([board.calibrated(asked) for board in boards])[wired]
    pins = [each * number + pin for number, board in enumerate(boards) for pin in board.pins]
    places = torch.tensor(pins, dtype=torch.int64, device="cpu")[wired]
    return torch.where(corrections == 0, 0, matrix / corrections), places


def _chip(text: object) -> tuple[int, int]:
    """Return idVendor and idProduct of text such as "2a8d:1770", as lsusb shows them."""
    found = re.fullmatch(r"(?:0x)?([0-9a-f]{1,4}):(?:0x)?([0-9a-f]{1,4})", str(text), re.IGNORECASE)
    if found is None:
        accepted = "must be VID:PID with four digits each, as 2a8d:1770"
        raise invalid("hardware.sensor.chip", text, accepted)
    return int(found[1], 16), int(found[2], 16)


def _network(network: object) -> Any:
    """Return the setting `hardware.network` as the kit of AUTD3 takes it."""
    if network is None:
        return None
    from autdtorch.hardware.transport.autd3_network import autd3_kit

    kind, separator, port = str(network).partition(":")
    if (kind, separator) != ("server", ":"):
        return autd3_kit().UdpOption(str(network))
    if not (port.isdecimal() and 0 < int(port) < 2**16):
        raise invalid("hardware.network", network, "must be server:PORT with a port from 1 to 65535")
    return autd3_kit().ServerLink(int(port))


def _ask(question: str) -> str:
    """Ask below the progress bar."""
    return typed(f"\n{question}")
