"""The medium around the obstacles: a uniform fluid, such as humid air."""

from __future__ import annotations

from dataclasses import dataclass

from autdtorch.scene import air
from autdtorch.utils.validation import fluid, not_negative


@dataclass(frozen=True)
class Medium:
    """A uniform fluid.

    Attributes:
        density: [kg/m^3], 1e-9 to 1e9.
        sound_speed: [m/s], 1e-3 to 1e6.
        absorption: of a plane wave at the drive frequency [dB/m], >= 0.

    Raises:
        ValueError: an attribute is not finite or out of range.
    """

    density: float
    sound_speed: float
    absorption: float = 0.0

    def __post_init__(self) -> None:
        """Check the attributes."""
        density, sound_speed = fluid("Medium", self.density, self.sound_speed)
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "sound_speed", sound_speed)
        object.__setattr__(self, "absorption", not_negative("Medium.absorption", self.absorption, "dB/m"))

    @classmethod
    def air(
        cls,
        temperature: float = 20.0,
        relative_humidity: float = 50.0,
        pressure: float = 101325.0,
        frequency: float = 40e3,
    ) -> Medium:
        """Return humid air: an ideal gas with absorption by ISO 9613-1:1993; see `autdtorch.scene.air`.

        Args:
            temperature: [deg C], -20 to 50.
            relative_humidity: [%], 0 to 100.
            pressure: ambient [Pa], 50e3 to 200e3.
            frequency: drive frequency, for the absorption [Hz]; 4e-4 to 10 times the pressure in Pa.

        Raises:
            ValueError: an argument is not a number in its range.
        """
        density, sound_speed = air.density_and_sound_speed(temperature, relative_humidity, pressure)
        absorption = air.absorption(temperature, relative_humidity, pressure, frequency)
        return cls(density, sound_speed, absorption)
