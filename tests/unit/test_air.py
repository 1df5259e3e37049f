"""Air against published tables."""

import math

import pytest

from autdtorch.scene.medium import Medium, vapour_fraction

ATMOSPHERE = 101325.0


def midband(nominal: float) -> float:
    """Exact frequency of a third-octave band: the tables name 7943 Hz 8 kHz."""
    return 10 ** (round(10 * math.log10(nominal)) / 10)


# ISO 9613-1:1993, Table 1 [dB/km], given to three digits
@pytest.mark.parametrize(
    ("temperature", "humidity", "frequency", "tabulated"),
    [
        *((-20, 10, 50, 0.589), (20, 15, 6300, 175), (20, 80, 50, 0.0501)),
        *((20, 80, 1000, 5.15), (20, 80, 10000, 105), (20, 50, 10000, 159)),
    ],
)
def test_absorption_is_that_of_the_table(temperature, humidity, frequency, tabulated):
    computed = 1e3 * Medium.air(temperature, humidity, ATMOSPHERE, midband(frequency)).absorption
    assert computed == pytest.approx(tabulated, rel=5e-3)


# ISO 9613-2:1996, Table 2 [dB/km], octaves from 63 Hz to 8 kHz, given to one digit after the point
@pytest.mark.parametrize(
    ("temperature", "humidity", "tabulated"),
    [
        (10, 70, (0.1, 0.4, 1.0, 1.9, 3.7, 9.7, 32.8, 117)),
        (20, 70, (0.1, 0.3, 1.1, 2.8, 5.0, 9.0, 22.9, 76.6)),
        (15, 20, (0.3, 0.6, 1.2, 2.7, 8.2, 28.2, 88.8, 202)),
    ],
)
def test_absorption_in_octaves(temperature: float, humidity: float, tabulated: tuple[float, ...]) -> None:
    octaves = [midband(1000 * 2**n) for n in range(-4, 4)]
    computed = [1e3 * Medium.air(temperature, humidity, ATMOSPHERE, f).absorption for f in octaves]
    # half a unit of the last digit printed: 0.05 dB/km, from 100 on 0.5 dB/km
    assert computed == pytest.approx(tabulated, abs=0.055, rel=2.5e-3)


def test_far_above_the_relaxations_absorption_is_classical() -> None:
    """What is left rises as f^2/p: viscosity, heat and rotation, 1.84e-11 Np/m per Hz^2 at one atmosphere.

    In dry air the relaxations are over at some 10 Hz: beyond, they add a constant, 1 mdB/m to 40 dB/m here.
    """
    for pressure in (ATMOSPHERE, 2 / 3 * ATMOSPHERE):
        classical = 8.686 * 1.84e-11 * 5e5**2 * ATMOSPHERE / pressure
        relaxing = Medium.air(20, 0, pressure, 5e5).absorption - classical
        assert 0 < relaxing < 1e-4 * classical


def test_density_and_sound_speed() -> None:
    # measured: 331.45 m/s with 0.03 % of CO2 (Cramer 1993), of which a real gas makes 0.13 m/s
    assert Medium.air(0, 0).sound_speed == pytest.approx(331.45, rel=5e-4)
    # ISO 9613-1 and every handbook: 343.2 m/s and 1.204 kg/m^3 at 20 deg C
    dry = Medium.air(20, 0)
    assert (dry.density, dry.sound_speed) == pytest.approx((1.204, 343.2), rel=2e-4)
    # the zero-frequency formula of Cramer 1993, a real gas with 0.04 % of CO2
    for humidity, speed in ((50, 343.987), (0, 343.359)):
        assert Medium.air(20, humidity).sound_speed == pytest.approx(speed, rel=5e-4)


def test_vapour() -> None:
    # saturation pressures of handbooks, which the fit of ISO 9613-1 meets to 0.2 %
    for temperature, saturation in ((0, 611), (20, 2339), (50, 12350)):
        found = ATMOSPHERE * vapour_fraction(temperature, 100, ATMOSPHERE)
        assert found == pytest.approx(saturation, rel=2e-3)


def test_absorption_at_40_khz_is_that_of_data_sheets() -> None:
    assert Medium.air().absorption == pytest.approx(1.3, abs=0.05)
