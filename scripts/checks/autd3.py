"""Free-space fields and sequences of an AUTD3 against the emulator of its SDK.

Needs `pip install 'autdtorch[crosscheck]'`. The emulator has two fields. "RMS" is a sum of point sources
without directivity or absorption, with the phases and pulse widths of the emulated firmware. "Instant" is the
pressure over time, of square waves filtered by a model of the transducer. Of sequences, phases and pulse
widths of every period are compared with the frames. Their phases swing: where one passes 0 downwards twice,
the emulator 0.12.0 smooths in the wrong direction.
"""

import cmath
import math
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from autd3.commands import Pattern, SetSilencer
from autd3_core import Autd3, Duration, Geometry, Velocity
from autd3_emulator import Emulator, Grid, InstantRecordOption, Record, Recorder, RmsRecordOption
from autd3_pattern import IntensityBuffer, PhaseBuffer, focus, wavelength
from numpy.typing import NDArray
from shared.document import Page, table
from shared.scenes import relative_error

import autdtorch as at
from autdtorch.hardware import AUTD3
from autdtorch.hardware.devices.autd3 import autd3_sequence
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.scene.boards import TRANSDUCER_RADIUS
from autdtorch.scene.sequence import Sequence

DOCUMENT = "benchmarks.md"
PACKAGES = ("autd3-emulator", "autd3-pattern")

FREQUENCY, SOUND_SPEED = 40e3, 340.0
WAVENUMBER = 2 * math.pi * FREQUENCY / SOUND_SPEED
SOURCE_STRENGTH = 275.574_25 * 0.2 / (4 * math.pi)
"""Source strength of a T4010A1 in their RMS field [Pa m]."""

PITCH = 10.16e-3
"""Pitch of the transducers [m], 18 along x and 14 along y."""
FOCUS = (60e-3, 80e-3, 150e-3)
"""Focus in the coordinates of the device [m]."""
PLANE = ((0.0, 172.0), 80.0, (50.0, 250.0))
"""Plane through the focus, x, y and z [mm]."""

ABSORPTION = 1.32
"""Absorption of air at 20 degrees and 50 % [dB/m]."""
DECIBELS_PER_NEPER = 20 / math.log(10)

PERIOD = Duration.from_micros(25)
PERIODS = 120
"""Recorded periods: sound takes 36 to the farthest point, a transducer some 30 to settle."""
FULL_PULSE = 512
"""Counts of a pulse width in a period; half of them give full drive."""

_FRAMES, _RATES, _LAPS, _MODULATION = 100, (500.0, 1000.0, 4000.0, 40_000.0), 3, 200.0  # of sequences; Hz


OPTIONS = {"--resolution": {"type": float, "default": 1.0, "help": "of the plane [mm]"}}


def main(page: Page, resolution: float) -> None:
    grid = plane(resolution)
    lines, factor = rows(grid)
    late = math.degrees(cmath.phase(factor))
    page.write(
        f"{', '.join(f'{name} {version(name)}' for name in PACKAGES)}.",
        table(("theirs", "ours", "relative difference", "what explains it"), lines),
        f"Transducer positions agree within {1e9 * largest_shift():.0f} nm. The emulator's instant field is "
        f"{abs(factor):.4f} times ours and {late:.1f} degrees late, by its model of a transducer.",
        sequences(),
    )


@dataclass(frozen=True)
class Emission:
    """The output of the emulated device."""

    record: Record
    phases: NDArray[np.int64]  # levels (M,), 256 in a period
    pulse_widths: NDArray[np.int64]  # (M,), 512 in a period

    @property
    def drive(self) -> torch.Tensor:
        """Return the complex amplitudes (M,) of the fundamentals of the pulses."""
        amplitude = np.sin(np.pi * self.pulse_widths / FULL_PULSE)
        return torch.from_numpy(amplitude * np.exp(2j * np.pi * self.phases / 256))


def our_array(radius: float = 0.0) -> at.TransducerArray:
    """Return the AUTD3 as our array, of points or of discs with a radius [m]."""
    middle = 8.5 * PITCH, 6.5 * PITCH, 0.0
    return at.TransducerArray.autd3(middle, (0, 0, 1), source_strength=SOURCE_STRENGTH, radius=radius)


