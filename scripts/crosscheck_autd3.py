"""Free-space fields of an AUTD3 against the emulator of its SDK (`pip install 'autdtorch[crosscheck]'`).

    python scripts/crosscheck_autd3.py

Fills in crosschecks.md, in docs/ or `--output`. Their emulator knows two fields. "RMS" is a sum of point
sources without directivity or absorption, of the phases and pulse widths that the emulated firmware has;
"instant" the pressure over time, of square waves sent through a model of the transducer.
"""

from __future__ import annotations

import argparse
import cmath
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from autd3.commands import Pattern, SetSilencer
from autd3_core import Autd3, Duration, Geometry, Velocity
from autd3_emulator import Emulator, Grid, InstantRecordOption, Record, Recorder, RmsRecordOption
from autd3_pattern import IntensityBuffer, PhaseBuffer, focus, wavelength
from generated_block import fill_in, measured, table
from numpy.typing import NDArray

import autdtorch as at
from autdtorch.analytic.green import free_space_matrix
from autdtorch.hardware.devices.levels import AUTD3_FULL, Levels, autd3_drive, autd3_levels
from autdtorch.scene.device_layouts import TRANSDUCER_RADIUS

DOCUMENT = Path(__file__).parents[1] / "docs" / "crosschecks.md"
COMMAND = "python scripts/crosscheck_autd3.py"
PACKAGES = ("autd3-emulator", "autd3-pattern")

FREQUENCY, SOUND_SPEED = 40e3, 340.0
WAVENUMBER = 2 * math.pi * FREQUENCY / SOUND_SPEED
SOURCE_STRENGTH = 275.574_25 * 0.2 / (4 * math.pi)
"""Of a T4010A1 at full drive [Pa m], as their RMS field has it."""

PITCH = 10.16e-3
"""Of its transducers [m], 18 along x and 14 along y."""
FOCUS = (60e-3, 80e-3, 150e-3)
"""In the coordinates of the device [m]."""
PLANE = ((0.0, 172.0), 80.0, (50.0, 250.0))
"""Through the focus, x, y and z [mm]."""

ABSORPTION = 1.32
"""Of air at 20 degrees and 50 % [dB/m]."""
DECIBELS_PER_NEPER = 20 / math.log(10)

PERIOD = Duration.from_micros(25)
PERIODS = 120
"""That are recorded: sound takes 36 to the farthest point, a transducer some 30 to settle."""
FULL_PULSE = 512
"""Counts of a pulse width in a period; half of them are full drive."""


@dataclass(frozen=True)
class Emission:
    """What the emulated device plays.

    Attributes:
        record: of the emulator.
        phases: levels (M,), 256 in a period.
        pulse_widths: (M,), 512 in a period.
    """

    record: Record
    phases: NDArray[np.int64]
    pulse_widths: NDArray[np.int64]

    @property
    def drive(self) -> torch.Tensor:
        """Of the fundamentals of its pulses, complex (M,)."""
        amplitude = np.sin(np.pi * self.pulse_widths / FULL_PULSE)
        return torch.from_numpy(amplitude * np.exp(2j * np.pi * self.phases / 256))


@dataclass(frozen=True)
class Row:
    """A comparison: what of theirs with what of ours, the relative L2 difference, and its reason."""

    theirs: str
    ours: str
    difference: float
    reason: str


def device() -> Geometry:
    """One AUTD3 of theirs, with transducer 0 in the origin; it emits along z."""
    return Geometry([Autd3()])


def our_array(radius: float = 0.0) -> at.TransducerArray:
    """The same AUTD3 of ours, of points or discs [m]."""
    middle = 8.5 * PITCH, 6.5 * PITCH, 0.0
    return at.TransducerArray.autd3(middle, (0, 0, 1), source_strength=SOURCE_STRENGTH, radius=radius)


def largest_shift() -> float:
    """Between their transducers and ours, in the order of the device [m]."""
    theirs = 1e-3 * torch.from_numpy(device()[0].positions().astype(np.float64))
    return float((theirs - our_array().positions).norm(dim=1).max())


