"""Drives, and files of them."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import autdtorch as at
from autdtorch.hardware import AUTD3, DEVICES
from autdtorch.scene.drive import normalise, validate_drive

WHOLE = pytest.mark.filterwarnings("ignore::autdtorch.utils.units.ScaleWarning")  # numbers as phases

phases_arrays = hnp.arrays(
    float, hnp.array_shapes(min_dims=1, max_dims=3, max_side=5), elements=st.floats(-1e3, 1e3)
)


@WHOLE
def test_phases_turn_the_drive_clockwise_and_are_zero_for_silence():
    assert at.drive_from_phases(torch.zeros(5, 1, 2), [1.0, 0.5])[3, 0].tolist() == [1.0, 0.5]  # broadcasts
    drive = at.drive_from_phases([0.0, math.pi / 2], [1.0, 0.5])
    expected = torch.tensor([1.0, -0.5j], dtype=torch.complex128)
    # cos(pi / 2) is 6e-17 in float64.
    torch.testing.assert_close(drive, expected, rtol=0, atol=1e-16)
    phases = at.phases_of(torch.tensor([1 + 1e-17j, 0j, complex(-0.0, 0.0), -1 + 0j], dtype=torch.complex128))
    assert phases.tolist() == [0.0, 0.0, 0.0, math.pi]


@WHOLE
@given(phases=phases_arrays, data=st.data())
def test_phases_and_amplitudes_round_trip(phases, data):
    drive = at.drive_from_phases(phases)
    found = at.phases_of(drive)
    assert found.shape == phases.shape
    assert ((found >= 0) & (found < 2 * math.pi)).all()
    # Compared on the circle, where 0 and 2 pi are one; 1e3 rad leaves 1e-13 of rounding in sine and cosine.
    torch.testing.assert_close(at.drive_from_phases(found), drive, rtol=0, atol=1e-12)
    amplitudes = data.draw(hnp.arrays(float, phases.shape, elements=st.floats(0, 1)))
    found = at.amplitudes_of(at.drive_from_phases(phases, amplitudes))
    # Subnormal amplitudes lose their relative precision in |q|.
    torch.testing.assert_close(found, torch.from_numpy(amplitudes), rtol=1e-15, atol=1e-300)


def test_drive_carries_the_gradient_of_phases_and_amplitudes():
    phases = torch.tensor([0.3, 2.0], dtype=torch.float64, requires_grad=True)
    amplitudes = torch.tensor([0.4, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(at.drive_from_phases, (phases, amplitudes))


def test_focus_phases_are_the_distance_in_radians():
    positions, foci = [[0, 0, 0], [0, 0, 0.5]], [[0.3, 0.4, 0.0], [0.0, 0.0, 2.0]]
    phases = at.focus_phases(positions, foci, wavenumber=10.0)
    assert phases[0].tolist() == pytest.approx([5.0, 10 * math.sqrt(0.5)], rel=1e-15)
    assert phases[1].tolist() == pytest.approx([20.0, 15.0], rel=1e-15)
    assert torch.equal(phases[1], at.focus_phases(positions, foci[1], wavenumber=10.0))


@WHOLE
def test_normalise_and_validate_drives():
    drive = torch.tensor([[3j, 4.0], [0.0, -0.1j]], dtype=torch.complex128)
    expected = torch.tensor([[0.75j, 1.0], [0.0, -1j]], dtype=torch.complex128)
    torch.testing.assert_close(normalise(drive), expected, rtol=1e-15, atol=0)
    drive = at.drive_from_phases(torch.arange(16.0)).to(torch.complex64)
    assert validate_drive(drive, 16).dtype == torch.complex128


ARRAYS = {
    "autd3": at.TransducerArray.autd3((0, 0, 0), units=(2, 1)),
    "openmpd": at.TransducerArray.openmpd((0, 0, 0)),
    "sonicsurface": at.TransducerArray.sonicsurface((0, 0, 0)),
    "ultraino": at.TransducerArray.grid((8, 8), 10.5e-3, (0, 0, 0)),
}


def some_drive(count):
    generator = torch.Generator().manual_seed(0)
    phases = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    return at.drive_from_phases(phases, torch.rand(count, generator=generator, dtype=torch.float64))


def test_csv_can_be_read_by_a_person(tmp_path):
    array = at.TransducerArray([[0, 0, 0], [0, 10e-3, 0]], (1, 0, 0), [2.0, 3.0], 4e-3)
    at.save_drive(tmp_path / "drive.csv", at.drive_from_phases([0.25, 1.5], [1, 0.5]), array)
    assert (tmp_path / "drive.csv").read_text().splitlines() == [
        "transducer,x [m],y [m],z [m],nx,ny,nz,source_strength [Pa m],radius [m],phase [rad],amplitude",
        "0,0.0,0.0,0.0,1.0,0.0,0.0,2.0,0.004,0.25,1.0",
        "1,0.0,0.01,0.0,1.0,0.0,0.0,3.0,0.004,1.5,0.5",
    ]


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
@pytest.mark.parametrize("device", ARRAYS)
def test_levels_come_back_as_the_device_plays_them(tmp_path, device, suffix):
    array, drive = ARRAYS[device], some_drive(len(ARRAYS[device]))
    path = tmp_path / f"drive{suffix}"
    at.save_drive(path, drive, array, device)
    played = at.load_drive(path)
    at.save_drive(path, played, array, device)
    assert torch.equal(at.load_drive(path), played)
    # Half a step of phase and of amplitude; a step of a pulse's amplitude is at most a step of its phase.
    phase_error = math.pi / DEVICES[device].phase_levels.phases
    amplitude_error = {"autd3": 1 / 510, "sonicsurface": 0.5}.get(device, phase_error / 2)
    on = played.abs() > 0
    assert (played / drive)[on].angle().abs().max() <= phase_error + 1e-9
    assert (at.amplitudes_of(played) - at.amplitudes_of(drive)).abs().max() <= amplitude_error + 1e-9


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
@pytest.mark.parametrize("device", [None, *ARRAYS])
@pytest.mark.parametrize("frames", [1, 3])
def test_frames_come_back_in_their_order(tmp_path, device, suffix, frames):
    array = ARRAYS[device or "autd3"]
    drives = torch.stack([some_drive(len(array)).roll(frame) for frame in range(frames)])
    path = tmp_path / f"frames{suffix}"
    at.save_drive(path, drives, array, device)
    read = at.load_drive(path)
    assert read.shape == drives.shape
    for frame in range(frames):
        at.save_drive(tmp_path / f"alone{suffix}", drives[frame], array, device)
        assert torch.equal(at.load_drive(tmp_path / f"alone{suffix}"), read[frame])
    if device is None:
        assert torch.allclose(at.load_array(path).positions, array.positions, rtol=0, atol=1e-15)


def test_autd3_gets_bytes_in_the_order_of_its_units(tmp_path):
    drive = some_drive(498)
    at.save_drive(tmp_path / "drive.npz", drive, ARRAYS["autd3"], "autd3")
    with np.load(tmp_path / "drive.npz") as file:
        assert str(file["device"]) == "autd3"
        for name, level in zip(("phase", "intensity"), AUTD3.levels(drive), strict=True):
            assert (file[name].dtype, file[name].shape) == (np.uint8, (2, 249))
            assert np.array_equal(file[name].ravel(), level.numpy())


def test_what_is_wrong_with_an_npz_file_is_said(tmp_path):
    np.savez(tmp_path / "d.npz", device="autd3", phase=np.array(["x"]), intensity=np.array([1]))
    with pytest.raises(ValueError, match=r"d.npz: autd3 phase: \('x',\); must be an array of real numbers"):
        at.load_drive(tmp_path / "d.npz")
    for phase, intensity in (((0, 1, 249), (0, 1, 249)), ((2, 1, 249), (1, 2, 249)), ((2, 2, 1, 249),) * 2):
        np.savez(tmp_path / "d.npz", device="autd3", phase=np.ones(phase), intensity=np.ones(intensity))
        with pytest.raises(ValueError, match=r"d.npz: levels of shapes .*; must be \(units, M\) or"):
            at.load_drive(tmp_path / "d.npz")
    for shape in ((0, 5), (5, 0), (2, 3, 4)):
        np.savez(tmp_path / "d.npz", drive=np.ones(shape, complex))
        with pytest.raises(ValueError, match=r"d.npz: drive: shape .*; must be \(M,\), or \(T, M\)"):
            at.load_drive(tmp_path / "d.npz")
    with (tmp_path / "d.npz").open("wb") as file:
        np.save(file, np.ones(3))  # a single array, as .npy
    with pytest.raises(ValueError, match=r"d.npz: no array 'drive'"):
        at.load_drive(tmp_path / "d.npz")


def test_a_write_that_breaks_off_leaves_the_file_that_was_there(tmp_path, monkeypatch):
    def full(file, **arrays):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    array = at.TransducerArray.grid((2, 2), 10e-3, (0, 0, 0))
    path = tmp_path / "drive.npz"
    at.save_drive(path, torch.ones(4) * 1j, array)
    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space left") as caught:
        at.save_drive(path, torch.ones(4) + 0j, array)
    assert caught.value.filename == str(path)
    assert torch.equal(at.load_drive(path), torch.ones(4).double() * 1j)
    assert [file.name for file in tmp_path.iterdir()] == ["drive.npz"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"device": "autd3"}, r"16 transducers; must be a multiple of 249 for autd3"),
        ({"device": "autd"}, r"device: 'autd'; must be one of autd3, openmpd, sonicsurface, u"),
        ({"path": "d.txt"}, r"path: .*; must end in one of .csv, .npz"),
        ({"drive": torch.ones(1, 1, 16) + 0j}, r"drive: shape \(1, 1, 16\); must be \(16,\), or \(T, 16\)"),
        ({"drive": torch.ones(0, 16) + 0j}, r"drive: shape \(0, 16\); must be \(16,\), or \(T, 16\)"),
    ],
)
def test_a_drive_that_is_not_the_devices_is_refused(tmp_path, changes, message):
    array = at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0))
    given = {"path": "d.csv", "drive": torch.ones(16) + 0j, "array": array} | changes
    with pytest.raises(ValueError, match=message):
        at.save_drive(**given | {"path": tmp_path / given["path"]})


def test_an_amplitude_beyond_1_by_rounding_is_read_again(tmp_path):
    array = at.TransducerArray.grid((2, 2), 10e-3, (0, 0, 0))
    drive = torch.polar(torch.full((4,), 1 + 1e-9, dtype=torch.float64), torch.arange(4, dtype=torch.float64))
    at.save_drive(tmp_path / "drive.csv", drive, array)
    torch.testing.assert_close(at.load_drive(tmp_path / "drive.csv"), drive, rtol=0, atol=1e-8)
