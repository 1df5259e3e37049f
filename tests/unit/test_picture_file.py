"""Files of pictures: what is loaded is what was saved, and a file from elsewhere is refused by name."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

import autdtorch as at
from autdtorch.hardware.camera.picture import Picture
from autdtorch.io.picture_file import newest_picture

PLANE = at.Plane((0.01, 0.0, 0.15), (0.6, 0.0, 0.8), (0.1, 0.08))


def picture_of(peak: float = 2000.0) -> Picture:
    pressure = peak * torch.rand(8, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return Picture(PLANE, pressure, 0.01 * pressure, True, 40, 0.02, ("two frames are missing",))


def test_a_picture_is_loaded_as_it_was(tmp_path: Path) -> None:
    picture = picture_of()
    at.save_picture(tmp_path / "a.npz", picture)
    loaded = at.load_picture(tmp_path / "a.npz")
    torch.testing.assert_close(loaded.pressure, picture.pressure, rtol=1e-7, atol=0)  # float32
    torch.testing.assert_close(loaded.deviation, picture.deviation, rtol=1e-7, atol=0)
    for name in ("plane", "relative", "frames", "latency", "doubts"):
        assert getattr(loaded, name) == getattr(picture, name)


def test_the_drive_of_a_picture_is_beside_it(tmp_path: Path) -> None:
    drive = torch.polar(torch.ones(5, dtype=torch.float64), torch.arange(5, dtype=torch.float64))
    at.save_picture(tmp_path / "a.npz", picture_of(), drive)
    assert torch.equal(at.load_drive(tmp_path / "a.npz"), drive)
    assert at.load_picture(tmp_path / "a.npz").frames == 40
    with pytest.raises(ValueError, match="drive"):
        at.save_picture(tmp_path / "b.npz", picture_of(), [2.0 + 0j])


def test_a_picture_without_doubts_is_loaded(tmp_path: Path) -> None:
    picture = Picture(PLANE, torch.ones(2, 3, dtype=torch.float64), torch.ones(2, 3, dtype=torch.float64))
    at.save_picture(tmp_path / "a.npz", picture)
    assert at.load_picture(tmp_path / "a.npz").doubts == ()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("pressure", None, "no array 'pressure'"),
        ("pressure", np.ones(6), r"pressure: shape \(6,\)"),
        ("pressure", np.full((8, 6), np.nan), "pressure.*finite"),
        ("deviation", np.ones((2, 2)), r"deviation: \(2, 2\).*\(8, 6\)"),
        ("deviation", -np.ones((8, 6)), "deviation.*>= 0"),
        ("center", np.array([0.0, np.inf, 0.0]), "Plane.center.*finite"),
        ("size", np.array([0.0, 1.0]), "Plane.size"),
        ("normal", np.array([0.0, 1.0]), "Plane.normal.*3 real numbers"),
        ("relative", np.ones(2), "relative"),
        ("frames", np.array("many"), "frames.*integer"),
    ],
)
def test_a_file_from_elsewhere_is_refused_by_name(
    name: str, value: object, message: str, tmp_path: Path
) -> None:
    at.save_picture(tmp_path / "a.npz", picture_of())
    with np.load(tmp_path / "a.npz") as file:
        arrays = dict(file)
    arrays = {key: content for key, content in (arrays | {name: value}).items() if content is not None}
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(ValueError, match=rf"b\.npz: {message}"):
        at.load_picture(tmp_path / "b.npz")


def test_the_newest_picture_is_the_one_written_last(tmp_path: Path) -> None:
    assert newest_picture(tmp_path / "none") is None
    for number, time in enumerate((10, 30, 20)):
        at.save_picture(tmp_path / f"evaluation_{number:05d}.npz", picture_of())
        os.utime(tmp_path / f"evaluation_{number:05d}.npz", (time, time))
    assert newest_picture(tmp_path) == tmp_path / "evaluation_00001.npz"
