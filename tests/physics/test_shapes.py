"""Spheres, thin plates, slits, corners, needles and voxels at cells of 1 mm."""

from dataclasses import replace

import pytest
import pyvista as pv
from shared.families import scene_of
from small_scenes import AIR, matrix_of_sphere, relative_error, small_scene

from autdtorch.propagators import make_propagator
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Mesh, Sphere
from autdtorch.scene.scene import Scene

CENTER, RADIUS, RATIO = (12.2e-3, 11.9e-3, 12.1e-3), 3.3e-3, 77.0


def sphere_scene(rigid):
    if rigid:
        return small_scene((Sphere(CENTER, RADIUS, rigid=True),))
    return small_scene((Sphere(CENTER, RADIUS, density=RATIO * AIR.density, sound_speed=AIR.sound_speed),))


def scattered_error(scene, spacing):
    simulated = make_propagator(scene, "full", spacing, tolerance=1e-4).transfer_matrix()
    whole = matrix_of_sphere(scene)
    size = float(matrix_of_sphere(scene, scattered=True).norm() / whole.norm())
    return relative_error(simulated, whole) / size


@pytest.mark.parametrize("ratio", [65.0, 100.0])
def test_balls_keep_their_resonances(ratio):
    """Sound in the ball is as fast as in air, so that it resonates: finite elements would displace that."""
    middle = (0.4e-3, -0.3e-3, 0.2e-3)
    ball = Sphere(middle, 8e-3, density=ratio * AIR.density, sound_speed=AIR.sound_speed)
    array = TransducerArray(((20e-3, 5e-3, 0.0), (-14e-3, 16e-3, 9e-3)), (1.0, 0.0, 0.0))
    scene = Scene(array, AIR, 40e3, ((-3e-3, -19e-3, 6e-3), (10e-3, 2e-3, -25e-3)), (ball,))
    error = relative_error(make_propagator(scene, "box", 1.2e-3).transfer_matrix(), matrix_of_sphere(scene))
    # measured 1.6 and 0.7 %; finite elements have 6.5 % at the first ratio
    assert error < 0.02


@pytest.mark.parametrize("rigid", [True, False])
def test_the_error_of_a_sphere_is_of_second_order(rigid):
    scene = sphere_scene(rigid)
    coarse, fine = scattered_error(scene, 1.3e-3), scattered_error(scene, 0.65e-3)
    # Half the spacing divides the error by 4, apart from the sphere's place between the cells: measured 3.7
    # and 5.6. First order, as of staircases, would be 2.
    assert fine < coarse / 3
    # Of the scattered wave; 3.8 % at 1 mm, and the bound leaves a third more.
    assert fine < 0.022


@pytest.mark.parametrize("rigid", [True, False])
def test_spheres_merged_into_one_mesh_are_their_union(rigid):
    material = {"rigid": True} if rigid else {"density": 100.0, "sound_speed": 340.0}
    places = (12e-3, 10.5e-3, 12e-3), (12.5e-3, 14e-3, 11e-3)
    spheres = [pv.Icosphere(radius=RADIUS, center=place, nsub=3) for place in places]
    apart = [Mesh.from_surface(sphere, **material) for sphere in spheres]
    merged = Mesh.from_surface(spheres[0].append_polydata(spheres[1]), **material)
    exact = [Sphere(place, RADIUS, **material) for place in places]
    joined, union, round_ = (
        make_propagator(small_scene(obstacles), "full", 1.2e-3).transfer_matrix()
        for obstacles in ([merged], apart, exact)
    )
    # Measured: 1e-5 and 0.4 % if rigid, 0.1 and 1 % if not. With triangles inside the union, 10 % and more.
    assert relative_error(joined, union) < 5e-3
    assert relative_error(joined, round_) < 0.02


FINE, SETTLED = 0.65e-3, 1e-3


@pytest.mark.parametrize("family", ["plate", "slit", "corner", "needle"])
def test_what_is_thinner_than_a_cell_is_right(family):
    """Measured on 200 scenes: 95 % are within 2 % at 1 mm; the finer grid errs by a third of that."""
    scene, _ = scene_of(family, 0)
    found, fine = (make_propagator(scene, "box", h, SETTLED).transfer_matrix() for h in (1e-3, FINE))
    assert relative_error(found, fine) < 0.02


