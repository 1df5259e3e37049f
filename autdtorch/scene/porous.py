"""Foam, felt and fabric as an equivalent fluid."""

from __future__ import annotations

import math

from autdtorch.scene.medium import Medium
from autdtorch.utils.hints import suggesting
from autdtorch.utils.validation import invalid, positive, require_kind

_RANGE = 0.01, 1.0  # of the frequency [Hz] over the flow resistivity [Pa s/m^2], for which it is measured


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
    least, most = _RANGE
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
