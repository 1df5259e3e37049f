"""Files of calibrations: what is loaded is what was saved, and predicts the same."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scenes import small_scene

import autdtorch as at
from autdtorch.io import calibration_file
from autdtorch.methods.calibration.fit import CalibrationFit
from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior

BALL = at.Sphere((12e-3, 12e-3, 12e-3), radius=3e-3, rigid=True)
ELSEWHERE = torch.tensor([[19e-3, 8e-3, 13e-3], [20e-3, 15e-3, 9e-3]], dtype=torch.float64)


def readings_of(matrix: torch.Tensor, phase: bool = False, **fields: torch.Tensor) -> at.Readings:
    """Readings of a bench whose transducers differ, with an outlier and a gap."""
    draws = torch.Generator().manual_seed(3)
    drives = torch.polar(
        torch.ones(40, matrix.shape[1], dtype=torch.float64),
        6 * torch.rand(40, matrix.shape[1], generator=draws, dtype=torch.float64),
    )
    pressure = drives @ (matrix * torch.tensor([1.1, 0.9, 1j, 1.0])).T
    magnitude = pressure.abs()
    magnitude = magnitude * (1 + 0.02 * torch.randn(magnitude.shape, generator=draws, dtype=torch.float64))
    magnitude[3, 0] *= 50
    magnitude[5, 1] = torch.nan
    return at.Readings(drives, magnitude, phase=pressure.angle() if phase else None, **fields)


def saved_and_loaded(calibration: at.Calibration, folder: Path) -> at.Calibration:
    at.save_calibration(folder / "a.npz", calibration)
    loaded = at.load_calibration(folder / "a.npz")
    at.save_calibration(folder / "b.npz", loaded)
    with np.load(folder / "a.npz") as first, np.load(folder / "b.npz") as again:
        assert first.files == again.files
        assert all(np.array_equal(first[n], again[n], equal_nan=first[n].dtype.kind == "f") for n in first)
    return loaded


def require_equal_predictions(
    one: at.Calibration, other: at.Calibration, points: torch.Tensor | None
) -> None:
    drives = one.readings.drives[:5]
    for part, same in zip(one.predict(drives, points), other.predict(drives, points), strict=True):
        assert torch.equal(part, same)


@pytest.mark.parametrize("phase", [False, True])
def test_a_calibrated_matrix_is_loaded_as_it_was(phase: bool, tmp_path: Path) -> None:
    matrix = at.make_propagator(small_scene()).transfer_matrix()
    prior = at.Prior(variants=1.1 * matrix[None], rest=0.02)
    calibration = at.calibrate(matrix, readings_of(matrix, phase), prior)
    loaded = saved_and_loaded(calibration, tmp_path)
    assert loaded.summary() == calibration.summary()
    assert "drive 3 at point 0" in loaded.summary()
    assert loaded.outliers == calibration.outliers == [(3, 0)]
    require_equal_predictions(calibration, loaded, None)
    with pytest.raises(ValueError, match="points"):
        loaded.predict(loaded.readings.drives, ELSEWHERE)


@pytest.mark.parametrize(
    ("obstacles", "settings", "names"),
    [
        ((), {}, None),
        ((), {}, {"temperature": 3.0, "points.x": 1e-3}),
        ((BALL,), {"method": "tmatrix", "tolerance": 1e-2}, {"obstacles.x": 1e-3}),
    ],
)
def test_a_calibrated_scene_predicts_the_same_anywhere(
    obstacles: tuple[at.Obstacle, ...],
    settings: dict[str, object],
    names: dict[str, float] | None,
    tmp_path: Path,
) -> None:
    propagator = at.make_propagator(small_scene(obstacles), **settings)
    readings = readings_of(propagator.transfer_matrix())
    calibration = at.calibrate(propagator, readings, at.Prior(variants=names, rest=0.02), folds=0)
    loaded = saved_and_loaded(calibration, tmp_path)
    assert loaded.scene.equals(calibration.scene)
    assert loaded.amounts == calibration.amounts
    if names is not None:  # with its unit
        assert re.search(r"temperature .* K|obstacles\.x .* m", loaded.summary())
    for points in (None, ELSEWHERE):
        require_equal_predictions(calibration, loaded, points)


def test_the_file_has_every_field() -> None:
    parts = {
        at.Readings: calibration_file._OF_READINGS,
        MatrixPrior: calibration_file._OF_PRIOR,
        MatrixPosterior: ("prior", *calibration_file._OF_POSTERIOR),
        Magnitudes: calibration_file._OF_MAGNITUDES,
        at.Prior: ("transfer_matrix", "variants", *calibration_file._NUMBERS),  # the first is None
        CalibrationFit: ("posterior", "read", "drives", "unit", "converged"),
    }
    for kind, names in parts.items():
        assert {field.name for field in dataclasses.fields(kind)} == set(names)


def test_meshes_are_in_the_file(tmp_path: Path) -> None:
    mask = at.VoxelMask(np.ones((3, 2, 3), bool), 1e-3, origin=(10e-3, 12e-3, 12e-3), rigid=True)
    scene = dataclasses.replace(
        small_scene(), obstacles=(at.Mesh.from_surface(BALL.surface(), rigid=True), mask)
    )
    free = at.make_propagator(small_scene())
    calibration = at.calibrate(free, readings_of(free.transfer_matrix()), folds=0)
    simulation = dataclasses.replace(
        calibration.simulation, propagator=at.make_propagator(scene, "full", 2e-3)
    )
    loaded = saved_and_loaded(dataclasses.replace(calibration, simulation=simulation), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]
    assert loaded.simulation.scene.equals(scene)
    assert (loaded.simulation.propagator.method, loaded.simulation.propagator.spacing) == ("full", 2e-3)


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    matrix = at.make_propagator(small_scene()).transfer_matrix()
    path = tmp_path / "calibration.npz"
    at.save_calibration(path, at.calibrate(matrix, readings_of(matrix), folds=0))
    with np.load(path) as file:
        arrays = dict(file)
    arrays["simulated"][0, 0] += 1
    np.savez(path, **arrays)
    with pytest.raises(
        ValueError, match=r"calibration\.npz: arrays: missing or changed; must be as save_cal"
    ):
        at.load_calibration(path)
    at.save_readings(path, readings_of(matrix))
    with pytest.raises(ValueError, match="header: missing or damaged"):
        at.load_calibration(path)
    with pytest.raises(FileNotFoundError):
        at.load_calibration(tmp_path / "none.npz")


def test_propagators_of_users_are_not_saved(tmp_path: Path) -> None:
    class Mine:
        scene = small_scene()

        def transfer_matrix(self, points: torch.Tensor | None = None) -> torch.Tensor:
            return at.make_propagator(self.scene).transfer_matrix(points)

        def field(self, drive: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
            raise NotImplementedError

    calibration = at.calibrate(Mine(), readings_of(Mine().transfer_matrix()), folds=0)
    with pytest.raises(ValueError, match="'Mine'; must be one that make_propagator makes"):
        at.save_calibration(tmp_path / "a.npz", calibration)
