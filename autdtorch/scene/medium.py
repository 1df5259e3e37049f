"""The medium around the obstacles: a uniform fluid, such as humid air; and porous material that it fills.

Air is an ideal gas of dry air and water vapour. Absorption and vapour pressure follow ISO 9613-1:1993, whose
equations are also those of ANSI S1.26 and of Bass et al., J. Acoust. Soc. Am. 97 (1995) 680-683.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from autdtorch.utils.fluids import fluid, warn_if_in_grams
from autdtorch.utils.hints import suggesting
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import invalid, not_negative, number_between, positive, require_kind

_TEMPERATURES = -20.0, 50.0  # deg C; range of ISO 9613-1
_PRESSURES = 50e3, 200e3  # Pa; from half an atmosphere to the limit of ISO 9613-1
_FREQUENCIES_BY_PRESSURE = 4e-4, 10.0  # Hz/Pa; range of ISO 9613-1

_USUAL_SPEEDS = 20.0, 15e3  # m/s; bubbly water is slowest, and diamond faster than any fluid

ZERO_CELSIUS = 273.15  # K
_REFERENCE_TEMPERATURE = 293.15  # K
_REFERENCE_PRESSURE = 101325.0  # Pa
_TRIPLE_POINT = 273.16  # K
_GAS_CONSTANT = 8.314462618  # J/(mol K)
_DRY_AIR, _WATER = 28.9647e-3, 18.01528e-3  # kg/mol
_DIATOMIC = 1.4  # ratio of specific heats of dry air
_POROUS = 0.01, 1.0  # of the frequency [Hz] over a flow resistivity [Pa s/m^2], for which it is measured


@dataclass(frozen=True)
class Medium:
    """A uniform fluid.

    Attributes:
        density: [kg/m^3], 1e-9 to 1e9.
        sound_speed: [m/s], 1e-3 to 1e6.
        absorption: of a plane wave at the drive frequency [dB/m], >= 0.
        absorption_frequency: [Hz] for which `air` computed the absorption, None if it was set by hand. A
            scene of another frequency warns; results do not depend on it. It does not count in comparisons,
            and neither `dataclasses.replace` nor `save_scene` keeps it.

    Raises:
        ValueError: an attribute is not finite or out of range.

    Warns:
        ScaleWarning: a sound speed that no fluid has.
    """

    density: float
    sound_speed: float
    absorption: float = 0.0
    absorption_frequency: float | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        density, sound_speed = fluid("Medium", self.density, self.sound_speed)
        warn_if_in_grams("Medium", density, sound_speed)
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "sound_speed", sound_speed)
        object.__setattr__(self, "absorption", not_negative("Medium.absorption", self.absorption, "dB/m"))
        least, most = _USUAL_SPEEDS
        if sound_speed > most or sound_speed < least <= density:  # 1 and 1 are of a problem without units
            odd = f"Medium.sound_speed: {sound_speed:g} m/s, as of no fluid; it comes after the density"
            warn_user(f"{odd}, which is {density:g} kg/m^3: are they swapped, or in other units?")

    @classmethod
    @suggesting
    def air(
        cls,
        temperature: float = 20.0,
        relative_humidity: float = 50.0,
        pressure: float = 101325.0,
        frequency: float = 40e3,
    ) -> Medium:
        """Return humid air: an ideal gas of dry air and vapour, with absorption by ISO 9613-1:1993.

        Args:
            temperature: [deg C], -20 to 50.
            relative_humidity: [%], 0 to 100; 50, not 0.5, is half of saturation.
            pressure: ambient [Pa], 50e3 to 200e3.
            frequency: drive frequency, for the absorption [Hz]; 4e-4 to 10 times the pressure in Pa.

        Raises:
            ValueError: an argument is not a number in its range.

        Warns:
            ScaleWarning: the humidity seems to be a share of 1.
        """
        density, sound_speed = _density_and_sound_speed(temperature, relative_humidity, pressure)
        absorption = _absorption_of_air(temperature, relative_humidity, pressure, frequency)
        if 0 < relative_humidity <= 1:
            dry = f"relative_humidity: {relative_humidity:g} %, drier than any room"
            warn_user(
                f"{dry}; a share of {relative_humidity:g} is relative_humidity={100 * relative_humidity:g}"
            )
        medium = cls(density, sound_speed, absorption)
        # No argument of Medium: the frequency of an absorption set by hand, or replaced, is not known.
        object.__setattr__(medium, "absorption_frequency", float(frequency))
        return medium

    @property
    def is_air(self) -> bool:
        """True if dry air in the range of `air` has this density and sound speed."""
        least, most = _TEMPERATURES
        lowest, highest = _PRESSURES
        pressure = self.density * self.sound_speed**2 / _DIATOMIC
        return least <= self.temperature <= most and lowest <= pressure <= highest

    @property
    def temperature(self) -> float:
        """Temperature [deg C] at which dry air has its sound speed."""
        return self.sound_speed**2 * _DRY_AIR / (_DIATOMIC * _GAS_CONSTANT) - ZERO_CELSIUS

    def warmed(self, kelvin: float) -> Medium:
        """Return air after a rise of its temperature [K] at its pressure, by the law of ideal gases.

        Vapour and absorption stay. At a constant relative humidity of 50 %, the sound speed would rise by 8 %
        more.

        Raises:
            ValueError: the medium is no air, or would leave the range of temperatures of `air`.
        """
        if not self.is_air:
            fluid = f"{self.density:.4g} kg/m^3, {self.sound_speed:.4g} m/s"
            raise invalid("medium", fluid, "must be air: of others the change with temperature is not known")
        least, most = (limit - self.temperature for limit in _TEMPERATURES)
        rise = number_between("kelvin", kelvin, least, most, "K")
        ratio = 1 + rise / (self.temperature + ZERO_CELSIUS)
        return replace(self, density=self.density / ratio, sound_speed=self.sound_speed * math.sqrt(ratio))


def vapour_fraction(temperature: float, relative_humidity: float, pressure: float) -> float:
    """Return the molar fraction of water vapour in air (ISO 9613-1, Eqs. B.1 to B.3); see `Medium.air`."""
    celsius = number_between("temperature", temperature, *_TEMPERATURES, "deg C")
    humidity = number_between("relative_humidity", relative_humidity, 0.0, 100.0, "%")
    pressure = number_between("pressure", pressure, *_PRESSURES, "Pa")
    exponent = 4.6151 - 6.8346 * (_TRIPLE_POINT / (celsius + ZERO_CELSIUS)) ** 1.261
    return humidity / 100 * math.pow(10, exponent) * _REFERENCE_PRESSURE / pressure


def _density_and_sound_speed(
    temperature: float, relative_humidity: float, pressure: float
) -> tuple[float, float]:
    """Return the density [kg/m^3] and sound speed [m/s] of humid air as an ideal gas; see `Medium.air`.

    Air molecules have 5 degrees of freedom and water molecules 6, so that c^2 = (7 + x)/(5 + x) R T / M with
    the vapour fraction x (Bohn, J. Audio Eng. Soc. 36 (1988) 223-231). Between 0 and 30 deg C the result is
    within 0.05 % of the real-gas formula of Cramer (J. Acoust. Soc. Am. 93 (1993) 2510-2516), which is
    accurate to 0.03 %.
    """
    x = vapour_fraction(temperature, relative_humidity, pressure)
    thermal = _GAS_CONSTANT * (temperature + ZERO_CELSIUS) / ((1 - x) * _DRY_AIR + x * _WATER)
    return pressure / thermal, math.sqrt((7 + x) / (5 + x) * thermal)


def _absorption_of_air(
    temperature: float, relative_humidity: float, pressure: float, frequency: float
) -> float:
    """Return the absorption of a pure tone [dB/m] by ISO 9613-1:1993, Eqs. 3 to 5; see `Medium.air`.

    The standard states an accuracy of 10 % for vapour fractions of 0.05 to 5 %, of 20 % down to 0.005 %, and
    of 50 % in drier air.
    """
    percent = 100 * vapour_fraction(temperature, relative_humidity, pressure)
    least, most = (limit * pressure for limit in _FREQUENCIES_BY_PRESSURE)
    frequency = number_between("frequency", frequency, least, most, "Hz")
    kelvin = temperature + ZERO_CELSIUS
    warmth, atmospheres = kelvin / _REFERENCE_TEMPERATURE, pressure / _REFERENCE_PRESSURE
    oxygen = atmospheres * (24 + 4.04e4 * percent * (0.02 + percent) / (0.391 + percent))
    slowing = math.exp(-4.170 * (math.pow(warmth, -1 / 3) - 1))
    nitrogen = atmospheres / math.sqrt(warmth) * (9 + 280 * percent * slowing)
    classical = 1.84e-11 / atmospheres * math.sqrt(warmth)
    relaxing = 0.01275 * math.exp(-2239.1 / kelvin) / (oxygen + frequency**2 / oxygen)
    relaxing += 0.1068 * math.exp(-3352.0 / kelvin) / (nitrogen + frequency**2 / nitrogen)
    return 8.686 * frequency**2 * (classical + math.pow(warmth, -2.5) * relaxing)


@suggesting
def porous(
    flow_resistivity: float, frequency: float = 40e3, medium: Medium | None = None
) -> dict[str, complex]:
    """Return density and sound speed of a porous material with a rigid frame, such as foam, felt or fabric.

    They are the material of an obstacle at one frequency::

        pad = at.Box((0, 0, 0.1), (0.05, 0.05, 0.01), **at.porous(200e3))

    For fibrous materials of a porosity near 1. Source: Delany and Bazley (1970), Applied Acoustics 3, 105, in
    the form of Miki (1990), J. Acoust. Soc. Jpn. (E) 11, 19, which is passive at all frequencies.

    Args:
        flow_resistivity: static [Pa s/m^2], 1 to 100 times the frequency in Hz: 40e3 to 4e6 at 40 kHz.
        frequency: drive frequency [Hz]; in a scene file, the scene's.
        medium: in the pores; air by default, and in a scene file the medium of the scene.

    Returns:
        Complex `density` [kg/m^3] and `sound_speed` [m/s] by name.

    Raises:
        ValueError: an argument out of range.
    """
    frequency = positive("frequency", frequency, "Hz")
    medium = Medium.air(frequency=frequency) if medium is None else medium
    require_kind("medium", medium, Medium)
    resistivity = positive("flow_resistivity", flow_resistivity, "Pa s/m^2")
    least, most = _POROUS
    ratio = frequency / resistivity
    if not least <= ratio <= most:
        accepted = f"must be in {frequency / most:g} to {frequency / least:g} at {frequency:g} Hz"
        fix = "beyond, give measured complex density and sound_speed, or an impedance"
        raise invalid("flow_resistivity", flow_resistivity, f"{accepted}; {fix}", "Pa s/m^2")
    impedance = 1 + (0.070 + 0.107j) * math.pow(ratio, -0.632)  # over density times sound speed of the medium
    wavenumber = 1 + (0.109 + 0.160j) * math.pow(ratio, -0.618)  # relative to the medium
    return {
        "density": medium.density * impedance * wavenumber,
        "sound_speed": medium.sound_speed / wavenumber,
    }
