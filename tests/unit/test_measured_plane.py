"""The plane of a camera in the report of a trial."""

from pathlib import Path

import pytest
import torch

import autdtorch as at
from autdtorch.hardware.camera.picture import Picture
from autdtorch.io.picture_file import PICTURES
from autdtorch.propagators import Propagator
from autdtorch.scene.geometry import cell_centers_of
from autdtorch.study.report.hardware_report import alike, measured_plane

PLANE = at.Plane((0.12, 0.0, 0.0), (1, 0, 0), (0.08, 0.08))
FOCI = at.circle_points(PLANE.center, 20e-3, 4, PLANE.normal)
ARRAY = at.TransducerArray.grid((8, 8), 10e-3, (0, 0, 0), (1, 0, 0))
SCENE = at.Scene(ARRAY, at.Medium(1.2, 340.0), 40e3, FOCI, observation_plane=PLANE)
COUNTS = (64, 64)


def pictured(folder: Path, shift: float = 0.0, factor: float = 1.0) -> tuple[Propagator, torch.Tensor]:
    """Leave four noisy pictures of a drive of four foci, of a screen that is shifted along u [m]."""
    propagator = at.make_propagator(SCENE)
    drive = at.holography(propagator.transfer_matrix())
    points = cell_centers_of(PLANE, COUNTS) + shift * PLANE.basis[0]
    square = (factor * propagator.field(drive, points).abs()).square()
    draws, noise = torch.Generator().manual_seed(0), 0.02 * float(square.max())
    for number in range(4):
        noisy = square + noise * torch.randn(COUNTS, generator=draws, dtype=torch.float64)
        pressure = noisy.clamp(min=0).sqrt()
        picture = Picture(PLANE, pressure, (pressure.square() + noise).sqrt() - pressure)
        at.save_picture(folder / PICTURES / f"again_{number}.npz", picture)
    return propagator, drive


def test_drives_are_alike_up_to_a_phase_in_common() -> None:
    draws = torch.Generator().manual_seed(0)
    levels = torch.randint(8, (16,), generator=draws)
    drive = at.drive_from_phases(2 * torch.pi * levels / 8)
    assert alike(drive, drive) == 16
    assert alike(drive * torch.tensor(0.6 + 0.8j), drive) == 16
    changed = drive.clone()
    changed[:3] *= torch.tensor([1j, -1, 0.5])  # two phases and an amplitude
    assert alike(1j * changed, drive) == 13
    changed[:3] = 0
    assert alike(changed, drive) == 13
    assert alike(0 * drive, 0 * drive) == 16


def test_a_trial_without_a_camera_has_no_plane(tmp_path: Path) -> None:
    assert measured_plane(tmp_path, at.make_propagator(SCENE), torch.ones(64), 1.0, []) == {"plane": None}


def test_the_plane_differs_by_the_noise_of_its_pictures_and_no_more(tmp_path: Path) -> None:
    told = measured_plane(tmp_path, *pictured(tmp_path, factor=3.0), 3.0, list("abcd"))
    assert (tmp_path / "plane.png").exists()
    # 4096 cells, but in dark ones the deviation is an estimate.
    assert told["off"] == pytest.approx(told["noise"], rel=0.2)
    # Cells of 1.25 mm, of which noise of 1 % of the intensity moves few across the threshold.
    assert told["areas"][0] == pytest.approx(told["areas"][1], rel=0.05)
    for row in told["foci"][1:]:
        assert float(row[1]) < 1.0  # mm; the lobes are 10 mm wide
        assert float(row[3]) == pytest.approx(float(row[4]), rel=0.02)


def test_a_shifted_screen_shows_in_the_places_of_the_maxima(tmp_path: Path) -> None:
    told = measured_plane(tmp_path, *pictured(tmp_path, shift=3e-3), 1.0, list("abcd"))
    assert sum(float(row[1]) for row in told["foci"][1:]) / 4 == pytest.approx(3.0, abs=0.5)
