"""Microphones at an oscilloscope: voltages captured, pressures by a lock-in at the drive frequency."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from autdtorch.hardware.sensors import scpi
from autdtorch.hardware.sensors.lock_in import LockIn
from autdtorch.hardware.sensors.scpi import KEYSIGHT, Dialect, Waveform
from autdtorch.hardware.sensors.sensor import SensorError
from autdtorch.hardware.transport.port import LinkError, closed_on_error
from autdtorch.hardware.transport.usb import find_device
from autdtorch.hardware.transport.usbtmc import UsbtmcPort
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import (
    integer_at_least,
    invalid,
    members,
    number_between,
    positive,
    positive_integers,
    require_kind,
)

logger = logging.getLogger(__name__)

#: Sensitivities of microphones with their amplifiers that are taken for true [V/Pa].
SENSITIVITIES = (1e-9, 1e3)
#: Frequencies that an oscilloscope may capture [Hz].
FREQUENCIES = (1.0, 1e9)
_PERIODS_A_DIVISION = 5  # 50 or 60 on a screen, 20 samples each
_CAPTURE_TIME = 2.0  # time limit of a capture [s]
_QUIET = 5  # standard errors
# Vertical scales. A sound twice or half as loud as the last needs no change.
_DIVISIONS = 3.5  # of a full screen, above and below the middle; there are 4 or more
_KEPT = 0.25  # share of the screen below which a waveform gets a finer scale
_TARGET = 0.5  # share that it then fills
_COARSER = 4.0  # a waveform that clips fills at least a quarter of a scale so much coarser


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
        """Check the attributes."""
        integer_at_least("input", self.input, 1)
        positive("sensitivity", self.sensitivity, "V/Pa")
        positive("loudest", self.loudest, "Pa")
        positive("gain", self.gain)
        number_between("sensitivity * gain", self._volts, *SENSITIVITIES, "V/Pa")
        most = _DIVISIONS * scpi.COARSEST
        if self._volts * self.loudest > most:
            accepted = (
                f"must be <= {most / self._volts:.3g}, which gives {most:g} V at the input; lower the gain"
            )
            raise invalid("loudest", self.loudest, accepted, "Pa")

    @property
    def _volts(self) -> float:
        """Voltage at the input for 1 Pa [V/Pa]."""
        return self.sensitivity * self.gain


class Oscilloscope(contextlib.AbstractContextManager["Oscilloscope"]):
    """An oscilloscope that captures on request, without a trigger signal; `identity` answers ``*IDN?``.

    Use it as a context manager. Methods raise `LinkError` if it does not take commands or does not answer.
    """

    def __init__(self, port: UsbtmcPort, dialect: Dialect = KEYSIGHT) -> None:
        """Ask the oscilloscope at a `port` for its identity; `dialect` has the commands of its maker."""
        require_kind("port", port, UsbtmcPort)
        require_kind("dialect", dialect, Dialect)
        self._port, self._dialect = port, dialect
        self._scales: dict[int, float] = {}  # by input, as sent
        self.identity = port.ask("*IDN?")

    def set_up(self, inputs: Collection[int], time_scale: float) -> None:
        """Set up inputs, by their numbers from 1, and their common `time_scale` [s/division]."""
        for command in self._dialect.set_up:
            self._port.tell(command.format(time=time_scale))
        for number in inputs:
            for command in scpi.SET_UP_INPUT:
                self._port.tell(command.format(input=number))

    def capture(self, scales: Mapping[int, float]) -> list[Waveform]:
        """Return a waveform for each input in `scales` [V/division], all of the same time.

        A first error is logged as a warning; the oscilloscope is cleared, and captures once more.
        """
        try:
            return self._capture(scales)
        except LinkError as error:
            logger.warning("%s: %s; it is cleared, and captures once more", self.identity, error)
        self._port.recover()
        self._scales.clear()  # a scale that was under way may be lost
        return self._capture(scales)

    def close(self) -> None:
        """Release the oscilloscope."""
        self._port.close()

    def __exit__(self, *_: object) -> None:
        """Release the oscilloscope."""
        self.close()

    def _capture(self, scales: Mapping[int, float]) -> list[Waveform]:
        for number, scale in scales.items():
            if self._scales.get(number) != scale:
                self._port.tell(scpi.SCALE.format(input=number, scale=scale))
                self._scales[number] = scale
        for command in self._dialect.capture:
            self._port.tell(command)
        deadline = time.monotonic() + _CAPTURE_TIME
        while (status := self._port.ask(self._dialect.status)) != self._dialect.ready:
            if time.monotonic() > deadline:
                raise LinkError(f"{self.identity}: no capture within {_CAPTURE_TIME:g} s, status {status!r}")
            time.sleep(0.01)
        return [self._waveform(number) for number in scales]

    def _waveform(self, number: int) -> Waveform:
        self._port.tell(scpi.SOURCE.format(input=number))
        return self._dialect.waveform(self._port.ask(scpi.PREAMBLE), self._port.ask_block(scpi.SAMPLES))


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
        volts = [one._volts for one in self._microphones]
        self._volts_per_pascal = torch.tensor(volts, **REAL)
        self._coarsest = {
            one.input: max(one.loudest * one._volts / _DIVISIONS, scpi.FINEST) for one in self._microphones
        }
        self._scales = self._coarsest
        self.recaptures = 0
        if not self._scales or len(self._scales) < len(self._microphones):
            inputs = [one.input for one in self._microphones]
            raise invalid("microphones", inputs, "must be at inputs of their own, at least one")
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
        # The power of noise alone has a standard error of its own size, over the root of the captures.
        quiet = power - noise < _QUIET * noise / self._captures**0.5
        for place in quiet.nonzero().flatten().tolist():
            values = self._microphones[place].input, float(pressure[place]), float(noise[place].sqrt())
            logger.warning("input %d: %.3g Pa is within the noise of %.2g Pa", *values)
        return pressure

    def _capture(self) -> torch.Tensor:
        """Return powers (P, 2) [Pa^2] at the frequency, and of the noise in them, on fitting scales."""
        once_clipped: set[int] = set()  # not on a finer scale again in this reading, so that it ends
        while True:
            waveforms = self._scope.capture(self._scales)
            lock_in = self._lock_in(waveforms)
            fit = lock_in(torch.stack([one.volts for one in waveforms]))
            fitted = dict(self._scales)
            for number, waveform, noise in zip(fitted, waveforms, fit.residual.tolist(), strict=True):
                if waveform.clipped:
                    once_clipped.add(number)
                if waveform.clipped or number not in once_clipped:
                    wanted = max(_fitted(self._scales[number], waveform, noise), scpi.FINEST)
                    fitted[number] = min(wanted, self._coarsest[number])
            if fitted == self._scales:
                break
            self._scales = fitted
            self.recaptures += 1
        self._require_unclipped(waveforms)
        # Samples that all have the same code do not show the noise of their rounding.
        steps = torch.tensor([one.resolution for one in waveforms], **REAL)
        variance = fit.residual.square().maximum(steps.square() / 12)
        powers = torch.stack([fit.phasor.abs().square(), lock_in.noise_gain * variance], dim=1)
        return powers / self._volts_per_pascal[:, None].square()

    def _lock_in(self, waveforms: Sequence[Waveform]) -> LockIn:
        """Return the lock-in for waveforms, which must be sampled at the same moments."""
        moments = {(one.time_step, len(one.volts)) for one in waveforms}
        if len(moments) > 1:
            raise SensorError(f"inputs differ in time step and number of samples: {sorted(moments)}")
        try:
            return LockIn(self._frequency, *moments.pop())
        except ValueError as error:
            raise SensorError(f"capture does not suit the frequency: {error}") from error

    def _require_unclipped(self, waveforms: Sequence[Waveform]) -> None:
        for microphone, waveform in zip(self._microphones, waveforms, strict=True):
            if waveform.clipped:
                clipped = f"{waveform.clipped} of {len(waveform.volts)} samples are clipped"
                loudest = f"by more than {microphone.loudest:g} Pa: raise `loudest`"
                raise SensorError(f"input {microphone.input}: {clipped}, {loudest}")


def _fitted(scale: float, waveform: Waveform, noise: float) -> float:
    """Return the scale for the next waveform, from one on a `scale` [V/division] with noise of an rms [V].

    The scale is not made finer if the noise exceeds a step of the converter: rounding then adds at most 1/12
    to its variance, and no bias.
    """
    if waveform.clipped:
        return scale * _COARSER
    peak = float(waveform.volts.abs().max()) + waveform.resolution
    if peak < _KEPT * _DIVISIONS * scale and noise < waveform.resolution:
        return peak / (_TARGET * _DIVISIONS)
    return scale


def open_scope(
    chip: tuple[int, int], dialect: Dialect = KEYSIGHT, serial: str | None = None, backend: Any = None
) -> Oscilloscope:
    """Find an oscilloscope on USB.

    Args:
        chip: idVendor and idProduct, as ``lsusb`` shows them.
        dialect: commands of its maker.
        serial: serial number, where several such are plugged in.
        backend: backend of pyusb; by default libusb. An emulated bench has its own.

    Raises:
        ValueError: `chip` is not two numbers.
        LinkError: none or several such devices, or it does not answer.
    """
    vendor, product = positive_integers("chip", chip, 2)
    port = UsbtmcPort(find_device([(vendor, product)], serial, backend))
    with closed_on_error(port.close):
        return Oscilloscope(port, dialect)
