"""The contents of a scene, and the waves in its medium, as checks and solvers read them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import Plane
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.reflectors import Reflector
from autdtorch.utils.units import DECIBELS
from autdtorch.utils.validation import Vector


@dataclass(frozen=True, eq=False, init=False, repr=False)
class SceneContents:
    """The contents of a scene; `Scene` checks them, and describes the attributes."""

    array: TransducerArray
    medium: Medium
    frequency: float
    control_points: torch.Tensor
    obstacles: tuple[Obstacle, ...]
    observation_plane: Plane | None
    domain: tuple[Vector, Vector]
    name: str
    reflectors: tuple[Reflector, ...]

    @property
    def angular_frequency(self) -> float:
        """Angular frequency of the drive, 2 pi f [rad/s]."""
        return 2 * math.pi * self.frequency

    @property
    def wavenumber(self) -> float:
        """Wavenumber in the medium, k = 2 pi f / c [rad/m]."""
        return self.angular_frequency / self.medium.sound_speed

    @property
    def attenuation(self) -> float:
        """Attenuation in the medium, alpha [Np/m]: a plane wave decays as e^{-alpha x}."""
        return self.medium.absorption / DECIBELS

    @property
    def complex_wavenumber(self) -> complex:
        """Complex wavenumber in the medium, k + i alpha [rad/m]: a plane wave is e^{i (k + i alpha) x}."""
        return complex(self.wavenumber, self.attenuation)

    @property
    def wavelength(self) -> float:
        """Wavelength in the medium, c / f [m]."""
        return self.medium.sound_speed / self.frequency
