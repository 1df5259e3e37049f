"""The bench of a trial: the device and the sensor that the section `hardware` of a config describes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import fields
from typing import Any

import torch

from autdtorch import hardware
from autdtorch.cli.settings import section_of
from autdtorch.hardware.sensors.by_hand import typed
from autdtorch.hardware.sensors.sensor import AnySensor, SensorConfig, Setup
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.propagators import Propagator
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import boolean, indices, invalid, require_known, require_one_of, within

#: Keys of the section `hardware` of every bench; `DEVICES` and `SENSORS` declare the others.
_KEYS = ("device", "emulated", "transducers", "failed", "settle", "dry_run", "limits", "sensor")


class Bench:
    """The device and the sensor that a config describes; nothing is opened yet.

    `transducers` are the device's for each of the scene's. `settings` identify the trial beside its device.
    """

    def __init__(self, section: Mapping[str, Any], scene: Scene, seed: int, has_sensor: bool = True) -> None:
        """Check the section `hardware` of a config, whose sensor may play no part.

        `seed` is the seed of emulated noise.
        """
        device_keys = {key for each in hardware.DEVICES.values() for key in (*each.keys, *each.port_keys)}
        _require_keys("hardware", section, _KEYS, device_keys)
        require_one_of("hardware.device", section["device"], hardware.DEVICES)
        self._section, self._scene, self._seed = section, scene, seed
        limits = section_of(section, "limits")
        _require_keys("hardware.limits", limits, [field.name for field in fields(hardware.Limits)])
        with within("hardware.limits"):
            self.limits = hardware.Limits(**limits)
        self.is_dry = boolean("hardware.dry_run", section["dry_run"])  # frames are printed, nothing is opened
        self.is_emulated = boolean("hardware.emulated", section["emulated"]) or self.is_dry
        silent = self.is_dry or not has_sensor
        sensor = {"kind": "emulated", "snr": None} if silent else section_of(section, "sensor")
        self._sensor, self._kind = _sensor(sensor, self.is_emulated or silent), sensor["kind"]
        _require_fit(section, self.is_emulated)
        self.device = hardware.DEVICES[section["device"]].configured(section)
        failed, count = section["failed"], len(scene.array)
        self.transducers = self._wired(count)
        self._failed = indices_of("hardware.failed", failed, count, "the scene's") if failed else []
        self.by_hand = self._sensor.by_hand
        self._bench: hardware.EmulatedBench | None = None
        self._matrix_of: Callable[[torch.Tensor], torch.Tensor] = _no_matrix

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that identify the trial beside its device."""
        settings = {"sensor": self._kind, **self._sensor.settings}
        if self.is_emulated:
            snr = getattr(self._sensor, "snr", None)
            settings |= {"emulated": True, "snr [dB]": snr, "failed": self._failed}
        return settings | self.device.settings

    def emulate(self, simulated: SimulatedObjective, propagator: Propagator) -> None:
        """Make the emulated bench, if there is one, with the transfer matrix of a simulated objective."""
        if self.is_emulated and simulated.transfer_matrix is not None:
            chosen = torch.tensor(self.transducers, dtype=torch.int64, device="cpu")
            matrix, wired = self.device.as_built(simulated.transfer_matrix, chosen)
            self._bench = hardware.EmulatedBench(self.device, matrix, wired, self._failed)
            self._matrix_of = lambda points: self.device.as_built(propagator.transfer_matrix(points), chosen)[
                0
            ]

    def link(self) -> hardware.Link:
        """Open the link to the device or its emulator."""
        device, bench, settle = self.device, self._bench, self._section["settle"]
        if bench is None:
            place = {key: self._section.get(key) for key in device.port_keys}
            texts = {key: str(value) for key, value in place.items() if value is not None}
            return hardware.Link(device, device.open_port(texts), self.transducers, settle)
        port = bench.port(print) if self.is_dry else device.emulated_port(bench)
        return hardware.Link(device, port, self.transducers, settle, bench.bus.sleep)

    def sensor(self) -> AbstractContextManager[AnySensor]:
        """Return a context in which the sensor is open."""
        return self._sensor.open(Setup(self._scene, _ask, self._bench, self._seed, self._matrix_of))

    def _wired(self, count: int) -> list[int]:
        field, chosen, most = "hardware.transducers", self._section["transducers"], self.device.transducers
        if count > most:
            accepted = f"must be at most {most}, as {self.device.name} has"
            raise invalid("scene", f"{count} transducers", accepted)
        if chosen is None and not self._section["emulated"] and count != most:
            accepted = (
                f"must say which {count} of the {most} transducers of {self.device.name} the scene's are"
            )
            raise invalid(field, None, accepted)
        wired = list(range(count)) if chosen is None else indices_of(field, chosen, most, "the device's")
        if len(wired) != count:
            raise invalid(field, f"{len(wired)} transducers", f"must be {count}, as many as the scene has")
        return wired