def largest_shift() -> float:
    """Return the largest distance between their transducers and ours, in the order of the device [m]."""
    theirs = 1e-3 * torch.from_numpy(Geometry([Autd3()])[0].positions().astype(np.float64))
    return float((theirs - our_array().positions).norm(dim=1).max())


def play(geometry: Geometry, phases: PhaseBuffer, intensities: IntensityBuffer | int = 255) -> Emission:
    def send(recorder: Recorder) -> None:
        recorder.send([SetSilencer.disable(), Pattern(phases, intensities)])
        recorder.tick(Duration.from_nanos(PERIODS * PERIOD.as_nanos()))

    record = Emulator(geometry).record(send)
    last = [rows.to_numpy()[:, -1].astype(np.int64) for rows in (record.phase(), record.pulse_width())]
    return Emission(record, *last)


def play_focus() -> Emission:
    geometry = Geometry([Autd3()])
    phases = geometry.phase_buffer()
    focus(geometry, [1e3 * x for x in FOCUS], wavelength(Velocity.from_m_s(SOUND_SPEED)), phases)
    return play(geometry, phases)


def play_levels(levels: tuple[torch.Tensor, ...]) -> Emission:
    """Play levels of ours."""
    phase, amplitude = (level.to(torch.uint8).numpy()[None] for level in levels)
    return play(Geometry([Autd3()]), PhaseBuffer.from_array(phase), IntensityBuffer.from_array(amplitude))


def plane(resolution: float) -> Grid:
    """Return points in the plane, `resolution` [mm] apart."""
    return Grid(*PLANE, resolution, "xyz")


def rms(emission: Emission, grid: Grid) -> tuple[torch.Tensor, torch.Tensor]:
    """Return their points (P, 3) [m] and RMS pressures (P,) [Pa]."""
    field = emission.record.sound_field(grid, RmsRecordOption(Velocity.from_m_s(SOUND_SPEED)))
    return points_of(field), torch.from_numpy(field.next(PERIOD).to_numpy()[:, 0].astype(np.float64))


def phasor(emission: Emission, grid: Grid) -> tuple[torch.Tensor, torch.Tensor]:
    """Return their points (P, 3) [m] and phasors (P,) [Pa] of the last period of the instant field."""
    option = InstantRecordOption(Velocity.from_m_s(SOUND_SPEED), Duration.from_micros(1), 512)
    field = emission.record.sound_field(grid, option)
    points = points_of(field)
    field.skip(Duration.from_nanos((PERIODS - 1) * PERIOD.as_nanos()))
    pressure = field.next(PERIOD).to_numpy().astype(np.float64)
    angle = 2 * np.pi * np.arange(pressure.shape[1]) / pressure.shape[1]
    return points, torch.from_numpy(2 * (pressure @ np.exp(1j * angle)) / len(angle))


def points_of(field: Any) -> torch.Tensor:
    """Return the points (P, 3) of a field [m]."""
    return torch.from_numpy(1e-3 * field.observe_points().to_numpy().astype(np.float64))


def ours(
    array: at.TransducerArray, drive: torch.Tensor, points: torch.Tensor, attenuation: float = 0.0
) -> torch.Tensor:
    """Return our complex pressures (P,) [Pa], with an attenuation of air [Np/m]."""
    return free_space_matrix(points, array, complex(WAVENUMBER, attenuation)) @ drive


def scaled(values: torch.Tensor, other: torch.Tensor) -> tuple[complex, float]:
    """Return the factor of `other` that fits `values` best, and the remaining relative L2 difference."""
    factor = complex(torch.vdot(other, values) / torch.vdot(other, other))
    return factor, relative_error(values, factor * other)


def random_drive(transducers: int) -> torch.Tensor:
    amplitude, phase = torch.rand((2, transducers), generator=torch.Generator().manual_seed(0)).double()
    return at.drive_from_phases(2 * math.pi * phase, amplitude)


