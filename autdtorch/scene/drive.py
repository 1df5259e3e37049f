"""Drives of the array: q = a e^{-i phi}, amplitudes a in [0, 1], phases phi [rad] (Eq. 1); device levels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.utils.spatial import distances
from autdtorch.utils.units import real_wavenumber, warn_user
from autdtorch.utils.validation import ArrayLike, complex_tensor, finite_vector, points_tensor, real_tensor

AMPLITUDE_TOLERANCE = 1e-6
"""Excess of |q| over 1 that is accepted: the rounding error of a drive computed in float32."""

_LEAST_WAVENUMBER = 1.0  # [rad/m], at 55 Hz in air; wavelengths in m are below


def drive_from_phases(phases: ArrayLike, amplitudes: ArrayLike | None = None) -> torch.Tensor:
    """Return the drive q = a e^{-i phi} (Eq. 1); differentiable in both arguments.

    Args:
        phases: (..., M) [rad].
        amplitudes: in [0, 1], of a shape that broadcasts with `phases`; 1 by default.

    Returns:
        Drive (..., M), complex128, on the device of `phases`.

    Raises:
        ValueError: not finite real numbers, an amplitude outside [0, 1], or shapes that do not broadcast.

    Warns:
        ScaleWarning: the phases seem to be in degrees, or levels of a device.
    """
    phi = real_tensor("phases", phases, "rad")
    warn_of_degrees("phases", phi.detach())
    if phi.ndim == 0:
        raise ValueError("phases: shape (); must be (..., M)")
    if amplitudes is None:
        return torch.polar(torch.ones_like(phi), -phi)
    a = real_tensor("amplitudes", amplitudes).to(phi.device)
    if a.numel() and (a.min() < 0 or a.max() > 1):
        raise ValueError(f"amplitudes: from {a.min():g} to {a.max():g}; every entry must be in [0, 1]")
    try:
        shape = np.broadcast_shapes(a.shape, phi.shape)
    except ValueError as error:
        accepted = f"must broadcast with phases, {tuple(phi.shape)}"
        raise ValueError(f"amplitudes: shape {tuple(a.shape)}; {accepted}") from error
    return torch.polar(a.expand(shape), -phi.expand(shape))


def warn_of_degrees(name: str, phases: torch.Tensor) -> None:
    """Warn of whole numbers up to 90 or more, degrees or levels; phases in rad are seldom whole."""
    if phases.numel() > 1 and phases.abs().max() >= 90 and torch.equal(phases, phases.round()):
        shown = f"{name}: whole numbers from {phases.min():g} to {phases.max():g} rad"
        warn_user(
            f"{shown}; are these degrees, or levels of a device? Of degrees, take numpy.radians(phases)"
        )


def phases_of(drive: ArrayLike) -> torch.Tensor:
    """Return the phases of a `drive` (..., M) in [0, 2 pi) [rad]; 0 where the drive is 0.

    Raises:
        ValueError: not finite complex numbers.
    """
    drive = drive_tensor(drive)
    phases = torch.remainder(-torch.angle(drive), 2 * math.pi)
    # remainder rounds a phase just below 0 to 2 pi and keeps -0, and the angle of -0 is pi.
    return torch.where((phases >= 2 * math.pi) | (phases == 0) | (drive == 0), 0.0, phases)


def amplitudes_of(drive: ArrayLike) -> torch.Tensor:
    """Return the amplitudes |q| of a `drive` (..., M); errors as for `phases_of`."""
    return drive_tensor(drive).abs()


def focus_phases(positions: ArrayLike, focus: ArrayLike, wavenumber: float) -> torch.Tensor:
    """Return phases that focus on a point in free space: phi_i = k |r_f - r_i| (Eq. 3), not wrapped.

    Args:
        positions: transducers (M, 3) [m].
        focus: (3,), or P foci (P, 3), each with phases [m].
        wavenumber: k [rad/m], > 0.

    Returns:
        Phases (M,), or (P, M) for several foci [rad].

    Raises:
        ValueError: not finite, wrong shape, or a wavenumber <= 0.
    """
    sources = points_tensor("positions", positions)
    wavenumber = real_wavenumber(wavenumber)
    if wavenumber < _LEAST_WAVENUMBER:
        warn_user(
            f"wavenumber: {wavenumber:g} rad/m; is it the wavelength? Then take 2 * pi / {wavenumber:g}"
        )
    foci = real_tensor("focus", focus, "m")
    if foci.ndim == 1:
        single = torch.tensor([finite_vector("focus", focus)], dtype=torch.float64, device=sources.device)
        return wavenumber * distances(single, sources)[0]
    return wavenumber * distances(points_tensor("focus", foci).to(sources.device), sources)


def normalise(drive: torch.Tensor) -> torch.Tensor:
    """Scale a `drive` (..., M) to a largest amplitude of 1 over the last axis (Eq. 6)."""
    largest = drive.abs().amax(dim=-1, keepdim=True)
    if not (largest > 0).all():
        raise ValueError("drive: 0 for every transducer; at least one amplitude must be > 0")
    return drive / largest


def drive_tensor(drive: ArrayLike, name: str = "drive") -> torch.Tensor:
    """Return `drive` as a finite complex128 tensor of any shape; phases alone are refused."""
    accepted = "must be complex, q = a e^(-i phi), as drive_from_phases(phases) makes it"
    return complex_tensor(name, drive, accepted)


def validate_drive(drive: ArrayLike, transducers: int, name: str = "drive") -> torch.Tensor:
    """Return `drive` as complex128 after checking that it is complex (..., transducers) with |q| <= 1."""
    drive = drive_tensor(drive, name)
    if drive.ndim == 0 or drive.shape[-1] != transducers:
        raise ValueError(f"{name}: shape {tuple(drive.shape)}; must be (..., {transducers})")
    if drive.numel():
        largest = float(drive.detach().abs().max())
        if largest > 1 + AMPLITUDE_TOLERANCE:
            raise ValueError(f"{name}: amplitude {largest:.9g}; every |q| must be in [0, 1]")
    return drive


def validate_single_drive(drive: ArrayLike, transducers: int) -> torch.Tensor:
    """Return a single `drive` (M,), checked as by `validate_drive`."""
    drive = validate_drive(drive, transducers)
    if drive.ndim != 1:
        raise ValueError(f"drive: shape {tuple(drive.shape)}; must be ({transducers},), a single drive")
    return drive


@dataclass(frozen=True)
class PhaseLevels:
    """Phases, and perhaps amplitudes, that a device can emit.

    Level n of N phases emits a cos(w t - 2 pi n / N), so that n counts arg q = -phi. Focusing on distance d
    takes -k d. AUTD3's and Ultraino's `focus`, OpenMPD's solver and SonicSurface's `phasesForFocus` agree.

    Attributes:
        phases: number N of phases in [0, 2 pi), >= 2.
        amplitudes: level of amplitude 1, >= 1; None for continuous amplitudes.
        pulses: a level of amplitude is the duty of a pulse, in 1/N of a period; `amplitudes` is then N / 2.
            Duty d has the fundamental sin(pi d / N). The level of the phase is the start of the pulse.
    """

    phases: int
    amplitudes: int | None = None
    pulses: bool = False

    def nearest(self, drive: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the level of amplitude nearest to a drive (..., M), and of phase at this amplitude.

        A pulse one level shorter begins half a level later, and may be nearer to the drive. With such levels,
        foci of drives at full amplitude are weaker (Ultraino's 1.2 %), and pulses could exceed a limit.

        Both are int64, a continuous amplitude float64. The phase level is 0 where the amplitude is 0. That
        |q| <= 1 is not checked.
        """
        wanted = drive.abs().clamp_max(1)  # above 1 by rounding alone
        if self.amplitudes is None:
            amplitude = wanted
        elif self.pulses:
            amplitude = (self.phases / math.pi * wanted.asin()).round().long()
        else:
            amplitude = (self.amplitudes * wanted + 0.5).long()
        phase = torch.remainder(-drive.angle(), 2 * math.pi)
        ahead = (phase / self._step - self._delay(amplitude)).round()
        return torch.where(amplitude > 0, -ahead.long() % self.phases, 0), amplitude

    def drive(self, phase: torch.Tensor, amplitude: torch.Tensor) -> torch.Tensor:
        """Return the drive (..., M), complex128, of levels as `nearest` gives them."""
        emitted = amplitude.double()
        if self.pulses:
            emitted = (math.pi / self.phases * emitted).sin()
        elif self.amplitudes is not None:
            emitted = emitted / self.amplitudes
        ahead = (-phase % self.phases).double() + self._delay(amplitude)
        return torch.polar(emitted, -(ahead * self._step))

    @property
    def _step(self) -> float:
        return 2 * math.pi / self.phases

    def _delay(self, amplitude: torch.Tensor) -> torch.Tensor | float:
        """Return the levels by which a pulse begins after one of half a period with the same centre."""
        return (self.phases / 2 - amplitude.double()) / 2 if self.pulses else 0.0
