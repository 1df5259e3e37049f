"""The sensor of a bench: pressure magnitudes at the control points, its config, and an emulated one."""

from __future__ import annotations

import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeAlias, runtime_checkable

import numpy as np
import torch

from autdtorch.objectives.objective import validate_magnitudes
from autdtorch.objectives.perturbations import SNRS, random_rms
from autdtorch.scene.scene import Scene
from autdtorch.utils.files import require_name
from autdtorch.utils.process import send
from autdtorch.utils.validation import (
    finite_number,
    integer_at_least,
    invalid,
    number_between,
    real_tensor,
    require_kind,
    within,
)

if TYPE_CHECKING:
    from autdtorch.hardware.emulator.bench import EmulatedBench

#: Time limit of a reading while the outputs are off [s]: a person may take minutes, a hung sensor forever.
LONGEST = 600.0
# The signal that wakes a reading: by default ignored, so that a late one does no harm. Windows has no such.
_WAKE: signal.Signals = getattr(signal, "SIGURG", signal.SIGINT)
_AGAIN = 0.5  # [s] between two signals


class SensorError(OSError):
    """A sensor gives no trustworthy reading."""


class _Overdue(BaseException):
    """A reading takes too long; not an `Exception`, which a sensor may handle and then wait on."""


@dataclass(frozen=True)
class Quantity:
    """A quantity that a sensor reads.

    A sensor of another quantity than the pressure has an attribute `quantity`. Methods then maximise its
    least reading, and nothing compares readings with simulated pressures. Readings below 0, as a balance has
    of noise once it is tared, count as 0.

    Attributes:
        name: such as "force".
        unit: of the readings, such as "mN"; "Pa" for "pressure".
    """

    name: str
    unit: str

    def __post_init__(self) -> None:
        require_name("name", self.name)
        if self.name == "pressure" and self.unit != "Pa":
            raise invalid("unit", self.unit, "must be Pa for the quantity pressure")
        for part in self.unit.split("/") if isinstance(self.unit, str) else [self.unit]:  # as of mm/s
            require_name("unit", part)


PRESSURE = Quantity("pressure", "Pa")
"""PRESSURE: the quantity of a sensor that states none."""


def magnitudes_of(quantity: Quantity, name: str, value: object, points: int) -> torch.Tensor:
    """Return readings (P,) of `points` control points as float64, after checking them."""
    if quantity != PRESSURE:
        value = real_tensor(name, value, quantity.unit).clamp(min=0)
    return validate_magnitudes(name, value, points, quantity.unit)


@runtime_checkable
class Sensor(Protocol):
    """A sensor that reads the pressure, or another `Quantity`, at the control points of a drive."""

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,) [Pa] at the control points, once the field is steady."""


@runtime_checkable
class PulsedSensor(Protocol):
    """A sensor that switches the sound on and off itself, as a camera of what the sound heats."""

    def read_pulse(self, on: Callable[[], None], off: Callable[[], None]) -> torch.Tensor:
        """Return magnitudes (P,) [Pa] at the control points.

        The outputs are off before. `on` plays the drive and returns once the sound is steady; `off` ends it.
        """


AnySensor: TypeAlias = Sensor | PulsedSensor


def require_sensor(sensor: object) -> None:
    """Check that `sensor` reads a steady sound, or pulses."""
    if not isinstance(sensor, PulsedSensor):
        require_kind("sensor", sensor, Sensor)


def quantity_of(sensor: AnySensor) -> Quantity:
    """Return the quantity that a sensor reads."""
    quantity: Quantity = getattr(sensor, "quantity", PRESSURE)
    require_kind("sensor.quantity", quantity, Quantity)
    return quantity


@dataclass(frozen=True)
class Pulse:
    """A pulse of sound that a sensor reads."""

    sensor: PulsedSensor
    on: Callable[[], None]
    off: Callable[[], None]

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,) [Pa]."""
        return self.sensor.read_pulse(self.on, self.off)


def checked_reading(sensor: Sensor, points: int, seconds: float = LONGEST) -> torch.Tensor:
    """Return the reading (P,), float64, of a sensor, in its unit.

    In the main thread, a reading is interrupted after a number of seconds, wherever Python can interrupt it:
    where it sleeps, or waits for a file or a socket, but not in a driver that never returns.

    Raises:
        ValueError: the reading is not P finite magnitudes.
        SensorError: the time is over.
    """
    quantity = quantity_of(sensor)
    return magnitudes_of(quantity, f"{quantity.name} of the sensor", _reading(sensor, seconds), points)


