"""Frames against hand-worked bytes, against their own inverse, and against the firmwares."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.drive import drive_from_phases
from autdtorch.hardware.devices import OPENMPD, SONICSURFACE
from autdtorch.hardware.firmware import OpenMPDFirmware, SonicSurfaceFirmware
from autdtorch.hardware.frames import (
    levels_of_openmpd_frame,
    levels_of_sonicsurface_frame,
    openmpd_frame,
    sonicsurface_frame,
)
from autdtorch.hardware.levels import Levels, openmpd_drive, sonicsurface_drive
from autdtorch.hardware.order import sonicsurface_channels

seeds = st.integers(0, 2**32 - 1)


def one_on(transducer: int, phase: float, amplitude: float) -> torch.Tensor:
    """A drive (256,) of one transducer."""
    drive = torch.zeros(256, dtype=torch.complex128)
    drive[transducer] = drive_from_phases([phase], [amplitude])[0]
    return drive


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


@pytest.mark.parametrize(("transducer", "phase", "amplitude", "place", "byte"), SONICSURFACE_EXAMPLES)
def test_sonicsurface_bytes(transducer: int, phase: float, amplitude: float, place: int, byte: int) -> None:
    expected = bytearray([254, *[32] * 256, 253])
    expected[place] = byte
    assert SONICSURFACE.frame(one_on(transducer, phase, amplitude)) == expected


@pytest.mark.parametrize(("transducer", "phase", "amplitude", "byte", "duty"), OPENMPD_EXAMPLES)
def test_openmpd_bytes(transducer: int, phase: float, amplitude: float, byte: int, duty: int) -> None:
    expected = bytearray(512)
    expected[0] = 128
    expected[transducer], expected[256 + transducer] = byte, duty
    assert OPENMPD.frame(one_on(transducer, phase, amplitude)) == expected


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


def test_sonicsurface_channels_are_all_there() -> None:
    assert sorted(sonicsurface_channels()) == list(range(256))


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


def random_integers(most: int, seed: int) -> torch.Tensor:
    return torch.randint(most, (256,), generator=torch.Generator().manual_seed(seed))


def pieces(frame: bytes, seed: int) -> tuple[bytes, bytes]:
    """The frame in two pieces, as a chip may pass it on."""
    cut = seed % (len(frame) + 1)
    return frame[:cut], frame[cut:]
