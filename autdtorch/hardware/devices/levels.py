"""The integer levels that a device takes in place of phases and amplitudes, and back.

Every device here counts its phase in the direction of arg q = -phi: at level n of N it emits
a cos(w t - 2 pi n / N), so that a focus at distance d takes -k d. This is how their own programs focus
(AUTD3's and Ultraino's `focus`, OpenMPD's solver, SonicSurface's `phasesForFocus`). Levels are rounded to the
nearest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from autdtorch.scene.drive import validate_drive
from autdtorch.utils.validation import ArrayLike, complex_tensor, invalid

#: Phase levels of a device in one period, and the largest amplitude levels.
AUTD3_PHASES, AUTD3_FULL = 256, 255
OPENMPD_PHASES, OPENMPD_FULL = 128, 64
SONICSURFACE_PHASES = 32
#: The phase level that switches a transducer of a SonicSurface off.
SONICSURFACE_OFF = 32
ULTRAINO_PHASES, ULTRAINO_FULL = 10, 5


class Levels(NamedTuple):
    """What is sent to M transducers that have an amplitude.

    Attributes:
        phase: (..., M), int64, from 0; 0 where the amplitude is 0.
        amplitude: (..., M), int64, from 0.
    """

    phase: torch.Tensor
    amplitude: torch.Tensor


def autd3_levels(drive: ArrayLike) -> Levels:
    """Phases 0 to 255 and intensities 0 to 255 for AUTD3.

    The intensity i is proportional to the amplitude, as the firmware gives it the pulse width
    512 asin(i / 255) / pi (AUTD3 manual, "Intensity and Pulse Width"), unless another table was loaded.

    Args:
        drive: complex (..., M), |q| <= 1, in the order of the device.

    Raises:
        ValueError: not finite complex numbers, no axis, or an amplitude above 1.
    """
    drive = _checked_drive(drive)
    amplitude = _rounded(AUTD3_FULL * drive.abs())
    return Levels(_phase_level(drive, AUTD3_PHASES, amplitude > 0), amplitude)


def autd3_drive(levels: Levels) -> torch.Tensor:
    """Drive (..., M), complex128, that AUTD3 plays for `levels`; inverse of `autd3_levels`.

    Raises:
        ValueError: levels that are not integers from 0 to 255, or phases and amplitudes of different shape.
    """
    phase, amplitude = _checked_levels("AUTD3", levels, AUTD3_PHASES, AUTD3_FULL)
    return torch.polar(amplitude / AUTD3_FULL, 2 * math.pi / AUTD3_PHASES * phase)


def openmpd_levels(drive: ArrayLike) -> Levels:
    """Phases 0 to 127 and duties 0 to 64 for a board of OpenMPD.

    A pulse of duty d has the fundamental sin(pi d / 128), so that d = 128 asin(a) / pi. As it starts at its
    phase, a shift by (64 - d) / 2 levels keeps its centre where it is. OpenMPD's solver (`discretise`) does
    the same, but truncates where this rounds.

    Args:
        drive: complex (..., M), |q| <= 1; for a calibrated board, from `OpenMPDBoard.calibrated`.

    Raises:
        ValueError: not finite complex numbers, no axis, or an amplitude above 1.
    """
    return _pulse_levels(_checked_drive(drive), OPENMPD_PHASES)


def openmpd_drive(levels: Levels) -> torch.Tensor:
    """Drive (..., M), complex128, that a board of OpenMPD plays for `levels`; inverse of `openmpd_levels`.

    Raises:
        ValueError: phases that are not integers from 0 to 127, duties that are not integers from 0 to 64, or
            phases and duties of different shape.
    """
    return _pulse_drive(_checked_levels("OpenMPD", levels, OPENMPD_PHASES, OPENMPD_FULL), OPENMPD_PHASES)


def ultraino_levels(drive: ArrayLike) -> Levels:
    """Phases 0 to 9 and duties 0 to 5 for boards of Ultraino.

    As for `openmpd_levels`, with duties of 10. Ultraino's own program makes the duty proportional to the
    amplitude, and lets the centre of a pulse move with its duty.

    Args:
        drive: complex (..., M), |q| <= 1.

    Raises:
        ValueError: not finite complex numbers, no axis, or an amplitude above 1.
    """
    return _pulse_levels(_checked_drive(drive), ULTRAINO_PHASES)


def ultraino_drive(levels: Levels) -> torch.Tensor:
    """Drive (..., M), complex128, that boards of Ultraino play for `levels`; inverse of `ultraino_levels`.

    Raises:
        ValueError: phases that are not integers from 0 to 9, duties that are not integers from 0 to 5, or
            phases and duties of different shape.
    """
    return _pulse_drive(_checked_levels("Ultraino", levels, ULTRAINO_PHASES, ULTRAINO_FULL), ULTRAINO_PHASES)


def sonicsurface_levels(drive: ArrayLike) -> torch.Tensor:
    """Phases 0 to 31 for a SonicSurface, or 32 where the transducer is off.

    The device has no amplitude: |q| < 1/2 is off, anything else is full.

    Args:
        drive: complex (..., M), |q| <= 1.

    Returns:
        Levels (..., M), int64.

    Raises:
        ValueError: not finite complex numbers, no axis, or an amplitude above 1.
    """
    drive = _checked_drive(drive)
    on = drive.abs() >= 0.5
    return torch.where(on, _phase_level(drive, SONICSURFACE_PHASES, on), SONICSURFACE_OFF)


def sonicsurface_drive(levels: ArrayLike) -> torch.Tensor:
    """Drive (..., M), complex128, that a SonicSurface plays for `levels`; inverse of `sonicsurface_levels`.

    Raises:
        ValueError: levels that are not integers from 0 to 32.
    """
    level = _integers("SonicSurface levels", levels, SONICSURFACE_OFF)
    on = (level != SONICSURFACE_OFF).double()
    return torch.polar(on, 2 * math.pi / SONICSURFACE_PHASES * level.double())


def _checked_drive(drive: ArrayLike) -> torch.Tensor:
    tensor = complex_tensor("drive", drive).detach()
    return validate_drive(tensor, tensor.shape[-1] if tensor.ndim else 0)


def _checked_levels(device: str, levels: Levels, phases: int, full: int) -> Levels:
    """The `levels` as float64, ready for the trigonometry, after checking them."""
    phase = _integers(f"{device} levels.phase", levels.phase, phases - 1)
    amplitude = _integers(f"{device} levels.amplitude", levels.amplitude, full)
    if phase.shape != amplitude.shape:
        raise ValueError(
            f"{device} levels: phase of shape {tuple(phase.shape)}, amplitude of shape "
            f"{tuple(amplitude.shape)}; must be equal"
        )
    return Levels(phase.double(), amplitude.double())


def _integers(name: str, values: ArrayLike, most: int) -> torch.Tensor:
    tensor = torch.as_tensor(values, device="cpu")
    integer = not (tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool)
    if not integer or (tensor.numel() and (tensor.min() < 0 or tensor.max() > most)):
        raise invalid(name, tensor, f"must be integers from 0 to {most}")
    return tensor.long()


def _phase_level(
    drive: torch.Tensor, phases: int, on: torch.Tensor, shift: torch.Tensor | float = 0.0
) -> torch.Tensor:
    level = _rounded(phases / (2 * math.pi) * drive.angle() + shift) % phases
    return torch.where(on, level, 0)


def _pulse_levels(drive: torch.Tensor, phases: int) -> Levels:
    """Pulses that begin at their phase, both in 1/phases of a period."""
    duty = _rounded(phases / math.pi * torch.asin(drive.abs().clamp(max=1)))
    return Levels(_phase_level(drive, phases, duty > 0, _pulse_shift(duty, phases)), duty)


def _pulse_drive(levels: Levels, phases: int) -> torch.Tensor:
    phase, duty = levels
    angle = 2 * math.pi / phases * (phase - _pulse_shift(duty, phases))
    return torch.polar(torch.sin(math.pi / phases * duty), angle)


def _pulse_shift(duty: torch.Tensor, phases: int) -> torch.Tensor:
    """By which a pulse begins later than one of half a period, for the same centre."""
    return (phases / 2 - duty.double()) / 2


def _rounded(values: torch.Tensor) -> torch.Tensor:
    return torch.round(values).long()