def _reading(sensor: Sensor, seconds: float) -> object:
    if threading.current_thread() is not threading.main_thread():  # which alone receives signals
        return sensor.read()
    done, is_late = threading.Event(), threading.Event()
    before = signal.getsignal(_WAKE) or signal.SIG_DFL  # None where a library has set it

    def interrupt(number: int, frame: FrameType | None) -> None:
        if is_late.is_set():
            raise _Overdue
        if callable(before):
            before(number, frame)

    try:
        try:
            signal.signal(_WAKE, interrupt)
            threading.Thread(target=_wake, args=(seconds, done, is_late), daemon=True).start()
            reading = sensor.read()
        finally:
            done.set()
            signal.signal(_WAKE, before)
    except _Overdue:
        signal.signal(_WAKE, before)  # it may have come amid the lines above
        if not is_late.is_set():  # another reading, around this one, is overdue
            raise
    if is_late.is_set():
        raise SensorError(f"the sensor gives no reading within {seconds:.3g} s")
    return reading


def _wake(seconds: float, done: threading.Event, is_late: threading.Event) -> None:
    """Interrupt the main thread after some time, repeatedly, as Python drops what a `__del__` raises."""
    if done.wait(seconds):
        return
    is_late.set()
    while not done.is_set():
        send(_WAKE)
        done.wait(_AGAIN)


@dataclass(frozen=True, eq=False)
class Setup:
    """The bench that a configured sensor is opened on.

    Attributes:
        scene: the scene on the bench.
        ask: shows a person a question, and returns the answer.
        bench: the emulated bench; None for a real one.
        seed: of emulated noise.
        matrix_of: returns the transfer matrix (N, M) [Pa] of points (N, 3) [m] on an emulated bench.
    """

    scene: Scene
    ask: Callable[[str], str]
    bench: EmulatedBench | None
    seed: int
    matrix_of: Callable[[torch.Tensor], torch.Tensor]

    @property
    def control_points(self) -> torch.Tensor:
        """The control points (P, 3) [m]."""
        return self.scene.control_points

    @property
    def frequency(self) -> float:
        """The frequency of the drive [Hz]."""
        return self.scene.frequency


class SensorConfig(ABC):
    """The section `hardware.sensor` of a config for a kind of sensor.

    The keys are `kind`, by which `SENSORS` finds the class, and the fields of a subclass, which is a
    dataclass. A field `snr` [dB] is for emulated benches alone.

    `for_real` is true if a real bench can have the sensor.
    """

    for_real: ClassVar[bool] = True

    @property
    def by_hand(self) -> bool:
        """True if a person takes part in every reading."""
        return False

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that identify a trial, values of JSON."""
        return {}

    def check(self, emulated: bool) -> None:
        """Check the values, for an `emulated` or a real bench; `ValueError` for a value out of range."""
        if (snr := getattr(self, "snr", None)) is None:
            return
        if not emulated:
            raise invalid("hardware.sensor.snr", snr, "must be null: it is for an emulated device")
        finite_number("hardware.sensor.snr", snr)

    @abstractmethod
    def open(self, setup: Setup) -> AbstractContextManager[AnySensor]:
        """Return a context with the sensor."""


@dataclass(frozen=True)
class InstrumentConfig(SensorConfig):
    """Base of the configs of instruments that may read another quantity than the pressure.

    Attributes:
        quantity: of the readings, such as "pressure" or "force".
        unit: of the readings.
    """

    quantity: str
    unit: str

    def check(self, emulated: bool) -> None:
        """Check the quantity and its unit."""
        with within("hardware.sensor.quantity"):
            self.read_quantity()

    def read_quantity(self) -> Quantity:
        """Return the quantity of the readings."""
        return Quantity(self.quantity, self.unit)


class EmulatedSensor:
    """A microphone at each control point of an emulated bench, with the noise of `perturbations.Noise`."""

    def __init__(self, bench: EmulatedBench, snr: float | None = None, seed: int = 0) -> None:
        """Set the microphones up.

        Args:
            bench: the bench to measure on.
            snr: 20 log10(reference / sigma) [dB], -1000 to 1000, where the reference is the rms pressure over
                control points and random phases, all transducers fully on; None for no noise.
            seed: of the noise, >= 0.

        `ValueError` for an argument out of range.
        """
        from autdtorch.hardware.emulator.bench import EmulatedBench  # needs pyusb

        require_kind("bench", bench, EmulatedBench)
        self._bench = bench
        self._generator = np.random.default_rng(integer_at_least("seed", seed, 0))
        rms = random_rms(bench.transfer_matrix)
        self._sigma = 0.0 if snr is None else rms * 10 ** (-number_between("snr", snr, *SNRS, "dB") / 20)

    def read(self) -> torch.Tensor:
        """Return the magnitudes (P,) [Pa]."""
        pressure = self._bench.pressure()
        parts = torch.from_numpy(self._generator.standard_normal((len(pressure), 2)))
        return (pressure + torch.view_as_complex(self._sigma / 2**0.5 * parts)).abs()


@dataclass(frozen=True)
class EmulatedConfig(SensorConfig):
    """The config of an `EmulatedSensor`."""

    for_real = False

    snr: float | None

    def open(self, setup: Setup) -> AbstractContextManager[Sensor]:
        """Return a context with the sensor on the emulated bench."""
        assert setup.bench is not None
        return nullcontext(EmulatedSensor(setup.bench, self.snr, setup.seed))