def play(
    geometry: Geometry, phases: PhaseBuffer, intensities: IntensityBuffer | int = AUTD3_FULL
) -> Emission:
    """Let the emulator play a pattern."""

    def send(recorder: Recorder) -> None:
        recorder.send([SetSilencer.disable(), Pattern(phases, intensities)])
        recorder.tick(Duration.from_nanos(PERIODS * PERIOD.as_nanos()))

    record = Emulator(geometry).record(send)
    last = [one.to_numpy()[:, -1].astype(np.int64) for one in (record.phase(), record.pulse_width())]
    return Emission(record, *last)


def play_focus() -> Emission:
    """A focus as their SDK makes it."""
    geometry = device()
    phases = geometry.phase_buffer()
    focus(geometry, [1e3 * x for x in FOCUS], wavelength(Velocity.from_m_s(SOUND_SPEED)), phases)
    return play(geometry, phases)


def play_levels(levels: Levels) -> Emission:
    """Levels of ours."""
    phase, amplitude = (one.to(torch.uint8).numpy()[None] for one in levels)
    return play(device(), PhaseBuffer.from_array(phase), IntensityBuffer.from_array(amplitude))


def plane(resolution: float) -> Grid:
    """Points in the plane, `resolution` [mm] apart."""
    return Grid(*PLANE, resolution, "xyz")


def rms(emission: Emission, grid: Grid) -> tuple[torch.Tensor, torch.Tensor]:
    """Their points (P, 3) [m] and RMS pressures (P,) [Pa]."""
    field = emission.record.sound_field(grid, RmsRecordOption(Velocity.from_m_s(SOUND_SPEED)))
    return points_of(field.observe_points().to_numpy()), column(field.next(PERIOD).to_numpy())


def phasor(emission: Emission, grid: Grid) -> tuple[torch.Tensor, torch.Tensor]:
    """Their points (P, 3) [m] and complex amplitudes (P,) [Pa] of the instant field, of its last period."""
    option = InstantRecordOption(Velocity.from_m_s(SOUND_SPEED), Duration.from_micros(1), 512)
    field = emission.record.sound_field(grid, option)
    points = points_of(field.observe_points().to_numpy())
    field.skip(Duration.from_nanos((PERIODS - 1) * PERIOD.as_nanos()))
    pressure = field.next(PERIOD).to_numpy().astype(np.float64)
    angle = 2 * np.pi * np.arange(pressure.shape[1]) / pressure.shape[1]
    return points, torch.from_numpy(2 * (pressure @ np.exp(1j * angle)) / len(angle))


def points_of(frame: NDArray[np.float32]) -> torch.Tensor:
    """Points (P, 3) [m]."""
    return torch.from_numpy(1e-3 * frame.astype(np.float64))


def column(frame: NDArray[np.float32]) -> torch.Tensor:
    """The only column of a frame."""
    return torch.from_numpy(frame[:, 0].astype(np.float64))


def ours(
    array: at.TransducerArray, drive: torch.Tensor, points: torch.Tensor, attenuation: float = 0.0
) -> torch.Tensor:
    """Our complex pressures (P,) [Pa], with the attenuation of air [Np/m]."""
    return free_space_matrix(points, array, complex(WAVENUMBER, attenuation)) @ drive


def relative_difference(value: torch.Tensor, other: torch.Tensor) -> float:
    """Relative L2 difference."""
    return float((value - other).norm() / other.norm())


def scaled(values: torch.Tensor, other: torch.Tensor) -> tuple[complex, float]:
    """The factor c that brings c `other` closest to `values`, and the relative L2 difference left."""
    factor = complex(torch.vdot(other, values) / torch.vdot(other, other))
    return factor, relative_difference(values, factor * other)


def random_drive(transducers: int) -> torch.Tensor:
    """Amplitudes and phases anywhere, (M,)."""
    amplitude, phase = torch.rand((2, transducers), generator=torch.Generator().manual_seed(0)).double()
    return at.drive_from_phases(2 * math.pi * phase, amplitude)