def sequences() -> str:
    """Return how the emulator plays a moving focus at several rates, and a modulated one."""
    drive, turn = (
        random_drive(249),
        2 * math.pi * torch.arange(_FRAMES, dtype=torch.float64)[:, None] / _FRAMES,
    )
    swinging = drive * torch.polar(torch.ones_like(turn), drive.abs() * turn.sin())
    wrong = sum(wrong_levels(Sequence(swinging, rate)) for rate in _RATES)
    modulated = at.modulated(drive / drive.abs(), _MODULATION)
    widths = played_sequence(modulated, _LAPS)[1]
    ticks = round(FREQUENCY / modulated.rate)
    power = (np.sin(np.pi * widths[:, ticks - 1 :: ticks] / FULL_PULSE) ** 2).mean(axis=0)
    number = np.arange(len(power))
    deviation = np.abs(power - (1 + np.sin(2 * np.pi * number / len(modulated))) / 2).max()
    frequency = np.abs(np.fft.rfft(power - power.mean())).argmax() * modulated.rate / len(power)
    rates = ", ".join(f"{rate:g}" for rate in _RATES)
    return (
        f"Sequences of {_FRAMES} frames at {rates} frames/s: {wrong} levels differ at the end of a frame. "
        f"Amplitude modulation of {_MODULATION:g} Hz: {frequency:g} Hz, and the radiation pressure within "
        f"{100 * deviation:.1f} % of its largest."
    )


def played_sequence(sequence: Sequence, laps: int) -> list[NDArray[np.int64]]:
    """Return phases and pulse widths (M, ticks) of the emulator, from the first frame of a sequence on."""
    held = AUTD3.held(sequence.drives, sequence.rate, sequence.loop)
    assert held is not None
    recorder = Recorder(Geometry([Autd3()]), 0)
    recorder.send(autd3_sequence(held, 1))
    recorder.tick(Duration.from_nanos(round(1e9 * laps * sequence.duration)))
    record = recorder.into_record()
    return [part.to_numpy().astype(np.int64) for part in (record.phase(), record.pulse_width())]


def wrong_levels(sequence: Sequence) -> int:
    """Return the number of levels that the emulator does not emit at the end of their frames."""
    ticks = round(FREQUENCY / sequence.rate)
    phases, widths = (part[:, ticks - 1 :: ticks] for part in played_sequence(sequence, _LAPS))
    phase, intensity = (level.T.repeat(1, _LAPS).numpy() for level in AUTD3.levels(sequence.drives))
    pulses = FULL_PULSE * np.arcsin(intensity / 255) / np.pi
    return int((phases != phase).sum() + (np.abs(widths - pulses) > 1).sum())


def rows(grid: Grid) -> tuple[list[list[str]], complex]:
    """Return the comparisons, and the ratio of their instant field to ours."""
    array, focused, random = our_array(), play_focus(), play_levels(AUTD3.levels(random_drive(249)))
    discs, attenuation = our_array(TRANSDUCER_RADIUS), ABSORPTION / DECIBELS_PER_NEPER
    points, theirs = rms(focused, grid)
    _, theirs_random = rms(random, grid)
    instant_points, instant = phasor(focused, grid)
    factor, left = scaled(instant, ours(array, focused.drive, instant_points))

    def difference(
        other: torch.Tensor, array: at.TransducerArray, drive: torch.Tensor, attenuation: float = 0.0
    ) -> float:
        return relative_error(ours(array, drive, points, attenuation).abs() / math.sqrt(2), other)

    weak = difference(theirs, array, focused.drive, attenuation)
    differences = (
        ("RMS, focus", "drive as recorded", difference(theirs, array, focused.drive), "float32"),
        ("RMS, random", "drive as recorded", difference(theirs_random, array, random.drive), "float32"),
        ("instant, focus", "drive as recorded, scaled", left, "waveforms between samples"),
        ("RMS, focus", "discs of radius 4.5 mm", difference(theirs, discs, focused.drive), "directivity"),
        ("RMS, focus", f"air that absorbs {ABSORPTION:g} dB/m", weak, "absorption"),
    )
    return [[theirs, ours, f"{value:.2g}", cause] for theirs, ours, value, cause in differences], factor
