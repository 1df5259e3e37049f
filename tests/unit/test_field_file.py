"""Fields in the whole domain and in files, whose folders are made."""

import math
from unittest import mock

import h5py
import numpy as np
import pytest
import torch
from small_scenes import CUBE, small_scene

import autdtorch as at
from autdtorch import hardware
from autdtorch.io.field_file import save_field
from autdtorch.scene.geometry import Plane

LENGTH = 1e-12  # rounding of lengths below 1 m in float64, with margin


def box_points():
    grid = ((0.1, 4), (0, 3), (-1, 2))
    axes = [start + 2e-3 * torch.arange(count, dtype=torch.float64) for start, count in grid]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def wave(points):
    return torch.polar(1 + points[..., 0], 300 * points @ torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))


def read_by_vtk(path):
    pyvista = pytest.importorskip("pyvista")
    return pyvista.ImageData(str(path))


NORMALS = {"facing x": (1, 0, 0), "facing -x": (-1, 0, 0), "facing y": (0, 1, 0), "tilted": (1, 2, 3)}
PLANES = {name: Plane((0.08, 0.05, 0.05), normal, (0.04, 0.02)) for name, normal in NORMALS.items()}


@pytest.mark.parametrize(
    "points",
    [box_points(), box_points()[:, 1:2], *(plane.points(5e-3) for plane in PLANES.values())],
    ids=["box", "slice", *PLANES],
)
def test_vtk_finds_every_value_at_its_point(tmp_path, points):
    pressure = wave(points)
    save_field(tmp_path / "field.vti", pressure, points, frequency=40e3)
    image = read_by_vtk(tmp_path / "field.vti")
    assert image.n_points == pressure.numel()
    ours = points.reshape(-1, 3).numpy()
    nearest = [image.find_closest_point(point) for point in ours]
    np.testing.assert_allclose(np.asarray(image.points)[nearest], ours, rtol=0, atol=LENGTH)
    read = image.point_data["pressure_real"] + 1j * image.point_data["pressure_imag"]
    np.testing.assert_array_equal(read[nearest], pressure.reshape(-1).numpy())
    np.testing.assert_array_equal(image.point_data["pressure_magnitude"], np.abs(read))
    assert image.field_data["frequency"].tolist() == [40e3]


def test_vtk_gets_x_fastest_and_planes_along_coordinates_without_directions(tmp_path):
    save_field(tmp_path / "box.vti", wave(box_points()), box_points(), frequency=40e3)
    save_field(tmp_path / "plane.vti", wave(p := PLANES["facing -x"].points(5e-3)), p, frequency=40e3)
    box, plane = read_by_vtk(tmp_path / "box.vti"), read_by_vtk(tmp_path / "plane.vti")
    assert (box.dimensions, box.spacing) == ((4, 3, 2), pytest.approx((2e-3,) * 3))
    flat = wave(box_points()).numpy().ravel(order="F")
    np.testing.assert_array_equal(box.point_data["pressure_real"], flat.real)
    # Facing -x, (u, v) is (y, -z): 8 points along y, 4 along z.
    assert plane.dimensions == (1, 8, 4)
    np.testing.assert_array_equal(plane.direction_matrix, np.eye(3))


@pytest.mark.parametrize("points", [box_points(), PLANES["tilted"].points(5e-3)], ids=["box", "tilted"])
def test_hdf5_says_where_its_values_are(tmp_path, points):
    pressure = wave(points)
    save_field(tmp_path / "field.h5", pressure, points, frequency=40e3)
    with h5py.File(tmp_path / "field.h5", "r") as file:
        data = file["pressure"]
        np.testing.assert_array_equal(data[()], pressure.numpy())
        about = dict(data.attrs)
    index = np.moveaxis(np.indices(pressure.shape), 0, -1)
    found = about["origin"] + (index * about["spacing"]) @ about["axes"]
    np.testing.assert_allclose(found, points.numpy(), rtol=0, atol=LENGTH)
    assert (about["units"], about["length_units"], about["frequency_units"]) == ("Pa", "m", "Hz")
    assert (about["frequency"], about["time_convention"]) == (40e3, "exp(-i omega t)")


