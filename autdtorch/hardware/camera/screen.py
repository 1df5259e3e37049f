"""The thin screen in the plane of the foci, which the sound heats."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import number_between, positive

#: Heating of the mesh that `Screen` describes [K/(s Pa^2)], for pictures whose scale is not calibrated.
NOMINAL_HEATING = 1e-6
_IMPEDANCE = 413.0  # of air [Pa s/m]
_CAPACITY = 1.7e6  # of polyester [J/(m^3 K)]
_CONDUCTION = 2.4e-5  # of the screen and the air beside it, along the screen [W/K]; see `Screen`
_TRANSFER = 24.0  # to the air, of both sides [W/(m^2 K)]: radiation 6 and free convection 6 a side


@dataclass(frozen=True)
class Screen:
    """A mesh or film whose temperature T follows dT/dt = D lap T - (T - T0) / tau + a |p|^2.

    Thermal images of a mesh show airborne ultrasound from about 1 kPa (Onishi et al., Phys. Rev. Applied 18,
    2022), and peaks to 2.5 % up to 4.25 kPa (Morgan, Cho & Subramanian, Commun. Eng. 4, 101, 2025). No
    constant of the default is taken from them: they are derived for a polyester mesh of 77 threads of 48 um
    per cm, as follows. `HeatInversion.fitted_screen` fits the first two to frames. A loss time that is wrong
    by a third changes |p| by 4 %, nearly the same in all pictures, a diffusivity by 0.5 %.

    - Heat capacity: 28 um of polyester on average, 47 J/(m^2 K).
    - Loss time: free convection and radiation on both sides, 24 W/(m^2 K), make 2 s.
    - Diffusivity: air conducts k |kappa| from a pattern of wavenumber kappa to each side, which at the
      finest of |p|^2 at 40 kHz (4.3 mm) is as much as D = 7e-7 m^2/s; less at longer ones, so 5e-7.
    - Heating: holes of 80 um in such a mesh resist the flow with 28 Pa s/m (Maa's micro-perforated plate
      at 40 kHz), which absorbs 6 % of the intensity |p|^2 / (2 rho c). That is 1.6e-6 K/(s Pa^2); the threads
      are taken to get two thirds.

    Attributes:
        diffusivity: D along the screen [m^2/s], > 0.
        loss_time: tau, time constant of the loss to the air [s], > 0.
        heating: a, by the square of the peak amplitude [K/(s Pa^2)], > 0; None if it is not calibrated, for
            pictures with an unknown scale, common to all pictures of the screen.

    Raises:
        ValueError: an attribute is not a finite number > 0.
    """

    diffusivity: float = 5e-7
    loss_time: float = 2.0
    heating: float | None = None

    def __post_init__(self) -> None:
        """Check the attributes."""
        for name, unit in (("diffusivity", "m^2/s"), ("loss_time", "s"), ("heating", "K/(s Pa^2)")):
            if (value := getattr(self, name)) is not None or name != "heating":
                object.__setattr__(self, name, positive(f"Screen.{name}", value, unit))

    @classmethod
    def of_thickness(cls, thickness: float, absorbed: float = 0.04) -> Screen:
        """Return a polymer screen in air.

        Args:
            thickness: volume per area [m], > 0; a mesh has less than its threads' diameter.
            absorbed: share of the intensity that heats the screen, > 0 and up to 1.

        Raises:
            ValueError: an argument is out of range.
        """
        capacity = _CAPACITY * positive("thickness", thickness, "m")
        share = number_between("absorbed", positive("absorbed", absorbed), 0.0, 1.0)
        return cls(_CONDUCTION / capacity, capacity / _TRANSFER, share / (2 * _IMPEDANCE * capacity))

    def calibrated(self, pictured: float, measured: float) -> Screen:
        """Return the screen with the heating at which a pressure in a picture becomes a measured one.

        Args:
            pictured: magnitude at a place of a picture taken with this screen [Pa], > 0.
            measured: magnitude there, by a microphone for example [Pa], > 0.

        Raises:
            ValueError: an argument is not a finite number > 0.
        """
        ratio = positive("pictured", pictured, "Pa") / positive("measured", measured, "Pa")
        return replace(self, heating=self.rate * ratio**2)

    @property
    def rate(self) -> float:
        """The heating [K/(s Pa^2)]; a nominal value if it is not calibrated."""
        return NOMINAL_HEATING if self.heating is None else self.heating


def decay_of(screen: Screen, wavenumber: Array) -> Array:
    """Return the rate [1/s] at which patterns of wavenumbers [rad/m] decay."""
    return screen.diffusivity * wavenumber**2 + 1 / screen.loss_time


def rise_of(screen: Screen, decay: Array, times: Array, duration: float) -> Array:
    """Return the temperature (..., T) by |p|^2 [K/Pa^2] of patterns that decay at rates (..., 1) [1/s].

    The sound begins at time 0 [s] and lasts for a duration [s].
    """
    end = np.clip(times, 0.0, duration)
    return screen.rate * -np.expm1(-decay * end) / decay * np.exp(-decay * np.maximum(times - end, 0.0))
