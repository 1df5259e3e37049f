"""The check before a trial: the reading of each transducer, or of one drive, against silence."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from autdtorch.hardware.safety import LimitedLink, readings_count
from autdtorch.hardware.sensors.sensor import (
    AnySensor,
    Pulse,
    PulsedSensor,
    Sensor,
    SensorError,
    checked_reading,
    quantity_of,
    require_sensor,
)
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.validation import integer_at_least, require_callable, require_kind

_DEVIATIONS = 6.0  # threshold above the noise, in standard deviations of its mean power
_WEAK = 0.1  # threshold below the median of all transducers: 20 dB, as some sensors round silence to 0


@dataclass(frozen=True, eq=False)
class Preflight:
    """The pressure of each transducer alone, and of silence, or what else a sensor reads.

    Attributes:
        pressure: of each transducer (M,) [Pa], or in `unit`, rms over readings and control points; (0,) where
            a sensor does not see a transducer alone.
        silence: reading with the outputs off [Pa], or in `unit`.
        threshold: reading that a working transducer exceeds [Pa], or in `unit`.
        unit: of the readings.
    """

    pressure: torch.Tensor
    silence: float
    threshold: float
    unit: str = "Pa"

    @property
    def failed(self) -> list[int]:
        """The failed transducers, whose pressure is not above the threshold."""
        return torch.nonzero(self.pressure <= self.threshold)[:, 0].tolist()

    @property
    def dead(self) -> list[int]:
        """The former name of `failed`."""
        warnings.warn("Preflight.dead is now Preflight.failed", DeprecationWarning, stacklevel=2)
        return self.failed


def check_transducers(
    link: LimitedLink,
    sensor: Sensor,
    points: int,
    readings: int = 4,
    background: int = 32,
    watch: Callable[[str], object] | None = None,
) -> Preflight:
    """Play every transducer alone, after silence, and switch the outputs off, however it ends.

    The power of circular Gaussian noise, averaged over n readings, deviates by 1/sqrt(n) of its mean. The
    threshold is six deviations above that mean, or 20 dB below the median of all transducers if that is more.

    Args:
        link: plays the transducers.
        sensor: reads their pressure.
        points: number of control points P.
        readings: number of readings of every transducer, 1 to 10,000.
        background: number of readings of the silence, 1 to 10,000.
        watch: takes the name of each reading: "silence, outputs off", then "transducer 1 of 16" and so on.

    Raises:
        ValueError: the link is not limited, there is no sensor or it does not give P finite magnitudes, or
            another number of readings.
        LimitError: the time limit of the outputs is reached.
        LinkError: the device does not take the bytes.
    """
    require_kind("link", link, LimitedLink)
    require_kind("sensor", sensor, Sensor)
    watch = (lambda _: None) if watch is None else watch
    require_callable("watch", watch)
    points = integer_at_least("points", points, 1)
    readings = readings_count("readings", readings)
    background = readings_count("background", background)
    watch("silence, outputs off")
    silence = _power(partial(checked_reading, sensor, points), background)
    count = len(link.link.transducers)
    powers = []
    try:
        for number, alone in enumerate(torch.eye(count, **COMPLEX), start=1):
            watch(f"transducer {number} of {count}")
            link.play(alone)
            powers.append(_power(partial(link.reading, sensor, points), readings))
    finally:
        link.off()
    pressure = torch.tensor(powers, **REAL).sqrt()
    threshold = max(_above_noise(silence, readings * points), _WEAK * float(pressure.median()))
    return Preflight(pressure, math.sqrt(silence), threshold, quantity_of(sensor).unit)


def check_picture(
    link: LimitedLink, sensor: AnySensor, points: int, drive: torch.Tensor, readings: int = 4
) -> Preflight:
    """Read silence and one drive (M,), as a camera or a balance does not see a transducer alone.

    The threshold is as of `check_transducers`, with the drive's loudest control point for all transducers.
    `SensorError` if the drive is not above it anywhere; other errors are those of `check_transducers`.
    """
    require_kind("link", link, LimitedLink)
    require_sensor(sensor)
    points = integer_at_least("points", points, 1)
    readings = readings_count("readings", readings)
    silence = _power(_silent(sensor, points), readings)
    threshold = _above_noise(silence, readings * points)
    if (deviation := getattr(sensor, "deviation", None)) is not None:  # its silence may be 0 by chance
        of_silence = float(deviation(torch.zeros(points, **REAL)).max())
        threshold = max(threshold, math.sqrt(_DEVIATIONS) * of_silence)
    largest, unit = float(link.measure(drive, sensor, points).max()), quantity_of(sensor).unit
    if largest <= threshold:
        accepted = f"must be above the noise, {threshold:.3g} {unit}; check the power, and the sensor"
        raise SensorError(f"the largest reading of a drive is {largest:.3g} {unit}; {accepted}")
    return Preflight(torch.empty(0, **REAL), math.sqrt(silence), max(threshold, _WEAK * largest), unit)


def hears_silence(sensor: AnySensor, check: Preflight, points: int, readings: int = 4) -> bool:
    """Return True if a sensor of P points reads no more than at the `check` before, with the outputs off.

    `ValueError` if the sensor does not give P finite magnitudes, or for another number of readings.
    """
    require_sensor(sensor)
    require_kind("check", check, Preflight)
    points = integer_at_least("points", points, 1)
    readings = readings_count("readings", readings)
    return math.sqrt(_power(_silent(sensor, points), readings)) <= check.threshold


def _above_noise(power: float, numbers: int) -> float:
    """Return the reading above noise of a mean square over so many numbers."""
    return math.sqrt(power * (1 + _DEVIATIONS / math.sqrt(numbers)))


def _silent(sensor: AnySensor, points: int) -> Callable[[], torch.Tensor]:
    """Return a function that reads (P,) and leaves the outputs off."""
    silent = Pulse(sensor, lambda: None, lambda: None) if isinstance(sensor, PulsedSensor) else sensor
    return partial(checked_reading, silent, points)


def _power(read: Callable[[], torch.Tensor], readings: int) -> float:
    return float(torch.stack([read() for _ in range(readings)]).square().mean())
