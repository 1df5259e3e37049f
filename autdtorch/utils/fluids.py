"""Checks of fluids and surfaces, with and without absorption; the time factor is e^(-i w t)."""

from __future__ import annotations

from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import complex_number, invalid, number_between, positive

_DENSITIES = 1e-9, 1e9  # [kg/m^3]; far beyond all materials, and squares of their ratios do not overflow
_SOUND_SPEEDS = 1e-3, 1e6  # [m/s]
_IN_GRAMS, _DENSE_SPEEDS = (0.5, 23.0), (1100.0, 15e3)
"""Densities [g/cm^3] and sound speeds [m/s] of liquids and solids. Foam and gases have others, except
compressed hydrogen."""
_ROUNDING = 1e-12  # relative rounding of a bulk modulus, in its imaginary part


def fluid(kind: str, density: object, sound_speed: object) -> tuple[float, float]:
    """Return density [kg/m^3] and sound speed [m/s] of a fluid, checked as fields of `kind`."""
    rho = positive(f"{kind}.density", density, "kg/m^3")
    c = positive(f"{kind}.sound_speed", sound_speed, "m/s")
    return (
        number_between(f"{kind}.density", rho, *_DENSITIES, "kg/m^3"),
        number_between(f"{kind}.sound_speed", c, *_SOUND_SPEEDS, "m/s"),
    )


def warn_if_in_grams(kind: str, density: float, sound_speed: float) -> None:
    """Warn of a density [kg/m^3] that seems to be in g/cm^3, by the sound speed [m/s]."""
    if _IN_GRAMS[0] <= density <= _IN_GRAMS[1] and _DENSE_SPEEDS[0] <= sound_speed <= _DENSE_SPEEDS[1]:
        odd = f"{kind}.density: {density:g} kg/m^3 at {sound_speed:g} m/s, as of no solid or liquid"
        warn_user(f"{odd}; is it in kg/m^3, 1 g/cm^3 as 1000?")


def equivalent_fluid(kind: str, density: object, sound_speed: object) -> tuple[complex, complex]:
    """Return density and sound speed of a fluid that may absorb, checked as fields of `kind`; see `fluid`."""
    rho = complex_number(f"{kind}.density", density, "kg/m^3")
    c = complex_number(f"{kind}.sound_speed", sound_speed, "m/s")
    fluid(kind, rho.real, c.real)
    require_passive(f"{kind}.density", rho, f"{kind}.sound_speed", c)
    return rho, c


def fluid_ratios(density_ratio: object, speed_ratio: object) -> tuple[complex, complex]:
    """Return checked ratios of densities and sound speeds, of a fluid that may absorb over a medium."""
    density = complex_number("density_ratio", density_ratio)
    speed = complex_number("speed_ratio", speed_ratio)
    positive("density_ratio", density.real)
    positive("speed_ratio", speed.real)
    require_passive("density_ratio", density, "speed_ratio", speed)
    return density, speed


def require_passive(density_field: str, density: complex, speed_field: str, speed: complex) -> None:
    """Check that a fluid of a density and sound speed, or their ratios to a medium, adds no energy."""
    conjugate = "with the time factor e^(-i w t); take the conjugate of values for e^(+i w t)"
    if density.imag < 0:
        raise invalid(density_field, density, f"must have an imaginary part >= 0, {conjugate}")
    if speed.imag > 0:
        raise invalid(speed_field, speed, f"must have an imaginary part <= 0, {conjugate}")
    modulus = density * speed**2
    if modulus.real <= 0 or modulus.imag > _ROUNDING * abs(modulus):
        accepted = (
            "must give the bulk modulus, density * speed**2, a real part > 0 and an imaginary part <= 0"
        )
        raise invalid(speed_field, speed, f"{accepted}; it is {modulus:.4g}")


def passive_impedance(name: str, value: object) -> complex:
    """Return the impedance of a surface that adds no energy, and has a pressure."""
    impedance = complex_number(name, value)
    if impedance.real < 0:
        raise invalid(name, value, "must have a real part >= 0: a negative one adds energy")
    if impedance == 0:
        raise invalid(name, value, "must not be 0, of a surface without pressure")
    return impedance
