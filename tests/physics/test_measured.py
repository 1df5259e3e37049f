"""Free space against public scans, where they are; and the check that reads them, on readings of its own."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from checks import measured
from shared import hologram_readings, scans
from shared.hologram_readings import Holograms
from shared.scans import RADIUS, Pose, Scan, far_field, load_scans

from autdtorch.hardware.devices.sonicsurface import sonicsurface_channels

SCANS = os.environ.get("AUTDTORCH_SCANS", Path(__file__).parents[3] / "shared/measured/scans_mit.npz")
"""The scans that `check.py measured` reads, as an npz file."""

POSES = {
    "A": Pose((8.27e-3, 5.44e-3, 159.8e-3, -0.0113, 0.0023, RADIUS), 2, True),
    "Star": Pose((-3.71e-3, 6.11e-3, 162.3e-3, 0.0006, 0.0314, RADIUS), 2, False),
    "12": Pose((4.64e-3, 10.07e-3, 165.6e-3, 0.0174, -0.0053, RADIUS), 2, True),
}
"""Places of the scans, as the check finds them."""


def likeness(scan: Scan, radius: float) -> float:
    """Return the correlation at every ninth pixel along both axes."""
    pose = POSES[scan.name]
    points = pose.points(len(scan.image)).reshape(*scan.image.shape, 3)[::9, ::9].reshape(-1, 3)
    field = far_field(scan.emitters, points, radius)
    return float(np.corrcoef(field, pose.oriented(scan.image)[::9, ::9].ravel())[0, 1])


@pytest.mark.skipif(not Path(SCANS).is_file(), reason="AUTDTORCH_SCANS names no npz file of the public scans")
def test_discs_in_free_space_look_like_public_scans() -> None:
    """The check finds 0.905 to 0.941, points 0.80 to 0.88; wrong emitters are far below."""
    patterns = load_scans(Path(SCANS))
    for number, scan in enumerate(patterns):
        discs = likeness(scan, RADIUS)
        assert discs > 0.89
        assert likeness(scan, 0.0) < discs - 0.04
        other = Scan(scan.name, scan.image, patterns[number - 1].emitters)
        assert likeness(other, RADIUS) < 0.5


@pytest.fixture
def emitters() -> np.ndarray:
    """An uneven array of 5 x 4 transducers at heights."""
    along_x, along_y = np.meshgrid(np.arange(5) - 2.0, np.arange(4) - 1.5)
    heights = np.random.default_rng(0).uniform(0, 8e-3, 20)
    return np.column_stack((11e-3 * along_x.ravel(), 11e-3 * along_y.ravel(), heights))


def test_the_far_field_of_scans_is_the_propagators_within_a_percent(emitters) -> None:
    """The error of a far field is of the order of (radius / distance)^2, 1e-3 here, of the peak."""
    points = np.array([[0.0, 0, 0.16], [20e-3, 0, 0.15], [50e-3, -60e-3, 0.155]])
    exact = scans.propagator(emitters, points, RADIUS).transfer_matrix().sum(dim=1).abs().numpy()
    field = far_field(emitters, points, RADIUS)
    ratio = field / exact
    assert ratio == pytest.approx(ratio.mean(), rel=1e-2)


def test_the_place_of_a_scan_is_recovered(emitters, monkeypatch) -> None:
    """The scan itself is simulated, without noise: the fit is exact up to its own tolerance."""
    monkeypatch.setattr(scans, "DISTANCES", (0.15,))
    truth = Pose((6e-3, -4e-3, 0.153, 0.01, 0.02, RADIUS), 1, True)
    pixels = 40
    image = far_field(emitters, truth.points(pixels), RADIUS).reshape(pixels, pixels)
    # oriented(image) is what the points see: undo the flip, then the quarter turn
    scan = Scan("made", np.rot90(image[:, ::-1], -1), emitters)
    pose = scan.pose(RADIUS)
    assert (pose.quarters, pose.flipped) == (truth.quarters, truth.flipped)
    assert pose.values == pytest.approx(truth.values, abs=1e-5)
    assert scan.correlation(pose) == pytest.approx(1, abs=1e-6)


@pytest.fixture
def clone(tmp_path, monkeypatch) -> Path:
    """A clone with one target of each kind and one repetition: exact readings of discs of 4.5 mm."""
    for module in (hologram_readings, measured):
        monkeypatch.setattr(module, "TARGETS", 1)
        monkeypatch.setattr(module, "TRIES", 1)
    simulated, experiment = (tmp_path / mark for mark in hologram_readings.MARKS)
    simulated.mkdir()
    experiment.mkdir()
    rng = np.random.default_rng(1)
    row = hologram_readings.matrix(RADIUS)[0].numpy()
    phases = rng.integers(0, 32, (3, 256)) * (2 * np.pi / 32)
    pressures = np.exp(1j * phases) @ row
    np.savetxt(simulated / "step_2_target_amp_list.csv", [500.0])
    np.savetxt(simulated / "step_2_target_pha_list.csv", [1.0])
    for kind, phase, pressure in zip(["i", "ii", "iii"], phases, pressures, strict=True):
        by_channel = np.empty(256)
        by_channel[sonicsurface_channels()] = phase
        np.savetxt(simulated / f"step2_target_A{kind}_N_0_phase_export.csv", by_channel)
        np.savetxt(simulated / f"step_2_target_A{kind}_performance_amp.csv", [abs(pressure)])
        np.savetxt(
            experiment / f"step3_compare_A{kind}_numerical2experiment_pha_0_try.csv", [np.angle(pressure)]
        )
        spectrum = np.array([900.0, 1j, -abs(pressure), 2.0])  # an offset, and the line
        name = f"step3_optimize_match_target_A{kind}_N_0_fft_data_record_0_try.csv"
        np.savetxt(experiment / name, spectrum)
    return tmp_path


def test_a_clone_is_read_by_channels_levels_and_spectral_lines(clone) -> None:
    """What the files were written from comes back: a wrong order of channels would leave no likeness."""
    readings = Holograms(clone).step3
    pressure = readings.drives @ hologram_readings.matrix(RADIUS).T
    torch.testing.assert_close(pressure.abs(), readings.pressure)
    torch.testing.assert_close(torch.polar(readings.pressure, readings.phase), pressure)
    error, gain = measured.with_gain(Holograms(clone).authors_simulation, readings)
    assert error < 1e-9
    assert gain == pytest.approx(1)
    assert Holograms(clone).targets.abs().tolist() == pytest.approx([1, 500, 500])


@pytest.mark.parametrize("kind", hologram_readings.KINDS)
def test_a_predicted_drive_reaches_its_target_in_levels_of_the_device(kind, clone) -> None:
    """256 transducers of 32 levels reach a target within 0.5 %; a level of one is 0.1 % of the peak."""
    row, start = hologram_readings.matrix(RADIUS)[0], Holograms(clone).step3.drives[0]
    wanted = 800 * torch.exp(torch.tensor(1j))
    drive = measured.predicted_drive(row, start, wanted, kind)
    assert measured.deviation(row @ drive / wanted, kind) < 5e-3
    levels = 32 / (2 * torch.pi) * drive.angle()
    torch.testing.assert_close(levels, levels.round(), atol=1e-6, rtol=0)


def test_deviations_do_not_depend_on_a_common_phase() -> None:
    wanted = torch.tensor([1j, 300, 400j])
    reached = torch.exp(torch.tensor(0.7j)) * torch.tensor([50j, 330, 380j])
    off = measured.deviations(reached, wanted, hologram_readings.KINDS)
    assert off.tolist() == pytest.approx([0, 0.1, 0.05], abs=1e-6)


def test_a_folder_that_is_no_data_set_is_refused(tmp_path) -> None:
    with pytest.raises(SystemExit, match="must be a clone"):
        list(measured.parts_of(tmp_path))
