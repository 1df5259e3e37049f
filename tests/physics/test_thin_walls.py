"""Walls thinner than a cell, oblique to the grid: rigid ones reflect, and a warning names all."""

import math

import pytest
import pyvista
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_scenes import relative_error, small_scene

from autdtorch.analytic.green import free_space_matrix
from autdtorch.fdtd.thin_walls import Thickened, thickened, thin_wall
from autdtorch.propagators import make_propagator
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Sphere

CENTER = (12.2e-3, 11.9e-3, 12.1e-3)
SPACING, SETTLED = 1e-3, 1e-3


@settings(max_examples=8, deadline=None)
@given(st.floats(0.02e-3, 0.3e-3), st.floats(0.003, 0.8), st.floats(0.2, 1.3), st.floats(-0.5e-3, 0.5e-3))
@example(0.1e-3, 0.01, 0.4, 0.0)  # nearly along the grid, both faces between two points of the lattice
def test_a_rigid_sheet_between_the_points_of_a_cell_is_there(thickness, tilt, about, place):
    rotation = tilt * math.cos(about), tilt * math.sin(about), 0.0
    center = (CENTER[0] + place, CENTER[1], CENTER[2] + place)
    scene = small_scene((Box(center, (11e-3, 10e-3, thickness), rotation, rigid=True),))
    held, turned = (
        make_propagator(scene, method, SPACING, SETTLED).transfer_matrix() for method in ("full", "box")
    )
    free = free_space_matrix(scene.control_points, scene.array, scene.complex_wavenumber)
    # a box turns its grid with the sheet. Of 60 the largest ratio was 0.43; sheets that are not seen have 1
    assert relative_error(held, turned) < 0.7 * relative_error(free, turned)


@pytest.mark.parametrize("material", [{"rigid": True}, {"density": 1e3, "sound_speed": 2e3}])
def test_a_thin_wall_oblique_to_the_grid_is_told(material, caplog):
    flat = Box(CENTER, (9e-3, 9e-3, 4e-3), **material)
    wall = Box((12e-3, 12e-3, 18e-3), (8e-3, 8e-3, 0.5e-3), (0.4, 0.2, 0.0), **material)
    make_propagator(small_scene((flat, wall)), "full", SPACING)
    assert "obstacle 1 has a wall of 0.5 mm" in caplog.text
    assert "thinner than a cell of 1 mm" in caplog.text
    assert "obstacle 0" not in caplog.text


def test_a_tilted_plate_that_the_grid_turns_with_is_not_told(caplog):
    make_propagator(small_scene((Box(CENTER, (8e-3, 8e-3, 0.5e-3), (0.4, 0.2, 0.0), rigid=True),)), "box")
    assert "thinner" not in caplog.text


@given(st.floats(0.1, 0.95), st.floats(0.3, 1.2))
def test_the_thickness_of_a_wall_is_measured(share, tilt):
    wall = Box(CENTER, (6e-3, 5e-3, share * SPACING), (tilt, 0.3, 0.0), rigid=True)
    thickness, place = thin_wall(wall, SPACING)
    assert thickness == pytest.approx(share * SPACING, rel=1e-6)
    assert wall.signed_distance(torch.from_numpy(place)).abs() < 1e-9


THICK = {
    "box": Box(CENTER, (4e-3,) * 3, rigid=True),
    "ball": Sphere(CENTER, 2e-3, rigid=True),
    "coin": Cylinder(CENTER, 3e-3, 2e-3, (1, 1, 0), rigid=True),
}


def test_walls_of_a_mesh_are_found_however_fine_it_is():
    wall = pyvista.Cube(x_length=9.0, y_length=8.0, z_length=0.4).triangulate()
    cone = pyvista.Cone(height=16.0, radius=6.0, resolution=60).triangulate()
    for times in (0, 3):
        fine, pointed = (
            Mesh.from_surface(body.subdivide(times, "linear") if times else body, scale=1e-3, rigid=True)
            for body in (wall, cone)
        )
        thickness, _ = thin_wall(fine, SPACING)
        assert thickness == pytest.approx(0.4e-3, rel=1e-6)
        assert thin_wall(pointed, SPACING) is None
        assert isinstance(thickened(fine, 2e-3), Thickened)
        assert thickened(pointed, 2e-3) is pointed


def test_needles_are_not_thickened():
    needle = Cylinder(CENTER, 0.15e-3, 12e-3, (1, 1, 0), rigid=True)
    assert thickened(needle, SPACING) is needle


@pytest.mark.parametrize("kind", THICK)
def test_thick_bodies_have_no_thin_wall(kind):
    assert thin_wall(THICK[kind], SPACING) is None
