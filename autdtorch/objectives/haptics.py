"""The field of a sequence in time: pressure, radiation pressure, its spectrum, ripple of moving foci.

These are physical quantities. What a person feels depends on skin, place and motion, too. With equal outputs,
foci on small circles were felt more strongly than modulated amplitudes at 10 to 200 Hz (Takahashi, Hasegawa
and Shinoda 2020, IEEE Trans. Haptics 13, 334). Foci that moved at 5 to 15 Hz in steps below 1 mm felt like a
steady force of 0.21 N where the radiation force was 0.027 N (IEEE Trans. Haptics 15, 441, 2022,
doi:10.1109/TOH.2021.3125843).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from autdtorch.scene.geometry import path_foci
from autdtorch.scene.sequence import Sequence
from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import require_memory
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, number_between, points_tensor, require_kind, within

if TYPE_CHECKING:
    from autdtorch.propagators import Propagator

TACTILE_BAND = 5.0, 500.0
"""TACTILE_BAND: frequencies [Hz] of the part of the radiation pressure that `HapticMetrics.tactile` sums."""

_LINE_BYTES = 24  # of the spectrum at a point, with intermediate results


@dataclass(frozen=True, eq=False, repr=False)
class HapticMetrics:
    """The field of a sequence of T frames at P points, and at F foci that move.

    Attributes:
        pressure: peak amplitudes at the points while each frame plays (T, P) [Pa].
        radiation: radiation pressure there (T, P) [Pa].
        times: at which the frames begin (T,) [s].
        frequencies: of the spectrum (N,) [Hz], multiples of 1 / duration to half the rate, or to 500 Hz
            if that is more.
        spectrum: amplitudes of the radiation pressure (N, P) [Pa], the first of which is the mean. A frame
            holds until the next one, which adds frequencies above half the rate.
        tactile: root mean square of the part from 5 to 500 Hz (P,) [Pa].
        foci: peak amplitudes at the foci of each frame (T, F) [Pa]; None without a path.
        elsewhere: largest amplitude of each frame (T,) [Pa] at points a wavelength or more from its foci;
            None without a path, 0 without such points.
    """

    pressure: torch.Tensor
    radiation: torch.Tensor
    times: torch.Tensor
    frequencies: torch.Tensor
    spectrum: torch.Tensor
    tactile: torch.Tensor
    foci: torch.Tensor | None
    elsewhere: torch.Tensor | None

    @property
    def ripple(self) -> torch.Tensor | None:
        """(max - min) / (max + min) over frames of the pressure at each focus (F,); None without a path."""
        if self.foci is None:
            return None
        largest, smallest = self.foci.amax(dim=0), self.foci.amin(dim=0)
        return (largest - smallest) / (largest + smallest).clamp_min(torch.finfo(torch.float64).tiny)

    def __repr__(self) -> str:
        parts = [
            f"{counted(len(self.times), 'frame')}, {counted(self.pressure.shape[1], 'point')}",
            f"up to {self.pressure.max():.4g} Pa, radiation pressure {self.radiation.max():.4g} Pa",
            f"5 to 500 Hz up to {self.tactile.max():.4g} Pa rms",
        ]
        if self.ripple is not None and self.elsewhere is not None:
            parts.append(
                f"ripple {100 * self.ripple.max():.1f} %, elsewhere up to {self.elsewhere.max():.4g} Pa"
            )
        return f"HapticMetrics({'; '.join(parts)})"


def haptic_metrics(
    propagator: Propagator,
    sequence: Sequence,
    points: ArrayLike,
    path: ArrayLike | None = None,
    reflection: float = 1.0,
) -> HapticMetrics:
    """Compute the field of a sequence at points, such as those of a palm or of the plane of the foci.

    The radiation pressure on a surface that the wave meets head-on is (1 + R^2) |p|^2 / (2 rho c^2). There p
    is the peak amplitude of the incident wave, and R the reflection factor of the surface, nearly 1 for skin.
    The surface itself is not in the field: add it to the obstacles if its echo counts.

    Args:
        propagator: of the scene.
        sequence: of drives of its array. Its duration is taken as one period.
        points: (P, 3) [m].
        path: foci (T, 3) or (T, F, 3) [m]. If the sequence has a multiple of T frames, each focus stays for
            as many. A sequence of two laps, as `modulated` may return, needs `path.repeat(2, 1)`.
        reflection: R, 0 to 1.

    Raises:
        ValueError: an argument out of range, or a sequence for another array or path.
    """
    from autdtorch.propagators import Propagator  # takes a second

    require_kind("propagator", propagator, Propagator)
    require_kind("sequence", sequence, Sequence)
    scene, places = propagator.scene, points_tensor("points", points).cpu()
    if sequence.transducers != len(scene.array):
        accepted = f"must be those of the array, {len(scene.array)}"
        raise ValueError(f"sequence: {sequence.transducers} transducers; {accepted}")
    reflection = number_between("reflection", reflection, 0, 1)
    foci = None if path is None else _foci(path, len(sequence))
    with within("points"):
        pressure = (sequence.drives @ propagator.transfer_matrix(places).cpu().mT).abs()
    medium = scene.medium
    factor = (1 + reflection**2) / (2 * medium.density * medium.sound_speed**2)
    radiation = factor * pressure.square()
    lines = max(1, len(sequence) // 2, round(TACTILE_BAND[1] * sequence.duration))
    require_memory("points", tuple(places.shape), _LINE_BYTES * lines * len(places))
    spectrum = _held_spectrum(radiation, lines)
    frequencies = torch.arange(len(spectrum), **REAL) / sequence.duration
    # rounding of a duration must not move a line out of the band
    band = (frequencies >= TACTILE_BAND[0] * (1 - 1e-9)) & (frequencies <= TACTILE_BAND[1] * (1 + 1e-9))
    at_foci = elsewhere = None
    if foci is not None:
        with within("path"):
            rows = propagator.transfer_matrix(foci.reshape(-1, 3)).cpu().reshape(*foci.shape[:2], -1)
        repeats = len(sequence) // len(foci)
        at_foci = (rows.repeat_interleave(repeats, 0) @ sequence.drives[..., None])[..., 0].abs()
        away = torch.cdist(foci, places).amin(dim=1) >= scene.wavelength
        elsewhere = (pressure * away.repeat_interleave(repeats, 0)).amax(dim=1)
    return HapticMetrics(
        pressure,
        radiation,
        sequence.times,
        frequencies,
        spectrum,
        (spectrum[band].square().sum(dim=0) / 2).sqrt(),
        at_foci,
        elsewhere,
    )


def _held_spectrum(values: torch.Tensor, lines: int) -> torch.Tensor:
    """Return amplitudes (1 + lines, P) of the Fourier series of values (T, P) that are held for 1/T each."""
    count, number = len(values), torch.arange(lines + 1, device="cpu")
    alias = torch.minimum(number % count, -number % count)
    held = torch.sinc(number.double() / count).abs() * (2 / count)
    held[0] = 1 / count
    spectrum: torch.Tensor = torch.fft.rfft(values, dim=0).abs()[alias] * held[:, None]
    return spectrum


def _foci(path: ArrayLike, frames: int) -> torch.Tensor:
    """Return the foci (T, F, 3) of a path, after checking that the frames are a multiple of T."""
    foci = path_foci(path)
    if frames % len(foci):
        accepted = f"must be (T, 3) or (T, F, 3) of which {frames} frames are a multiple"
        raise ValueError(f"path: shape {tuple(foci.shape)}; {accepted}")
    return foci
