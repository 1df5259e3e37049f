"""The config of microphones at an oscilloscope, and the oscilloscope that it opens."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from autdtorch.hardware.sensors.by_hand import MovedMicrophone
from autdtorch.hardware.sensors.scope_microphones import Microphone, ScopeSensor
from autdtorch.hardware.sensors.scpi_scope import KEYSIGHT, RIGOL, Oscilloscope, open_scope
from autdtorch.hardware.sensors.sensor import Sensor, SensorConfig, Setup
from autdtorch.objectives.perturbations import random_rms
from autdtorch.utils.validation import boolean, invalid, require_one_of

_MAKERS = {"keysight": KEYSIGHT, "rigol": RIGOL}
_EMULATED_CHIP = "2a8d:1770"


@dataclass(frozen=True)
class ScopeConfig(SensorConfig):
    """The config of a `ScopeSensor`; configs/hardware/sensor/scope.yaml describes the keys."""

    chip: Any
    maker: Any
    sensitivity: float
    loudest: float
    captures: int
    moved: bool
    snr: float | None

    @property
    def by_hand(self) -> bool:
        """True if a person moves the microphone."""
        return self.moved

    @property
    def settings(self) -> dict[str, Any]:
        """Sensitivity and number of captures."""
        return {"sensitivity [V/Pa]": self.sensitivity, "captures": self.captures}

    def check(self, emulated: bool) -> None:
        """Check the values for a real or an `emulated` bench."""
        super().check(emulated)
        require_one_of("hardware.sensor.maker", self.maker, _MAKERS)
        if boolean("hardware.sensor.moved", self.moved) and emulated:
            raise invalid("hardware.sensor.moved", True, "must be false: it is for a real device")
        if self.chip is None and not emulated:
            accepted = "the oscilloscope's VID:PID, as lsusb shows it; or hardware/sensor=file or manual"
            raise invalid("hardware.sensor.chip", None, f"must be {accepted}")

    @contextlib.contextmanager
    def open(self, setup: Setup) -> Iterator[Sensor]:
        """Open the oscilloscope, on an emulated bench an emulated one, and set it up."""
        points = setup.control_points
        inputs = range(1, 2 if self.moved else len(points) + 1)
        microphones = [Microphone(number, self.sensitivity, self.loudest) for number in inputs]
        with self._scope(setup) as scope:
            sensor = ScopeSensor(scope, setup.frequency, microphones, self.captures)
            yield MovedMicrophone(sensor, points, setup.ask) if self.moved else sensor

    def _scope(self, setup: Setup) -> Oscilloscope:
        dialect, chip = _MAKERS[self.maker], _chip(self.chip or _EMULATED_CHIP)
        bench = setup.bench
        if bench is None:
            return open_scope(chip, dialect)
        from autdtorch.hardware.emulator.emulated_scope import EmulatedScope  # needs pyusb

        noise = 0.0
        if self.snr is not None:
            noise = self.sensitivity * random_rms(bench.transfer_matrix) * 10 ** (-self.snr / 20)
        emulated = EmulatedScope(
            bench.pressure,
            setup.frequency,
            self.sensitivity,
            range(len(setup.control_points)),
            dialect.name.partition(" ")[0],
            noise=noise,
            seed=setup.seed,
        )
        emulated.plug_into(bench, chip)
        return open_scope(chip, dialect, backend=bench.bus)


def _chip(text: object) -> tuple[int, int]:
    """Return idVendor and idProduct of text such as "2a8d:1770", as lsusb shows them."""
    match = re.fullmatch(r"(?:0x)?([0-9a-f]{1,4}):(?:0x)?([0-9a-f]{1,4})", str(text), re.IGNORECASE)
    if match is None:
        raise invalid("hardware.sensor.chip", text, "must be VID:PID with four digits each, as 2a8d:1770")
    return int(match[1], 16), int(match[2], 16)
