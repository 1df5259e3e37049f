import math

import h5py
import numpy as np
import pytest
import torch

from autdtorch.io.field_file import save_field
from autdtorch.scene.geometry import Plane

LENGTH = 1e-12  # rounding of lengths below 1 m in float64, with margin


def box_points():
    grid = ((0.1, 4), (0, 3), (-1, 2))
    axes = [start + 2e-3 * torch.arange(count, dtype=torch.float64) for start, count in grid]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def wave(points):
    """Return a field with a different value at every point."""
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
