import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from autdtorch.hardware.devices import levels as device
from autdtorch.hardware.devices.levels import Levels
from autdtorch.scene.drive import drive_from_phases, focus_phases

DEVICES = {
    "autd3": (device.autd3_levels, device.autd3_drive, 256, 255),
    "openmpd": (device.openmpd_levels, device.openmpd_drive, 128, 64),
    "ultraino": (device.ultraino_levels, device.ultraino_drive, 10, 5),
}


def integers(most, least=0):
    return st.lists(st.integers(least, most), min_size=5, max_size=5).map(torch.tensor)


@pytest.mark.parametrize("name", DEVICES)
@given(data=st.data())
def test_levels_come_back_from_the_drive_they_play(name, data):
    to_levels, to_drive, phases, full = DEVICES[name]
    played = Levels(data.draw(integers(phases - 1)), data.draw(integers(full, least=1)))

    again = to_levels(to_drive(played))

    assert torch.equal(again.phase, played.phase)
    assert torch.equal(again.amplitude, played.amplitude)


@given(integers(device.SONICSURFACE_OFF))
def test_sonicsurface_levels_come_back_with_those_that_are_off(played):
    assert torch.equal(device.sonicsurface_levels(device.sonicsurface_drive(played)), played)


@pytest.mark.parametrize("name", DEVICES)
@given(phase=st.floats(-20, 20), amplitude=st.floats(0.2, 1))
def test_rounding_moves_phase_and_amplitude_by_at_most_half_a_level(name, phase, amplitude):
    to_levels, to_drive, phases, _ = DEVICES[name]
    drive = drive_from_phases([phase], [amplitude])

    played = to_drive(to_levels(drive))

    # 1e-9 is rounding. The steepest step of AUTD3's amplitude is 1/255, of a pulse's pi/phases.
    step = 1 / 255 if name == "autd3" else math.pi / phases
    assert abs(float((played / drive).angle())) <= math.pi / phases + 1e-9
    assert abs(float(played.abs() - amplitude)) <= step / 2 + 1e-9


@given(phase=st.floats(-20, 20), amplitude=st.floats(0, 1))
def test_sonicsurface_is_full_or_off(phase, amplitude):
    drive = drive_from_phases([phase], [amplitude])

    played = device.sonicsurface_drive(device.sonicsurface_levels(drive))

    if amplitude < 0.5:
        assert played.item() == 0
    else:
        assert played.abs().item() == pytest.approx(1, abs=1e-12)
        assert abs(float((played / drive).angle())) <= math.pi / 32 + 1e-9


def test_a_focus_takes_minus_kd_on_every_device():
    positions = torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.125e-3, 0.0]], dtype=torch.float64)
    # The second transducer is a quarter of a wavelength nearer: the device's phase is a quarter ahead.
    drive = drive_from_phases(focus_phases(positions, (0, 0.1, 0), 2 * math.pi / 8.5e-3))

    for levels, phases in (
        (device.autd3_levels(drive).phase, 256),
        (device.openmpd_levels(drive).phase, 128),
        (device.sonicsurface_levels(drive), 32),
        (device.ultraino_levels(drive).phase, 10),
    ):
        assert (levels[1] - levels[0]) % phases in (phases // 4, -(-phases // 4))


def test_full_amplitude_has_the_duty_of_one_half_and_no_shift():
    full = device.openmpd_levels([1 + 0j, 1j])
    half = device.openmpd_levels([0.5 + 0j])

    assert full.amplitude.tolist() == [64, 64]
    assert full.phase.tolist() == [0, 32]
    # asin(1/2) / pi = 1/6 of 128 is 21.3, and (64 - 21) / 2 rounds to 22 (half to even).
    assert (half.amplitude.item(), half.phase.item()) == (21, 22)


def test_amplitudes_rounded_up_to_full_are_accepted_and_more_is_not():
    assert device.openmpd_levels([1 + 5e-7 + 0j]).amplitude.item() == 64
    with pytest.raises(ValueError, match=r"drive: amplitude 1.1"):
        device.autd3_levels([1.1 + 0j])


@pytest.mark.parametrize(
    ("to_drive", "levels", "message"),
    [
        (
            device.autd3_drive,
            Levels([256], [0]),
            r"AUTD3 levels.phase: \(256,\); .* 0 to 255",
        ),
        (device.openmpd_drive, Levels([0], [65]), r"OpenMPD levels.amplitude: \(65,\); .* 0 to 64"),
        (device.openmpd_drive, Levels([0, 1], [64]), r"phase of shape \(2,\)"),
        (device.sonicsurface_drive, [33], r"SonicSurface levels: \(33,\); must be integers from 0 to 32"),
        (device.sonicsurface_drive, np.array([0.5]), r"must be integers"),
    ],
)
def test_levels_out_of_range_are_refused(to_drive, levels, message):
    with pytest.raises(ValueError, match=message):
        to_drive(levels)
