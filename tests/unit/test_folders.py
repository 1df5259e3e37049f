"""Every function that saves a file makes its folder."""

import pytest
import torch
from small_scenes import CUBE, small_scene

import autdtorch as at
from autdtorch import hardware

SCENE = small_scene((CUBE,))
DRIVE = torch.ones(4, dtype=torch.complex128)
PLANE = at.Plane((20e-3, 12e-3, 12e-3), (1, 0, 0), (4e-3, 4e-3))


def save_state(path):
    method = at.GABS()
    at.save_state(path, method, method.start(at.Problem(transducers=4, foci=1)))


def save_operator(path):
    matrix = torch.diag(torch.ones(4, dtype=torch.complex128))
    at.TMatrix(matrix, 700.0 + 0j, 1e-3, torch.zeros(3).double(), torch.eye(3).double()).save(path)


def log(path):
    hardware.EvaluationLog(path, {}, 4, 1).append(DRIVE, torch.ones(1, dtype=torch.float64), 1.0)


SAVERS = {
    "scene.yaml": lambda path: at.save_scene(path, SCENE),
    "drive.csv": lambda path: at.save_drive(path, DRIVE, SCENE.array),
    "drive.npz": lambda path: at.save_drive(path, DRIVE, SCENE.array),
    "field.vti": lambda path: at.save_field(path, torch.ones((2, 2)) + 0j, PLANE.points(2e-3), frequency=4e4),
    "field.h5": lambda path: at.save_field(path, torch.ones((2, 2)) + 0j, PLANE.points(2e-3), frequency=4e4),
    "scene.png": lambda path: at.plot_scene(SCENE).savefig(path),
    "view.png": lambda path: at.view3d(SCENE, save=path).close(),
    "view.gltf": lambda path: at.view3d(SCENE, save=path).close(),
    "state.npz": save_state,
    "operator.npz": save_operator,
    "log.jsonl": log,
}


@pytest.mark.parametrize("name", SAVERS)
def test_the_folder_of_a_file_is_made(tmp_path, name):
    path = tmp_path / "new" / "one" / name
    SAVERS[name](path)
    assert path.stat().st_size > 0


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(OSError, match="taken"):
        at.save_scene(tmp_path / "taken" / "scene.yaml", SCENE)
