"""Frames against hand-worked bytes, against their own inverse, and against the firmwares."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.hardware.devices import OPENMPD, SONICSURFACE, Device, ultraino_boards
from autdtorch.hardware.devices.frames import (
    levels_of_openmpd_frame,
    levels_of_sonicsurface_frame,
    levels_of_ultraino_frame,
    openmpd_frame,
    sonicsurface_frame,
    ultraino_frame,
)
from autdtorch.hardware.devices.levels import Levels, openmpd_drive, sonicsurface_drive, ultraino_drive
from autdtorch.hardware.devices.order import sonicsurface_channels, ultraino_pins
from autdtorch.hardware.emulator.bench import EmulatedBench
from autdtorch.hardware.emulator.firmware import OpenMPDFirmware, SonicSurfaceFirmware, UltrainoFirmware
from autdtorch.hardware.link import open_link
from autdtorch.scene.drive import drive_from_phases

seeds = st.integers(0, 2**32 - 1)


def one_on(transducer: int, phase: float, amplitude: float, count: int = 256) -> torch.Tensor:
    """A drive (count,) of one transducer."""
    drive = torch.zeros(count, dtype=torch.complex128)
    drive[transducer] = drive_from_phases([phase], [amplitude])[0]
    return drive


def on_the_wire(device: Device, drive: torch.Tensor) -> bytes:
    """What the firmware behind the emulated USB chip receives when a link plays the drive."""
    bench = EmulatedBench(device, torch.ones(1, device.transducers, dtype=torch.complex128))
    received = bytearray()
    with open_link(device, backend=bench.bus) as link, pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.firmware, "receive", received.extend)
        link.play(drive)
    return bytes(received)


# Phase phi [rad] and amplitude of one transducer, then place and value of its byte. The byte is
# round(-32 phi / 2 pi) mod 32, at 1 + the channel that the SonicSurface's own table gives.
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
    assert on_the_wire(SONICSURFACE, one_on(transducer, phase, amplitude)) == expected


@pytest.mark.parametrize(("transducer", "phase", "amplitude", "byte", "duty"), OPENMPD_EXAMPLES)
def test_openmpd_bytes(transducer: int, phase: float, amplitude: float, byte: int, duty: int) -> None:
    expected = bytearray(512)
    expected[0] = 128
    expected[transducer], expected[256 + transducer] = byte, duty
    assert on_the_wire(OPENMPD, one_on(transducer, phase, amplitude)) == expected


@pytest.mark.parametrize(("transducer", "phase", "amplitude", "port", "bit", "tenths"), ULTRAINO_EXAMPLES)
def test_ultraino_bytes(
    transducer: int, phase: float, amplitude: float, port: int, bit: int, tenths: list[int]
) -> None:
    expected = bytearray([*[0x01] * 200, *[0x02] * 200])
    for tenth in tenths:
        upper_half_first = 0 if bit >= 4 else 1
        expected[200 * (transducer // 64) + 2 * (10 * tenth + port) + upper_half_first] |= 1 << 4 + bit % 4
    expected += bytes.fromhex("30303070 30303030 10 00")  # 1 period, 0 to end, commit, switch
    assert on_the_wire(ultraino_boards(2), one_on(transducer, phase, amplitude, 128)) == expected


@settings(max_examples=30)
@given(seeds)
def test_sonicsurface_frame_is_undone_by_its_inverse_and_by_the_firmware(seed: int) -> None:
    levels = random_integers(33, seed)
    frame = sonicsurface_frame(levels)
    assert torch.equal(levels_of_sonicsurface_frame(frame), levels)
    firmware = SonicSurfaceFirmware()
    for piece in pieces(frame, seed):
        firmware.receive(piece)
    # One complex exponential by two routes.
    torch.testing.assert_close(firmware.drive(), sonicsurface_drive(levels), rtol=0, atol=1e-15)


@settings(max_examples=30)
@given(seeds)
def test_openmpd_frame_is_undone_by_its_inverse_and_by_the_firmware(seed: int) -> None:
    levels = Levels(random_integers(128, seed), random_integers(65, seed + 1))
    frame = openmpd_frame(levels)
    assert all(map(torch.equal, levels_of_openmpd_frame(frame), levels))
    firmware = OpenMPDFirmware()
    firmware.receive(bytes(7))  # without bit 7 no message begins
    for piece in pieces(frame, seed):
        firmware.receive(piece)
    torch.testing.assert_close(firmware.drive(), openmpd_drive(levels), rtol=0, atol=1e-15)


@settings(max_examples=10)
@given(seeds, st.integers(1, 3))
def test_ultraino_frame_is_undone_by_its_inverse_and_by_the_firmware(seed: int, boards: int) -> None:
    duty = random_integers(6, seed, 64 * boards)
    levels = Levels(random_integers(10, seed + 1, 64 * boards) * (duty > 0), duty)
    frame = ultraino_frame(levels)
    assert all(map(torch.equal, levels_of_ultraino_frame(frame), levels))
    firmware = UltrainoFirmware(boards)
    for piece in pieces(frame, seed):
        firmware.receive(piece)
    # Sums of up to five exponentials, and of patterns.
    torch.testing.assert_close(firmware.drive(), ultraino_drive(levels), rtol=0, atol=1e-14)


def test_ultraino_starts_with_all_transducers_on_and_another_duration_would_play_old_patterns() -> None:
    firmware = UltrainoFirmware()
    torch.testing.assert_close(firmware.drive(), torch.ones(64).cdouble(), rtol=0, atol=1e-14)
    firmware.receive(bytes.fromhex("30303070 303030f0 30303030 10"))  # 1 period, then 3 of the second pattern
    torch.testing.assert_close(firmware.drive(), torch.ones(64).cdouble() / 4, rtol=0, atol=1e-14)


def test_every_transducer_has_a_channel_or_pin_of_its_own() -> None:
    assert sorted(sonicsurface_channels()) == list(range(256))
    assert len(set(ultraino_pins())) == 64


def test_a_lone_commit_of_the_sonicsurface_brings_the_last_pattern_back() -> None:
    first, second = random_integers(33, 0), random_integers(33, 1)
    firmware = SonicSurfaceFirmware()
    firmware.receive(sonicsurface_frame(first) + sonicsurface_frame(second) + b"\xfd")
    torch.testing.assert_close(firmware.drive(), sonicsurface_drive(first), rtol=0, atol=1e-15)


@pytest.mark.parametrize("frame", [b"", bytes(258), bytes([254, *[0] * 255, 253])])
def test_other_bytes_are_no_frame(frame: bytes) -> None:
    with pytest.raises(ValueError, match=r"frame: \d+ bytes"):
        levels_of_sonicsurface_frame(frame)
    with pytest.raises(ValueError, match=r"frame: \d+ bytes"):
        levels_of_openmpd_frame(frame)
    with pytest.raises(ValueError, match=r"frame: \d+ bytes"):
        levels_of_ultraino_frame(frame)


def random_integers(most: int, seed: int, count: int = 256) -> torch.Tensor:
    return torch.randint(most, (count,), generator=torch.Generator().manual_seed(seed))


def pieces(frame: bytes, seed: int) -> tuple[bytes, bytes]:
    """The frame in two pieces, as a chip may pass it on."""
    cut = seed % (len(frame) + 1)
    return frame[:cut], frame[cut:]
