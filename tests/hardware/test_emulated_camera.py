"""The emulated camera against closed forms of the heat, and the geometry of its images."""

import math

import numpy as np
import pytest
import torch

from autdtorch import hardware as hw
from autdtorch.hardware.camera.picture import Picture, turned
from autdtorch.hardware.camera.registration import Registration, hot_spot
from autdtorch.hardware.camera.screen import Screen
from autdtorch.scene.geometry import Plane

PLANE = Plane((40e-3, 0.0, 0.0), (1, 0, 0), (40e-3, 30e-3))
SCREEN = Screen(diffusivity=5e-7, loss_time=0.8, heating=1e-6)
PRESSURE = 2e3  # [Pa]


def frames_of(folder, matrix_of, **settings):
    """Frames of 0.5 s of silence, 0.5 s of sound and 0.5 s of silence; the moments of the change; corners."""
    bench = hw.EmulatedBench(hw.SONICSURFACE, torch.ones(1, 1).cdouble(), [0])
    camera = hw.EmulatedCamera(bench, matrix_of, PLANE, folder, SCREEN, **settings)
    sleep = bench.bus.sleep
    source = hw.FolderFrames(folder, 0.01, -273.15, delete=True, clock=camera.clock, sleep=sleep)
    with hw.open_link(hw.SONICSURFACE, [0], backend=bench.bus, settle=0.0) as link:
        source.begin()
        source.wait(0.5)
        on = camera.clock()
        link.play(torch.ones(1, dtype=torch.complex128))
        source.wait(0.5)
        off = camera.clock()
        link.off()
        source.wait(0.5)
        frames = source.frames()
    camera.close()
    names = list(folder.iterdir())
    bench.bus.sleep(1.0)
    assert list(folder.iterdir()) == names
    return frames, on, off, camera


def test_a_uniform_sound_heats_and_cools_the_screen_exponentially(tmp_path):
    def everywhere(points):
        return torch.full((len(points), 1), PRESSURE, dtype=torch.complex128)

    frames, on, off, _ = frames_of(tmp_path, everywhere, drift=0.0)
    assert np.diff([frame.time for frame in frames]) == pytest.approx(1 / 30, abs=1e-6)
    times = np.array([frame.time for frame in frames]) - 10e-3  # the lag of a bolometer
    images = np.stack([frame.image for frame in frames])
    level = images[:, images.std(axis=0) > 0].mean(axis=1)  # without dead pixels
    level -= level[times < on].mean()
    tau = SCREEN.loss_time
    warm = np.exp(-np.maximum(times - off, 0) / tau) * -np.expm1(-np.clip(times - on, 0, off - on) / tau)
    rise = SCREEN.heating * PRESSURE**2 * tau * warm
    # The mean of 2000 pixels of 50 mK; the lag is of first order, so the frames after a change differ.
    far = (np.abs(times - on) > 0.05) & (np.abs(times - off) > 0.05)
    np.testing.assert_allclose(level[far], rise[far], atol=6e-3)
    assert rise.max() > 1.4


@pytest.mark.parametrize("place", [(0.0, 0.0), (12e-3, -8e-3), (-15e-3, 10e-3)])
def test_a_spot_is_where_the_corners_say(tmp_path, place):
    u, v = PLANE.basis

    def spot(points):
        offset = points - torch.tensor(PLANE.center, dtype=torch.float64)
        distance = (offset @ u - place[0]).square() + (offset @ v - place[1]).square()
        return (PRESSURE * (-distance / (2 * 3e-3**2)).exp())[:, None].cdouble()

    frames, on, off, camera = frames_of(tmp_path, spot, tilt=25.0, noise=0.02)
    before = np.mean([frame.image for frame in frames if frame.time < on], axis=0)
    hot = np.mean([frame.image for frame in frames if off - 0.2 < frame.time < off], axis=0)
    seen = Registration.of(PLANE, camera.corners, PLANE.corners).to_plane(hot_spot(hot - before))
    assert math.dist(seen, place) < 0.15e-3  # a sixth of a pixel


def test_a_camera_sees_the_plane_from_in_front(tmp_path):
    bench = hw.EmulatedBench(hw.SONICSURFACE, torch.ones(1, 1).cdouble(), [0])
    camera = hw.EmulatedCamera(bench, lambda points: torch.ones(len(points), 1).cdouble(), PLANE, tmp_path)
    low, along_v, along_u, _ = camera.corners
    (right, down), (over, up) = along_u - low, along_v - low
    assert abs(right) > abs(down)
    assert abs(up) > abs(over)
    assert right * up < 0  # rows go down


@pytest.mark.parametrize("counts", [(20, 20), (20, 15)])
def test_a_turned_picture_is_told_from_the_expected_one(counts):
    expected = 1e3 * torch.rand(counts, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def of(pressure):
        return turned(Picture(PLANE, pressure + 50, torch.ones(counts)), expected)

    assert of(expected) is None
    assert of(expected.rot90(2)) == "turned by half"
    assert of(expected.flip(1)) == "mirrored along v"
    if counts[0] == counts[1]:
        assert of(expected.rot90(3)) == "turned by a quarter"
        assert of(expected.T) == "mirrored along a diagonal"
    symmetric = expected + expected.rot90(2)
    assert turned(Picture(PLANE, symmetric.flip(0).flip(1), torch.ones(counts)), symmetric) is None