SHEAR = torch.tensor([[1.0, 0, 0], [1, 1, 0], [0, 0, 1]]).double()
LINE = box_points()[:, :1, :1]


def bent(points):
    moved = points.clone()
    moved[1, 1, 1] += 1e-6
    return moved


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"path": "field.vtk"}, r"path: .*field.vtk'; must end in one of .vti, .h5, .hdf5"),
        ({"points": bent(box_points())}, r"points: must be a regular grid with right angles"),
        ({"points": box_points() @ SHEAR}, "right angles"),
        ({"points": 0 * box_points()}, r"points: two coincide"),
        ({"points": box_points().reshape(-1, 3)}, r"points: shape \(24, 3\); must be \(Nx, Ny, Nz, 3\)"),
        ({"pressure": wave(box_points())[0]}, r"pressure: shape \(3, 2\); must be \(4, 3, 2\) as the points"),
        ({"pressure": wave(box_points()).abs()}, r"pressure: .*must be an array of complex numbers"),
        ({"points": LINE, "pressure": wave(LINE)}, r"must have two axes"),
        ({"frequency": math.nan}, r"frequency: nan Hz"),
    ],
)
def test_what_is_no_field_on_a_grid_is_refused(tmp_path, changes, message):
    field = {"path": "field.vti", "pressure": wave(box_points()), "points": box_points(), "frequency": 40e3}
    field |= changes
    with pytest.raises(ValueError, match=message):
        save_field(tmp_path / field.pop("path"), **field)


def test_a_volume_is_the_field_outside_obstacles_and_away_from_transducers():
    ball = at.Sphere((40e-3, 40e-3, 40e-3), 9e-3, rigid=True)
    scene = small_scene((ball,), extent=80e-3)
    propagator = at.make_propagator(scene, method="free_space")
    drive = at.drive_from_phases(torch.linspace(0, 3, 4))
    volume = at.volume_field(propagator, drive, spacing=5e-3)
    assert volume.shape == (16, 16, 16)

    centre = torch.tensor(scene.domain[0], dtype=torch.float64) + 5e-3 * (torch.tensor([12, 3, 7]) + 0.5)
    wanted = propagator.field(drive, centre[None])[0]
    torch.testing.assert_close(volume[12, 3, 7], wanted)

    centres = np.stack(np.meshgrid(*[2.5e-3 + 5e-3 * np.arange(16)] * 3, indexing="ij"), axis=-1)
    near = torch.cdist(torch.from_numpy(centres).reshape(-1, 3), scene.array.positions).amin(dim=1)
    left_out = (near <= scene.wavelength / 2).reshape(16, 16, 16) | ball.contains(centres)
    assert left_out.any()
    assert torch.equal(volume.isnan(), left_out)


def test_a_volume_refuses_several_drives_and_too_many_cells():
    propagator = at.make_propagator(small_scene(extent=80e-3))
    drive = at.drive_from_phases(torch.zeros(4))
    with pytest.raises(ValueError, match=r"drive: shape .* a single drive"):
        at.volume_field(propagator, drive.expand(2, -1))
    with pytest.raises(ValueError, match=r"spacing: 0\.0001 m; gives \[800, 800, 800\] cells"):
        at.volume_field(propagator, drive, spacing=1e-4)


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


def test_a_file_that_vtk_cannot_write_is_named_with_the_reason(tmp_path, monkeypatch):
    writer = mock.Mock(**{"return_value.Write.return_value": 0})
    monkeypatch.setattr("vtkmodules.vtkIOXML.vtkXMLImageDataWriter", writer)
    points = Plane((0, 0, 0), (0, 0, 1), (2e-3, 2e-3)).points(1e-3)
    pressure = torch.zeros(points.shape[:-1], dtype=torch.complex128)
    with pytest.raises(OSError, match=r"VTK could not write it.*field\.vti"):
        save_field(tmp_path / "field.vti", pressure, points, 40e3)
    assert not list(tmp_path.iterdir())
