"""Sequences: drives that follow each other at a rate, and amplitude modulation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal, TypeAlias

import torch

from autdtorch.scene.drive import drive_tensor, validate_drive
from autdtorch.utils.array_types import REAL
from autdtorch.utils.text import counted
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    invalid,
    not_negative,
    number_between,
    positive,
    real_tensor,
    require_kind,
    require_one_of,
)

WaveformName: TypeAlias = Literal["sine", "square"]

LONGEST = 100_000
"""Most frames of `modulated` and `at_rate`, and most points of a path of a config."""

_SAMPLES = 20  # of a period of "sine" or "square" at least, where the rate is not stated
_PARTS = 10  # of a frame, by `silenced`
_ROUNDING = 1e-9  # relative difference of rates that are taken as equal


@dataclass(frozen=True, eq=False, repr=False)
class Sequence:
    """Drives that follow each other at a constant rate.

    A frame plays until the next one begins. `len(sequence)` is the number of frames T.

    Attributes:
        drives: q = a e^{-i phi} of the frames (T, M), |q| <= 1; T, M >= 1.
        rate: frames per second [Hz], > 0.
        loop: whether the first frame follows the last one.

    Raises:
        ValueError: not finite complex numbers, another shape, |q| > 1, or a rate <= 0.
    """

    drives: torch.Tensor
    rate: float
    loop: bool = True

    def __post_init__(self) -> None:
        drives = drive_tensor(self.drives, "drives")
        if drives.ndim != 2 or drives.numel() == 0:
            accepted = "must be (T, M), T >= 1 frames of M >= 1 transducers"
            raise ValueError(f"drives: shape {tuple(drives.shape)}; {accepted}")
        drives = validate_drive(drives, drives.shape[1], "drives")
        object.__setattr__(self, "drives", drives.detach().cpu().clone())
        object.__setattr__(self, "rate", positive("rate", self.rate, "Hz"))
        object.__setattr__(self, "loop", boolean("loop", self.loop))

    @property
    def transducers(self) -> int:
        """Number M of transducers."""
        return self.drives.shape[1]

    @property
    def duration(self) -> float:
        """Time of all frames, of one lap if they loop [s]."""
        return len(self) / self.rate

    @property
    def times(self) -> torch.Tensor:
        """Times (T,) at which the frames begin [s]."""
        return torch.arange(len(self), **REAL) / self.rate

    def at_rate(self, rate: float) -> Sequence:
        """Return the sequence at another rate: each new frame is the one that plays at its time.

        A higher rate repeats frames, a lower one leaves some out. The number of frames becomes the whole
        number nearest to `duration` times `rate`, at least 1, and the old ones are spread evenly over it. So
        the duration changes by up to half a new frame.

        Args:
            rate: frames per second [Hz], > 0.

        Raises:
            ValueError: a rate <= 0, or more than 100,000 new frames.
        """
        rate = positive("rate", rate, "Hz")
        frames = max(1.0, round(len(self) * (rate / self.rate), 0))
        if frames > max(LONGEST, len(self)):
            most = f"must be at most {LONGEST / self.duration:g} Hz, for {LONGEST} frames"
            raise invalid("rate", rate, most, "Hz")
        playing = torch.arange(int(frames), device="cpu") * len(self) // int(frames)
        return Sequence(self.drives[playing], rate, self.loop)

    def __len__(self) -> int:
        return len(self.drives)

    def __repr__(self) -> str:
        frames = f"{counted(len(self), 'frame')} of {counted(self.transducers, 'transducer')}"
        return f"Sequence({frames}, {self.rate:g} Hz, {self.duration:g} s{', loop' if self.loop else ''})"


def modulated(
    drive: ArrayLike | Sequence,
    frequency: float,
    depth: float = 1.0,
    waveform: WaveformName | ArrayLike = "sine",
    rate: float | None = None,
) -> Sequence:
    """Return a drive, or a sequence, with its radiation pressure modulated in amplitude.

    The radiation pressure goes with the square of the amplitude. It is multiplied by 1 - depth (1 - w), with
    the waveform w in [0, 1], and amplitudes by the root of it. So a sine gives a radiation pressure of one
    frequency; a sine of the amplitudes would add twice the frequency.

    A drive becomes one period, or the fewest periods that are whole frames. A sequence that loops becomes the
    fewest laps that are whole periods; any other keeps its duration.

    Args:
        drive: complex (M,), |q| <= 1, or a sequence.
        frequency: of the modulation [Hz], > 0.
        depth: 0 to 1; with 1, the waveform 0 is silence.
        waveform: w of a period: "sine", (1 + sin)/2; "square", 1 and then 0; or samples (N,) in [0, 1], each
            for a time of 1/N of the period.
        rate: frames per second [Hz], for a sequence a multiple of its rate, and at least twice `frequency`.
            By default the least with 20 frames a period, or one for each sample.

    Raises:
        ValueError: an argument out of range, or more than 100,000 frames.
    """
    frequency = positive("frequency", frequency, "Hz")
    depth = number_between("depth", depth, 0, 1)
    samples = _samples(waveform)
    per_period = _SAMPLES if samples is None else len(samples)
    if isinstance(drive, Sequence):
        sequence = _repeated(drive, per_period * frequency, rate)
    else:
        single = drive_tensor(drive)
        if single.ndim != 1:
            raise ValueError(f"drive: shape {tuple(single.shape)}; must be (M,), or a Sequence")
        sequence = Sequence(single[None], per_period * frequency if rate is None else rate)
    if sequence.rate < 2 * frequency * (1 - _ROUNDING):
        raise invalid("rate", sequence.rate, f"must be at least {2 * frequency:g}, two frames a period", "Hz")
    ratio = Fraction(frequency / sequence.rate).limit_denominator(LONGEST)
    if abs(float(ratio) * sequence.rate - frequency) > _ROUNDING * frequency:
        accepted = f"must have whole periods within {LONGEST} frames of {sequence.rate:g} Hz"
        raise invalid("frequency", frequency, accepted, "Hz")
    frames = math.lcm(len(sequence), ratio.denominator) if sequence.loop else len(sequence)
    if frames > max(LONGEST, len(sequence)):
        lap = f"whole laps of {sequence.duration:g} s"
        raise invalid(
            "frequency", frequency, f"must have whole periods in {lap} within {LONGEST} frames", "Hz"
        )
    number = torch.arange(frames, device="cpu")
    turn = (number * ratio.numerator % ratio.denominator).double() / ratio.denominator
    wave = _wave(waveform, turn) if samples is None else samples[(turn * len(samples) + _ROUNDING).long()]
    amplitude = (1 - depth * (1 - wave)).clamp_min(0).sqrt()
    return Sequence(
        sequence.drives[number % len(sequence)] * amplitude[:, None], sequence.rate, sequence.loop
    )


def silenced(sequence: Sequence, phase_time: float = 1e-3, amplitude_time: float = 0.25e-3) -> Sequence:
    """Return a sequence as a device plays it that changes phases and amplitudes evenly over some time.

    AUTD3 does so by default, by its silencer of fixed completion time. A phase turns the shorter way, from
    the moment at which its frame begins; a longer time than a frame's is shortened to it. Each frame becomes
    ten, each for the middle of its time.

    Args:
        sequence: of frames.
        phase_time: in which phases change [s], >= 0.
        amplitude_time: in which amplitudes change [s], >= 0.

    Raises:
        ValueError: an argument out of range.
    """
    require_kind("sequence", sequence, Sequence)
    frame = 1 / sequence.rate
    middles = (torch.arange(_PARTS, **REAL) + 0.5) / _PARTS
    shares = []
    for name, time in (("phase_time", phase_time), ("amplitude_time", amplitude_time)):
        time = min(not_negative(name, time, "s"), frame)
        shares.append((middles * frame / time).clamp_max(1) if time else torch.ones_like(middles))
    drives = sequence.drives[:, None]
    before = drives.roll(1, 0)
    if not sequence.loop:
        before[0] = drives[0]
    phase, amplitude = (share[:, None] for share in shares)
    size = before.abs() + amplitude * (drives.abs() - before.abs())
    # a silent transducer has the phase of its other frame
    first = torch.where(before == 0, drives, before)
    last = torch.where(drives == 0, before, drives)
    turned = torch.polar(size, first.angle() + phase * (last * first.conj()).angle())
    return Sequence(turned.flatten(0, 1), _PARTS * sequence.rate, sequence.loop)


def _samples(waveform: object) -> torch.Tensor | None:
    """Return the samples (N,) of a waveform, None for one with a name."""
    if isinstance(waveform, str):
        require_one_of("waveform", waveform, ("sine", "square"))
        return None
    samples = real_tensor("waveform", waveform).detach().cpu()
    if samples.ndim != 1 or len(samples) < 2:
        raise ValueError(f"waveform: shape {tuple(samples.shape)}; must be (N,) with N >= 2")
    if samples.min() < 0 or samples.max() > 1:
        span = f"from {samples.min():g} to {samples.max():g}"
        raise ValueError(f"waveform: {span}; every sample must be in [0, 1]")
    return samples


def _wave(waveform: object, turn: torch.Tensor) -> torch.Tensor:
    """Return the waveform of a name at parts (T,) of its period."""
    if waveform == "square":
        return (turn < 0.5).double()
    return (1 + (2 * math.pi * turn).sin()) / 2


def _repeated(sequence: Sequence, least: float, rate: float | None) -> Sequence:
    """Return a sequence with frames repeated to a rate, or to the first multiple that is `least` [Hz]."""
    wanted = least if rate is None else positive("rate", rate, "Hz")
    times = wanted / sequence.rate
    whole = max(1, math.ceil(times * (1 - _ROUNDING)))
    if rate is not None and abs(whole - times) > _ROUNDING * whole:
        raise invalid("rate", rate, f"must be a multiple of the sequence's {sequence.rate:g}", "Hz")
    return sequence.at_rate(whole * sequence.rate)