def rms_rows(grid: Grid) -> list[Row]:
    """Their RMS field of a focus and of a random drive, by what ours is told of the drive."""
    array, focused = our_array(), play_focus()
    wanted = at.drive_from_phases(at.focus_phases(array.positions, FOCUS, WAVENUMBER))
    rounded, levels = autd3_levels(wanted), autd3_levels(random_drive(len(array)))
    same = int((rounded.phase.numpy() == focused.phases).sum())
    random = play_levels(levels)
    cases = (
        ("focus", focused, "drive as recorded", focused.drive, "float32"),
        (
            "focus", focused, "`autd3_levels` of `focus_phases`", autd3_drive(rounded),
            f"float32; {same} of {len(array)} levels are those of `autd3_pattern.focus`",
        ),
        ("focus", focused, "`focus_phases`, not rounded", wanted, "phases of 8 bits"),
        ("random", random, "drive as recorded", random.drive, "float32"),
        ("random", random, "`autd3_drive` of the levels", autd3_drive(levels), "pulse widths of 9 bits"),
    )  # fmt: skip
    rows = []
    for name, emission, told, drive, reason in cases:
        points, theirs = rms(emission, grid)
        found = ours(array, drive, points).abs() / math.sqrt(2)
        rows.append(Row(f"RMS, {name}", told, relative_difference(found, theirs), reason))
    return rows


def instant_row(grid: Grid) -> tuple[Row, complex]:
    """Their instant field of a focus, and its scale over ours."""
    emission = play_focus()
    points, theirs = phasor(emission, grid)
    factor, left = scaled(theirs, ours(our_array(), emission.drive, points))
    return Row("instant, focus", "drive as recorded, scaled", left, "waveforms between samples"), factor


def left_out_rows(grid: Grid) -> list[Row]:
    """What their model leaves out, by how much it changes our field of a focus."""
    emission = play_focus()
    points, theirs = rms(emission, grid)
    cases = (
        ("discs of radius 4.5 mm", "directivity", ours(our_array(TRANSDUCER_RADIUS), emission.drive, points)),
        (
            f"air that absorbs {ABSORPTION:g} dB/m", "absorption",
            ours(our_array(), emission.drive, points, ABSORPTION / DECIBELS_PER_NEPER),
        ),
    )  # fmt: skip
    return [
        Row("RMS, focus", what, relative_difference(field.abs() / math.sqrt(2), theirs), reason)
        for what, reason, field in cases
    ]


def seconds(action: Callable[[], object]) -> float:
    """Run time of the second of two calls."""
    action()
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def run_times(grid: Grid) -> str:
    """Theirs and ours for all points, as a sentence."""
    array, emission = our_array(), play_focus()
    points, _ = rms(emission, grid)
    theirs, own = seconds(lambda: rms(emission, grid)), seconds(lambda: ours(array, emission.drive, points))
    return (
        f"Run times for {len(points)} points: the emulator's RMS field {theirs:.2g} s (float32, all cores), "
        f"ours {own:.2g} s (float64, threads: {torch.get_num_threads()})."
    )


def report(resolution: float) -> list[str]:
    """The generated part of crosschecks.md."""
    grid = plane(resolution)
    row, factor = instant_row(grid)
    rows = [*rms_rows(grid), row, *left_out_rows(grid)]
    lines = [(one.theirs, one.ours, f"{one.difference:.2g}", one.reason) for one in rows]
    late = math.degrees(cmath.phase(factor))
    notes = (
        f"Our transducers lie within {1e9 * largest_shift():.0f} nm of theirs, in their order. The instant "
        f"field is {abs(factor):.4f} times ours and {late:.1f} degrees late, by the emulator's model of a "
        f"transducer. Its peak is {math.sqrt(2) * abs(factor):.3f} times the emulator's own RMS field, where "
        "a sine has the square root of 2."
    )
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    header = ("theirs", "ours", "relative difference", "what explains it")
    return [f"{measured(COMMAND)}\n\n{packages}.", table(header, lines), notes, run_times(grid)]


def main() -> None:
    """Compare, and fill in the document."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--resolution", type=float, default=1.0, help="of the plane [mm]")
    parser.add_argument("--output", type=Path, default=DOCUMENT.parent)
    given = parser.parse_args()
    fill_in(DOCUMENT, "crosscheck_autd3", report(given.resolution), given.output)


if __name__ == "__main__":
    main()
