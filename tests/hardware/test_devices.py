"""Devices: levels and frames against hand-worked numbers, and against the emulated firmware."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch import hardware as hw
from autdtorch.scene.drive import drive_from_phases, focus_phases

#: Each device, on two boards if it has several, and the number of values of each of its integer levels.
CASES = {
    "autd3": (hw.AUTD3.with_boards(2), (256, 256)),
    "openmpd": (hw.OPENMPD, (128, 65)),
    "sonicsurface": (hw.SONICSURFACE, (33,)),
    "ultraino": (hw.ULTRAINO.with_boards(2), (10, 6)),
}
assert CASES.keys() == hw.DEVICES.keys()
every_device = pytest.mark.parametrize(("device", "counts"), CASES.values(), ids=CASES)
seeds = st.integers(0, 2**32 - 1)


def one_on(transducer: int, phase: float, amplitude: float, count: int = 256) -> torch.Tensor:
    """A drive (count,) of one transducer."""
    drive = torch.zeros(count, dtype=torch.complex128)
    drive[transducer] = drive_from_phases([phase], [amplitude])[0]
    return drive


def on_the_wire(device: hw.Device, drive: torch.Tensor) -> bytes:
    """The bytes that the firmware behind the emulated USB chip receives when a link plays the drive."""
    bench = hw.EmulatedBench(device, torch.ones(1, device.transducers, dtype=torch.complex128))
    received = bytearray()
    with hw.open_link(device, backend=bench.bus) as link, pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.firmware, "receive", received.extend)
        link.play(drive)
    return bytes(received)


# Phase phi [rad] and amplitude of one transducer, then place and value of its byte. The byte is
# round(-32 phi / 2 pi) mod 32, at 1 + the channel that SonicSurface's table gives.
SONICSURFACE_EXAMPLES = [
    (0, 0.0, 1.0, 1, 0),
    (0, math.pi / 2, 1.0, 1, 24),  # a quarter of a period early is three quarters late
    (1, -math.pi / 2, 1.0, 8, 8),
    (2, math.pi, 1.0, 2, 16),
    (3, 2 * math.pi / 32, 1.0, 3, 31),
    (4, -0.51 * 2 * math.pi / 32, 1.0, 65, 1),  # rounded up, where truncation gives 0
    (16, -0.49 * 2 * math.pi / 32, 1.0, 5, 0),  # second row
    (32, 0.49 * 2 * math.pi / 32, 1.0, 9, 0),  # -0.49 rounds to 0, not to 31
    (255, -31.4 * 2 * math.pi / 32, 1.0, 254, 31),
    (240, -31.6 * 2 * math.pi / 32, 1.0, 61, 0),  # rounds to 32, which is 0 and not off
    (17, 1.0, 0.49, 4, 32),  # off
]

# Phase byte round(-128 phi / 2 pi + (64 - duty) / 2) mod 128, duty 128 asin(a) / pi.
OPENMPD_EXAMPLES = [
    (0, 0.0, 1.0, 0 + 128, 64),  # the first byte carries bit 7
    (0, math.pi / 2, 1.0, 96 + 128, 64),
    (1, -math.pi / 2, 1.0, 32, 64),
    (2, math.pi, 1.0, 64, 64),
    (3, 2 * math.pi / 128, 1.0, 127, 64),
    (4, -0.51 * 2 * math.pi / 128, 1.0, 1, 64),
    (5, 0.0, math.sin(math.pi / 4), 16, 32),  # half the duty starts an eighth of a period late
    (6, -2 * math.pi / 512, 0.5, 22, 21),  # duty 21.3, so that 0.25 + 21.5 rounds up
    (7, 0.0, 0.5, 22, 21),  # 21.5 rounds to even
    (254, -math.pi, math.sin(math.pi / 8), 64 + 24, 16),
    (255, 0.1, 0.0, 0, 0),  # off
]

TENTH = 2 * math.pi / 10
# Port and bit by the wiring, and the tenths of a period that the pin is high: from round(-phi / (2 pi / 10)
# + (5 - duty) / 2) mod 10 on, for a duty of 10 asin(a) / pi.
ULTRAINO_EXAMPLES = [
    (0, 0.0, 1.0, 6, 3, [0, 1, 2, 3, 4]),  # pin 6 of the Arduino, PH3
    (22, 3 * TENTH, 1.0, 9, 0, [7, 8, 9, 0, 1]),  # three tenths early is seven late
    (23, -TENTH, 1.0, 8, 5, [1, 2, 3, 4, 5]),
    (35, math.pi, 1.0, 7, 7, [5, 6, 7, 8, 9]),
    (63, -0.51 * TENTH, 1.0, 0, 0, [1, 2, 3, 4, 5]),  # rounded up
    (34, 0.49 * TENTH, 1.0, 8, 1, [0, 1, 2, 3, 4]),  # -0.49 rounds to 0, not to 9
    (8, -9.6 * TENTH, 1.0, 5, 7, [0, 1, 2, 3, 4]),  # 9.6 rounds to 10, which is 0
    (32, 0.0, math.sin(0.3 * math.pi), 2, 5, [1, 2, 3]),  # a shorter pulse about the same centre
    (4, -2.2 * TENTH, math.sin(0.1 * math.pi), 3, 4, [4]),  # 2.2 + 2
    (16, -0.2 * TENTH, math.sin(0.2 * math.pi), 7, 0, [2, 3]),  # 0.2 + 1.5 rounds to 2
    (48, 1.0, 0.1, 3, 0, []),  # duty 0.3 is off
    (74, 0.0, 1.0, 5, 5, [0, 1, 2, 3, 4]),  # the eleventh of the second board
]


@pytest.mark.parametrize(("transducer", "phase", "amplitude", "place", "byte"), SONICSURFACE_EXAMPLES)
def test_sonicsurface_bytes(transducer: int, phase: float, amplitude: float, place: int, byte: int) -> None:
    expected = bytearray([254, *[32] * 256, 253])
    expected[place] = byte
    assert on_the_wire(hw.SONICSURFACE, one_on(transducer, phase, amplitude)) == expected


@pytest.mark.parametrize(("transducer", "phase", "amplitude", "byte", "duty"), OPENMPD_EXAMPLES)
def test_openmpd_bytes(transducer: int, phase: float, amplitude: float, byte: int, duty: int) -> None:
    expected = bytearray(512)
    expected[0] = 128
    expected[transducer], expected[256 + transducer] = byte, duty
    assert on_the_wire(hw.OPENMPD, one_on(transducer, phase, amplitude)) == expected


@pytest.mark.parametrize(("transducer", "phase", "amplitude", "port", "bit", "tenths"), ULTRAINO_EXAMPLES)
def test_ultraino_bytes(
    transducer: int, phase: float, amplitude: float, port: int, bit: int, tenths: list[int]
) -> None:
    expected = bytearray([*[0x01] * 200, *[0x02] * 200])
    for tenth in tenths:
        upper_half_first = 0 if bit >= 4 else 1
        expected[200 * (transducer // 64) + 2 * (10 * tenth + port) + upper_half_first] |= 1 << 4 + bit % 4
    expected += bytes.fromhex("30303070 30303030 10 00")  # 1 period, 0 to end, commit, switch
    assert on_the_wire(hw.ULTRAINO.with_boards(2), one_on(transducer, phase, amplitude, 128)) == expected


def test_an_autd3_frame_is_all_phases_then_all_intensities() -> None:
    frame = hw.AUTD3.with_boards(2).frame(one_on(250, -math.pi / 2, 0.5, 498))
    assert (frame[250], frame[498 + 250], sum(frame)) == (64, 128, 64 + 128)


@every_device
@settings(max_examples=15)
@given(seed=seeds)
def test_the_firmware_plays_the_levels_of_a_frame(
    device: hw.Device, counts: tuple[int, ...], seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    levels = [torch.randint(count, (device.transducers,), generator=generator) for count in counts]
    frame = device.pack(*levels)
    firmware = device.firmware(device.transducers)
    # As a chip may pass it on, in two pieces; without bit 7 no message of OpenMPD begins.
    cut = 0 if device.name == "AUTD3" else seed % (len(frame) + 1)
    for piece in ([bytes(7)] if device is hw.OPENMPD else []) + [frame[:cut]] * (cut > 0) + [frame[cut:]]:
        firmware.receive(piece)
    # Sums of up to five exponentials, and rounding of angles up to 2 pi.
    torch.testing.assert_close(firmware.drive(), device.drive(*levels), rtol=0, atol=1e-14)
    again = device.levels(device.drive(*levels))
    on = levels[-1] > 0 if len(levels) == 2 else torch.ones(device.transducers, dtype=torch.bool)
    assert all(torch.equal(one[on], other[on]) for one, other in zip(again, levels, strict=True))
    assert not device.quantised(torch.zeros(device.transducers).cdouble()).any()


@every_device
def test_a_focus_takes_minus_kd(device: hw.Device, counts: tuple[int, ...]) -> None:
    positions = torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.125e-3, 0.0]], dtype=torch.float64)
    # The second transducer is a quarter of a wavelength nearer: the device's phase is a quarter ahead.
    level = device.levels(drive_from_phases(focus_phases(positions, (0, 0.1, 0), 2 * math.pi / 8.5e-3)))[0]
    phases = device.phase_levels.phases
    assert (level[1] - level[0]) % phases in (phases // 4, -(-phases // 4))


def test_ultraino_starts_with_all_transducers_on_and_another_duration_would_play_old_patterns() -> None:
    firmware = hw.ULTRAINO.firmware(64)
    torch.testing.assert_close(firmware.drive(), torch.ones(64).cdouble(), rtol=0, atol=1e-14)
    firmware.receive(bytes.fromhex("30303070 303030f0 30303030 10"))  # 1 period, then 3 of the second pattern
    torch.testing.assert_close(firmware.drive(), torch.ones(64).cdouble() / 4, rtol=0, atol=1e-14)


def test_a_lone_commit_of_the_sonicsurface_brings_the_last_pattern_back() -> None:
    first, second = torch.arange(256) % 33, torch.arange(256) % 32
    firmware = hw.SONICSURFACE.firmware(256)
    firmware.receive(hw.SONICSURFACE.pack(first) + hw.SONICSURFACE.pack(second) + b"\xfd")
    torch.testing.assert_close(firmware.drive(), hw.SONICSURFACE.drive(first), rtol=0, atol=1e-14)


def test_amplitudes_rounded_up_to_full_are_accepted_and_more_is_not() -> None:
    assert hw.OPENMPD.levels([1 + 5e-7 + 0j])[1].item() == 64
    with pytest.raises(ValueError, match=r"drive: amplitude 1.1"):
        hw.AUTD3.levels([1.1 + 0j])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hw.AUTD3.drive([256], [0]), r"AUTD3 phase: \(256,\); .* 0 to 255"),
        (lambda: hw.OPENMPD.drive([0], [65]), r"OpenMPD duty: \(65,\); .* 0 to 64"),
        (lambda: hw.OPENMPD.drive([0, 1], [64]), r"OpenMPD duty: shape \(1,\); must be \(2,\)"),
        (lambda: hw.SONICSURFACE.drive([33]), r"SonicSurface phase: \(33,\); must be integers from 0 to 32"),
        (lambda: hw.SONICSURFACE.drive(np.array([0.5])), r"must be integers"),
        (lambda: hw.SONICSURFACE.with_boards(2), "boards: 2; must be"),
        (lambda: hw.ULTRAINO.with_boards(15), "boards: 15; must be"),
        (lambda: hw.AUTD3.with_boards(0), "boards: 0; must be"),
        *(
            (lambda name=name: hw.open_link(name), rf"'{name}'; must be a Device, such as hardware\.{device}")
            for name, device in {
                "autd3": "AUTD3",
                "autd33": "AUTD3",
                "OpenMDP": "OPENMPD",
                "x": "SONICS",
            }.items()
        ),
    ],
)
def test_levels_boards_and_devices_that_there_are_not_are_refused(call, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "did you mean" not in str(caught.value)  # the nearest device is named once
