"""The log of a trial, and its pictures, are readings."""

import math

import pytest
import torch

import autdtorch as at
from autdtorch.hardware.log import EvaluationLog


@pytest.fixture
def log(tmp_path):
    """The log of a trial with a SonicSurface, of three evaluations."""
    origin = {"device": "SonicSurface", "transducers": [3, 1], "amplitude limit": 1.0}
    log = EvaluationLog(tmp_path / "trial.jsonl", origin, 2, 2)
    for number in range(3):
        log.append(
            torch.tensor([1.0, -1j]) * torch.exp(torch.tensor(0.3j * number)),
            torch.tensor([1.0, 2.0 + number]).double(),
            0.1,
        )
    log.end(0.4)
    return log.path


def test_a_log_has_the_drives_that_the_device_played(log):
    readings = at.load_readings(log.parent)
    assert readings.pressure[:, 1].tolist() == [2, 3, 4]
    steps = readings.drives.angle() * 32 / (2 * math.pi)
    torch.testing.assert_close(steps, steps.round(), atol=1e-9, rtol=0)
    error = (readings.drives[:, 0] * torch.exp(torch.tensor([0, -0.3j, -0.6j]))).angle()
    assert error.abs().max() <= math.pi / 32 + 1e-6  # half a level


def test_of_a_device_that_is_not_known_the_drives_are_as_asked_with_a_warning(tmp_path, caplog):
    origin = {"device": "mine", "transducers": [0, 1], "amplitude limit": 1.0}
    log = EvaluationLog(tmp_path / "trial.jsonl", origin, 2, 1)
    drive = torch.polar(torch.ones(2), torch.tensor([0.1, 2.3])).cdouble()
    log.append(drive, torch.ones(1).double(), 0.1)
    log.end(0.1)
    assert torch.equal(at.load_readings(tmp_path).drives[0], drive)
    assert "'mine' is not in hardware.DEVICES" in caplog.text


def test_pictures_of_a_trial_are_readings_of_the_plane(log):
    """Of |p|^2 that grows along u: interpolated at any places, with the drives that the device played."""
    plane = at.Plane((0, 0, 0.1), (0, 0, 1), (0.03, 0.02))
    square = (plane.points(1e-3) - torch.tensor(plane.center, dtype=torch.float64)) @ plane.basis[0] + 0.1
    folder = log.parent / "pictures"
    folder.mkdir()
    for number, drive in enumerate(at.load_readings(log).drives):
        pressure = 1e3 * (number + 1) * square.sqrt()
        picture = at.hardware.Picture(plane, pressure, 0.02 * pressure)
        at.save_picture(folder / f"evaluation_{number:05d}.npz", picture, drive)
    at.save_picture(folder / "again_0.npz", picture, drive)
    readings = at.load_readings(folder)
    assert torch.equal(readings.drives, at.load_readings(log).drives)
    assert readings.pressure.shape == (3, 15 * 10)
    apart = torch.cdist(readings.points, readings.points).fill_diagonal_(1).min()
    torch.testing.assert_close(float(apart), 2e-3)
    chosen = plane.points(1e-3)[10:20, 5:15].reshape(-1, 3) + torch.tensor([3e-4, -2e-4, 0])
    one = at.load_readings(folder, points=chosen)
    expected = 1e3 * (chosen @ plane.basis[0] + 0.1).sqrt()
    # splines are exact for a plane; mirrored beyond the outermost cells it bends, by 1e-3 there
    torch.testing.assert_close(one.pressure[1], 2 * expected, rtol=1e-3, atol=0)
    torch.testing.assert_close(one.deviation[0], 0.02 * expected, rtol=2e-2, atol=0)
    with pytest.raises(ValueError, match=r"pressure: .kPa peak.; must not be given"):
        at.load_readings(folder, pressure="kPa peak")
    for path in folder.glob("evaluation*"):
        path.unlink()
    with pytest.raises(ValueError, match="no picture"):
        at.load_readings(folder)


def test_a_damaged_log_is_refused_and_its_last_line_may_break_off(log, caplog):
    content = log.read_bytes()
    log.write_bytes(content[:-300])
    assert len(at.load_readings(log)) == 2
    assert "broke off" in caplog.text
    log.write_bytes(content.replace(b"2.0", b"2.5", 1))
    with pytest.raises(ValueError, match=r"trial\.jsonl, line 2: its checksum is wrong"):
        at.load_readings(log)
    log.write_bytes(b'{"a": 1}\n')
    with pytest.raises(ValueError, match=r"trial\.jsonl, line 1: cannot be read"):
        at.load_readings(log)