# Count, pitch, width and depth [mm], length [mm] of bars, and density and sound speed relative to air
GRATINGS = {
    "heavy": (7, 3.045, 1.7, 1.99, 12.05, 413.0, 1.88),
    "three thin": (3, 2.34, 0.66, 1.35, 8.97, 110.0, 2.34),
    "light": (5, 3.79, 1.61, 1.15, 10.19, 20.0, 2.39),
}


@pytest.mark.parametrize(("kind", "spacing"), [("heavy", 1.2e-3), ("three thin", 1.7e-3), ("light", 1.7e-3)])
def test_gratings_of_fluid_bars_about_a_cell_apart(kind, spacing):
    """Measured: 0.9 to 1.5 %. With the edges fitted together, 4.7 to 10 %."""
    count, pitch, width, depth, length, ratio, speed = GRATINGS[kind]
    size = (1e-3 * width, 1e-3 * length, 1e-3 * depth)
    material = {"density": ratio * AIR.density, "sound_speed": speed * AIR.sound_speed}
    bars = [Box((1e-3 * pitch * (n - (count - 1) / 2), 0.0, 0.0), size, **material) for n in range(count)]
    places = ((3.1e-3, 6.4e-3, -25e-3), (-3.7e-3, -3.4e-3, -25e-3), (2.1e-3, 1e-3, -25e-3))
    points = ((-2.2e-3, -2.2e-3, 10.2e-3), (-7.6e-3, 3.7e-3, 10.7e-3), (-1.1e-3, -3e-3, 7.5e-3))
    scene = Scene(TransducerArray(places, (0.0, 0.0, 1.0)), AIR, 40e3, points, bars)
    matrix, fine = (make_propagator(scene, "box", h, SETTLED).transfer_matrix() for h in (spacing, 0.55e-3))
    assert relative_error(matrix, fine) < 0.025


@pytest.mark.parametrize(
    "material", [{"density": 20.0 * AIR.density, "sound_speed": 1.2 * AIR.sound_speed}, {"rigid": True}]
)
def test_a_slit_between_planes_of_cells_is_as_right_as_one_that_holds_a_plane(material):
    """Cells of 1.2 mm have a plane in one of the two slits. Measured: 1.1 and 1.6 %. Fluids err by 9 % if
    waves along a slit have the mass of those across it, and rigid bodies by 30 % if it is closed."""
    plates = [(-4.67e-3, 3.45e-3), (0.0, 4.83e-3), (5.27e-3, 4.52e-3)]
    bodies = [Box((place, 0.0, 0.0), (width, 11e-3, 2.17e-3), **material) for place, width in plates]
    array = TransducerArray(((3e-3, 6e-3, -16e-3), (-4e-3, -3e-3, -16e-3)), (0.0, 0.0, 1.0))
    scene = Scene(array, AIR, 40e3, ((-2e-3, -2e-3, 10e-3), (5e-3, 4e-3, 9e-3)), bodies)
    matrix, fine = (make_propagator(scene, "box", h, SETTLED).transfer_matrix() for h in (1.2e-3, 0.45e-3))
    assert relative_error(matrix, fine) < 0.025


def test_claims_hold_against_exact_series():
    """Required: no tolerance missed, 3 of 4 claims within a factor of 3; of many scenes 95 % are."""
    near = 0
    for family, seed in (("sphere", 2), ("sphere", 3), ("shell", 2), ("voxels", 3)):
        scene, exact = scene_of(family, seed)
        propagator = make_propagator(scene, "box", None, tolerance=0.03, cache=False)
        matrix, claimed = propagator.transfer_matrix(return_error=True)
        true = relative_error(matrix, exact)
        assert true < 0.03
        near += true / 3 < claimed < 3 * true
    assert near >= 3


def test_smooth_voxels_are_nearer_to_a_ball_than_cubes():
    scene, exact = scene_of("voxels", 1)
    (mask,) = scene.obstacles
    errors = [
        relative_error(
            make_propagator(replace(scene, obstacles=(body,)), "box", 1e-3, SETTLED).transfer_matrix(), exact
        )
        for body in (mask, replace(mask, smooth=False))
    ]
    assert errors[0] < 0.02
    assert errors[1] > 2 * errors[0]
