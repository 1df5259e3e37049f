"""Microphones at an oscilloscope: pressures by a lock-in at the drive frequency; their config."""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from autdtorch.hardware.sensors.by_hand import MovedMicrophone
from autdtorch.hardware.sensors.scpi_scope import (
    COARSEST,
    FINEST,
    FREQUENCIES,
    KEYSIGHT,
    RIGOL,
    SENSITIVITIES,
    Oscilloscope,
    Waveform,
    open_scope,
)
from autdtorch.hardware.sensors.sensor import Sensor, SensorConfig, SensorError, Setup
from autdtorch.objectives.perturbations import random_rms
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import (
    boolean,
    integer_at_least,
    invalid,
    members,
    number_between,
    positive,
    require_kind,
    require_one_of,
)

logger = logging.getLogger(__name__)

_PERIODS_A_DIVISION = 5  # 50 or 60 on a screen, 20 samples each
_QUIET = 5  # standard errors
# Vertical scales. A sound twice or half as loud as the last needs no change.
_DIVISIONS = 3.5  # of a full screen, above and below the middle; there are 4 or more
_SMALL = 0.25  # share of the screen below which a waveform gets a finer scale
_TARGET = 0.5  # share that it then fills
_COARSER = 4.0  # a waveform that clips fills at least a quarter of a scale so much coarser

_MAKERS = {"keysight": KEYSIGHT, "rigol": RIGOL}
_EMULATED_CHIP = "2a8d:1770"


class SineFit(NamedTuple):
    """A sine fitted to a signal: p (...,) of Re(p e^{-i w t}), t = 0 at the first sample; rms of the rest."""

    phasor: torch.Tensor
    residual: torch.Tensor


class LockIn:
    """A fit of an offset and a sine of known frequency: least squares, weighted by a Hann window.

    Offset and sine are exact for any number of periods. The window suppresses hum, slow drift and
    harmonics, which disturb a plain fit where that number is not whole. White noise causes an error sqrt(3/2)
    times the lowest bound of unbiased estimates (Rife and Boorstyn 1974, doi:10.1109/TIT.1974.1055282).

    White noise of variance s^2 in every sample puts an error of E|e|^2 = `noise_gain` s^2 on the phasor: 6
    over the number of samples, if they hold many periods.
    """

    def __init__(self, frequency: float, step: float, samples: int) -> None:
        """Prepare the fit of a sine of a `frequency` [Hz] to S `samples`, a time `step` [s] apart.

        `ValueError` for less than two periods, or two samples a period or fewer.
        """
        cycles = frequency * step
        if cycles >= 0.5:
            raise invalid("step", step, f"must be < {0.5 / frequency:g}, half a period", "s")
        if cycles * samples < 2:
            raise invalid("samples", samples, f"must be >= {math.ceil(2 / cycles)}, two periods")
        places = torch.arange(samples, **REAL)
        angle = 2 * math.pi * cycles * places
        window = (math.pi * (places + 0.5) / samples).sin().square()
        self._basis = torch.stack([torch.ones_like(angle), angle.cos(), angle.sin()])
        weighted = self._basis * window
        self._fit = torch.linalg.solve(weighted @ self._basis.T, weighted)
        self.noise_gain = float(self._fit[1:].square().sum())

    def __call__(self, signal: torch.Tensor) -> SineFit:
        """Return the fits to signals (..., S)."""
        coefficients = signal.to(torch.float64) @ self._fit.T
        rest = signal - coefficients @ self._basis
        residual = (rest.square().sum(dim=-1) / (rest.shape[-1] - len(self._basis))).sqrt()
        return SineFit(torch.complex(coefficients[..., 1], coefficients[..., 2]), residual)


@dataclass(frozen=True)
class Microphone:
    """A microphone at a control point, and its path into the oscilloscope.

    Attributes:
        input: number of the oscilloscope's input, from 1.
        sensitivity: of the microphone at the drive frequency [V/Pa]; with the amplifier 1e-9 to 1e3.
        loudest: largest amplitude that the input must take [Pa]; up to 17.5 V.
        gain: of the amplifier between, as a factor.

    `ValueError` for an attribute out of range.
    """

    input: int
    sensitivity: float
    loudest: float
    gain: float = 1.0

    def __post_init__(self) -> None:
        integer_at_least("input", self.input, 1)
        positive("sensitivity", self.sensitivity, "V/Pa")
        positive("loudest", self.loudest, "Pa")
        positive("gain", self.gain)
        number_between("sensitivity * gain", self._volts, *SENSITIVITIES, "V/Pa")
        most = _DIVISIONS * COARSEST
        if self._volts * self.loudest > most:
            accepted = (
                f"must be <= {most / self._volts:.3g}, which gives {most:g} V at the input; lower the gain"
            )
            raise invalid("loudest", self.loudest, accepted, "Pa")

    @property
    def _volts(self) -> float:
        return self.sensitivity * self.gain