def _no_matrix(points: torch.Tensor) -> torch.Tensor:
    raise NotImplementedError("a real bench has no transfer matrix")


def indices_of(field: str, value: object, count: int, whose: str) -> list[int]:
    """Return indices of transducers below `count`, each once, from a list or text such as "3,7-9"."""
    numbers = f"numbers of {whose} transducers"
    if not isinstance(value, list):
        try:
            parts = [part.partition("-") for part in str(value).split(",")]
            ranges = [range(int(low), int(high or low) + 1) for low, _, high in parts]
        except ValueError:
            ranges = []
        if not ranges or not all(ranges) or sum(map(len, ranges)) > count:
            accepted = f"must be {numbers} from 0 to {count - 1}, each once, and ranges that go up, as 3,7-9"
            raise invalid(field, value, accepted)
        value = [index for some in ranges for index in some]
    return indices(field, value, count, numbers)


def _require_keys(
    where: str, section: Mapping[str, Any], keys: Collection[str], optional: Collection[str] = ()
) -> None:
    require_known(where, section, [*keys, *optional])
    if missing := [key for key in keys if key not in section]:
        accepted = "must be there, as by `defaults: [base, sensor: scope, _self_]`"
        raise ValueError(f"{where}: no {', '.join(missing)}; {accepted}")


def _sensor(section: Mapping[str, Any], emulated: bool) -> SensorConfig:
    """Return the config of the sensor, checked."""
    kind = section.get("kind")
    require_one_of("hardware.sensor.kind", kind, hardware.SENSORS)
    config = hardware.SENSORS[str(kind)]
    keys = [field.name for field in fields(config)]  # type: ignore[arg-type]  # subclasses are dataclasses
    _require_keys("hardware.sensor", section, ["kind", *keys])
    if not (emulated or config.for_real):
        others = [name for name, other in hardware.SENSORS.items() if other.for_real]
        accepted = f"must be {', '.join(others[:-1])} or {others[-1]} on a real device"
        raise invalid("hardware.sensor", kind, accepted)
    sensor = config(**{key: section[key] for key in keys})
    sensor.check(emulated)
    return sensor


def _require_fit(section: Mapping[str, Any], emulated: bool) -> None:
    """Check that no key is set that has no meaning for the device."""
    device = hardware.DEVICES[section["device"]]
    for key, value in section.items():
        if value in (None, []) or key in set(_KEYS) - {"failed"}:
            continue
        takers = [name for name, other in hardware.DEVICES.items() if key in (*other.keys, *other.port_keys)]
        if key == "failed":
            fits, bench = emulated, "an emulated device"
        elif section["device"] not in takers:
            fits, bench = False, ", ".join(takers[:-1]) + " and " * (len(takers) > 1) + takers[-1]
        else:
            fits, bench = key in device.keys or not emulated, "a real device"
        if not fits:
            raise invalid(f"hardware.{key}", value, f"must be null: it is for {bench}")


def _ask(question: str) -> str:
    """Ask below the progress bar."""
    return typed(f"\n{question}")
