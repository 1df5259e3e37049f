"""The boundary layer against a larger domain, in the time-stepped field of a point source."""

from __future__ import annotations

import numpy as np
from checks.boundary import measured_reflection

from autdtorch.fdtd.grid import FINE_LAYER_CELLS


def test_echo_of_a_layer() -> None:
    # required: -70 dB from 0 to 60 degrees and -45 dB at 75, in at most 10 cells at 8.5 cells per wavelength;
    # the other layers are a wavelength off, so that the grid's edges and corners are in it
    angles, echo = measured_reflection(8.5, FINE_LAYER_CELLS, np.array((0.0, 30.0, 60.0, 75.0)), 5, aside=9)
    assert np.allclose(angles, (0, 30, 60, 75), atol=2)  # as whole cells allow
    decibels = 20 * np.log10(echo)
    assert decibels[:3].max() < -70
    assert decibels[3] < -45
    # and the comparison itself resolves it: the echo is not zero
    assert decibels.min() > -130