class ScopeSensor:
    """Microphones at an oscilloscope, one for each control point.

    A lock-in takes the amplitude at the drive frequency from captures, without hum, other tones and most of
    the noise. Captures are averaged as powers, less the power of the noise there, since their phases are
    unknown.

    Each input keeps the vertical scale of its last capture. A waveform that is clipped on it, or too small,
    is captured again on another scale, up to the scale of the loudest sound; `recaptures` counts these.
    """

    def __init__(
        self, scope: Oscilloscope, frequency: float, microphones: Sequence[Microphone], captures: int = 1
    ) -> None:
        """Set the oscilloscope up.

        Args:
            scope: takes the captures.
            frequency: of the drive [Hz].
            microphones: in the order of the control points.
            captures: number of captures that a reading averages.

        Raises:
            ValueError: an argument out of range, no microphone, or two at one input.
            LinkError: the oscilloscope does not take the commands.
        """
        require_kind("scope", scope, Oscilloscope)
        self._scope = scope
        self._frequency = number_between("frequency", frequency, *FREQUENCIES, "Hz")
        self._microphones = members("microphones", microphones, Microphone)
        self._captures = integer_at_least("captures", captures, 1)
        # Captures are alike, and a fit takes longer to prepare than to apply.
        self._prepared = functools.lru_cache(maxsize=1)(functools.partial(LockIn, self._frequency))
        volts = [microphone._volts for microphone in self._microphones]
        self._volts_per_pascal = torch.tensor(volts, **REAL)
        self._coarsest = {
            microphone.input: max(microphone.loudest * microphone._volts / _DIVISIONS, FINEST)
            for microphone in self._microphones
        }
        self._scales = self._coarsest
        self.recaptures = 0
        if not self._scales or len(self._scales) < len(self._microphones):
            inputs = [microphone.input for microphone in self._microphones]
            raise invalid("microphones", inputs, "must be at different inputs, at least one")
        scope.set_up(self._scales.keys(), _PERIODS_A_DIVISION / self._frequency)

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,) [Pa]; one within the noise is logged as a warning.

        Raises:
            SensorError: a capture is clipped on the coarsest scale, or too coarse or short for the frequency.
            LinkError: the oscilloscope does not answer.
        """
        captures = torch.stack([self._capture() for _ in range(self._captures)])
        power, noise = captures.mean(dim=0).unbind(dim=-1)
        pressure = (power - noise).clamp(min=0).sqrt()
        # The standard error of the power of noise alone is that power, over the root of the captures.
        quiet = power - noise < _QUIET * noise / self._captures**0.5
        for place in quiet.nonzero().flatten().tolist():
            values = self._microphones[place].input, float(pressure[place]), float(noise[place].sqrt())
            logger.warning("input %d: %.3g Pa is within the noise of %.2g Pa", *values)
        return pressure

    def _capture(self) -> torch.Tensor:
        """Return powers (P, 2) [Pa^2] at the frequency, and of the noise in them, on fitting scales."""
        once_clipped: set[int] = set()  # inputs that get no finer scale in this reading, so that it ends
        while True:
            waveforms = self._scope.capture(self._scales)
            lock_in = self._lock_in(waveforms)
            fit = lock_in(torch.stack([waveform.volts for waveform in waveforms]))
            fitted = dict(self._scales)
            for number, waveform, noise in zip(fitted, waveforms, fit.residual.tolist(), strict=True):
                if waveform.clipped:
                    once_clipped.add(number)
                if waveform.clipped or number not in once_clipped:
                    wanted = max(_fitted(self._scales[number], waveform, noise), FINEST)
                    fitted[number] = min(wanted, self._coarsest[number])
            if fitted == self._scales:
                break
            self._scales = fitted
            self.recaptures += 1
        for microphone, waveform in zip(self._microphones, waveforms, strict=True):
            if waveform.clipped:
                clipped = f"{waveform.clipped} of {len(waveform.volts)} samples are clipped"
                loudest = f"by more than {microphone.loudest:g} Pa: raise `loudest`"
                raise SensorError(f"input {microphone.input}: {clipped}, {loudest}")
        # Samples that all have the same code do not show the noise of their rounding.
        steps = torch.tensor([waveform.resolution for waveform in waveforms], **REAL)
        variance = fit.residual.square().maximum(steps.square() / 12)
        powers = torch.stack([fit.phasor.abs().square(), lock_in.noise_gain * variance], dim=1)
        return powers / self._volts_per_pascal[:, None].square()

    def _lock_in(self, waveforms: Sequence[Waveform]) -> LockIn:
        """Return the lock-in for waveforms, which must be sampled at the same moments."""
        moments = {(waveform.time_step, len(waveform.volts)) for waveform in waveforms}
        if len(moments) > 1:
            raise SensorError(f"inputs differ in time step and number of samples: {sorted(moments)}")
        try:
            return self._prepared(*moments.pop())
        except ValueError as error:
            raise SensorError(f"capture does not suit the frequency: {error}") from error


def _fitted(scale: float, waveform: Waveform, noise: float) -> float:
    """Return the scale for the next waveform, from one on a `scale` [V/division] with noise of an rms [V].

    The scale is not made finer if the noise exceeds a step of the converter: rounding then adds at most 1/12
    to its variance, and no bias.
    """
    if waveform.clipped:
        return scale * _COARSER
    peak = float(waveform.volts.abs().max()) + waveform.resolution
    if peak < _SMALL * _DIVISIONS * scale and noise < waveform.resolution:
        return peak / (_TARGET * _DIVISIONS)
    return scale


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
