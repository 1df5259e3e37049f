"""Bodies on, across and between reflectors: equal to bodies and sources written out with their images.

Boxes have cells of 1 mm, 8.6 a wavelength; their error beside a sphere is as in `test_reflectors.py`.
"""

from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_scenes import relative_error

import autdtorch as at
from autdtorch.propagators import make_propagator

AIR = at.Medium(1.2, 343.0)
RADIUS = 4e-3
FLOOR = at.Reflector((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
SOURCES = [[-30e-3, 3e-3, 12e-3], [-25e-3, -14e-3, 30e-3]]
POINTS = [[30e-3, 5e-3, 10e-3], [20e-3, -20e-3, 22e-3], [24e-3, 11e-3, 2e-3], [-4e-3, 15e-3, 28e-3]]


def room(obstacles, reflectors, sources=SOURCES, points=POINTS):
    array = at.TransducerArray(sources, (1.0, 0.0, 0.0), radius=0)
    return at.Scene(array, AIR, 40e3, points, obstacles, reflectors=reflectors)


def with_mirrored_sources(scene, reflection=1.0, obstacles=None):
    """The matrix of a scene in front of the floor from sources and their images, and bodies written out."""
    (array, points), flip = (scene.array, scene.control_points), torch.tensor([1.0, 1.0, -1.0])
    both = at.TransducerArray(torch.cat([array.positions, array.positions * flip]), (1, 0, 0), radius=0)
    apart = at.Scene(both, AIR, 40e3, points, obstacles)
    matrix = make_propagator(apart, "box", 1.3e-3, tolerance=1e-4).transfer_matrix()
    direct, images = matrix.split(len(array), dim=1)
    return direct + reflection * images


@pytest.mark.parametrize(("center", "reflection"), [(0.0, 1.0), (4e-3, 1.0), (4e-3, -1.0), (4.7e-3, -1.0)])
def test_a_box_on_a_plane_is_the_box_of_twice_the_height(center, reflection):
    """Cut at its middle, flush with the plane, or 0.7 mm in front of it: the same cells, another rounding."""
    box = at.Box((0.0, 0.0, center), (9e-3, 12e-3, 8e-3), rigid=True)
    floor = replace_reflection(reflection)
    matrix = make_propagator(room([box], [floor]), "box", 1.3e-3, tolerance=1e-4).transfer_matrix()
    if center <= 4e-3:
        bodies = [at.Box((0.0, 0.0, 0.0), (9e-3, 12e-3, 2 * center + 8e-3), rigid=True)]
    else:
        bodies = [box, at.Box((0.0, 0.0, -center), box.size, rigid=True)]
    written = with_mirrored_sources(room([box], [floor]), reflection, bodies)
    assert relative_error(matrix, written) < 1e-3
    if (center, reflection) == (4e-3, 1.0):
        full = make_propagator(room([box], [floor]), "full", 1.3e-3, tolerance=1e-3).transfer_matrix()
        # the grid's error in air between source and box
        assert relative_error(matrix, full) < 5e-3


def replace_reflection(reflection):
    return at.Reflector(FLOOR.point, FLOOR.normal, reflection)


@pytest.mark.parametrize("depth", [0.0, 3e-3])
def test_tilted_bodies_that_touch_or_cross_a_plane(depth):
    """Box and full agree within what they claim."""
    tilted = at.Box((0.0, 0.0, 0.0), (10e-3, 12e-3, 5e-3), (0.3, 0.4, 0.2), rigid=True)
    body = at.Box((0.0, 0.0, -tilted.lower[2] - depth), tilted.size, tilted.rotation, rigid=True)
    near = [[-18e-3, 3e-3, 12e-3], [-15e-3, -14e-3, 20e-3]], [[18e-3, 5e-3, 10e-3], [14e-3, -16e-3, 18e-3]]
    scene = room([body], [FLOOR], *near)
    (box, claimed), (full, other) = (
        make_propagator(scene, way, 1.3e-3).transfer_matrix(return_error=True) for way in ("box", "full")
    )
    assert relative_error(box, full) < claimed + other
    assert claimed < 0.03


SHELF = at.Reflector((0.0, 0.0, 31e-3), (0.0, 0.0, -1.0), 0.1)
WALL = at.Reflector((-45e-3, 0.0, 0.0), (1.0, 0.0, 0.0))
NEAR_WALL = at.Reflector((-5e-3, 0.0, 0.0), (1.0, 0.0, 0.0), -1.0)
BEFORE = [[20e-3, 30e-3, 12e-3], [25e-3, 28e-3, 20e-3]]
ROOMS = {
    "two bodies, one near": ([(0, 0, 5e-3), (0, 40e-3, 25e-3)], [FLOOR], {}),
    "corner": ([(0, 0, 5e-3)], [FLOOR, WALL], {}),
    "in a corner": (
        [(0, 0, 5e-3)],
        [FLOOR, NEAR_WALL],
        {"sources": BEFORE, "points": [[30e-3, 5e-3, 10e-3], [20e-3, -20e-3, 22e-3]]},
    ),
    "between two planes, near one": ([(0, 0, 5e-3)], [SHELF, FLOOR], {}),
}


@pytest.mark.parametrize("name", ROOMS)
def test_boxes_are_t_matrices(name):
    """T-matrices of rigid spheres are exact; in free space boxes of 1 mm are 0.63 % off."""
    centers, reflectors, places = ROOMS[name]
    scene = room([at.Sphere(each, RADIUS, rigid=True) for each in centers], reflectors, **places)
    exact = make_propagator(scene, "tmatrix", 1e-3, tolerance=1e-4).transfer_matrix()
    matrix, error = make_propagator(scene, "box", 1e-3).transfer_matrix(return_error=True)
    true = relative_error(matrix, exact)
    assert true < 9e-3
    assert true < 3 * error


def test_spheres_of_air_each_near_one_of_two_planes_change_nothing():
    """Readings are means over both planes' images; their series ends at different places, within 1e-4."""
    roof = at.Reflector((0.0, 0.0, 47.5e-3), (0.0, 0.0, -1.0), -1.0)
    air = {"density": AIR.density, "sound_speed": AIR.sound_speed}
    spheres = [at.Sphere(place, RADIUS, **air) for place in ((0, 0, 5e-3), (3e-3, 40e-3, 42.5e-3))]
    empty, matrix = (
        make_propagator(room(bodies, [FLOOR, roof]), method, 1e-3).transfer_matrix()
        for bodies, method in (([], "auto"), (spheres, "box"))
    )
    assert relative_error(matrix, empty) < 2e-4


def test_a_column_between_two_planes_is_refused():
    column = at.Box((0.0, 0.0, 8e-3), (6e-3, 6e-3, 16e-3), rigid=True)
    roof = at.Reflector((0.0, 0.0, 16e-3), (0.0, 0.0, -1.0))
    scene = room([column], [FLOOR, roof], [[-30e-3, 3e-3, 12e-3]], [[30e-3, 5e-3, 10e-3]])
    with pytest.raises(ValueError, match="face each other; or take a rigid Box"):
        make_propagator(scene, "box", 1e-3).transfer_matrix()


FACTORS = st.sampled_from([1.0, -1.0, 0.5, 0.3 + 0.4j])


@st.composite
def rooms(draw):
    """One to three planes at right angles or two facing ones, and one or two bodies, on a plane or apart."""
    planes = draw(st.sampled_from(["xyz", "xy", "z", "facing"]))
    corner = {"x": (-32e-3, 0.0, 0.0), "y": (0.0, -34e-3, 0.0), "z": (0.0, 0.0, 0.0)}
    names = "z" if planes == "facing" else planes
    reflectors = [at.Reflector(corner[name], np.eye(3)["xyz".index(name)], draw(FACTORS)) for name in names]
    if planes == "facing":
        reflectors.append(at.Reflector((0.0, 0.0, 47.5e-3), (0, 0, -1), draw(st.sampled_from([0.1, 0.3j]))))
    sharp = "z" in names and reflectors[names.index("z")].reflection in (1, -1)
    height = draw(st.sampled_from([0.0, 2e-3, 4e-3, 8e-3])) if sharp else 15e-3  # of the body's centre
    turn = tuple(draw(st.floats(-0.5, 0.5)) for _ in range(3)) if draw(st.booleans()) else (0.0, 0.0, 0.0)
    bodies = [at.Box((0.0, 0.0, height), (7e-3, 9e-3, 8e-3), turn, rigid=True)]
    if draw(st.booleans()):
        place = 3e-3, 18e-3, draw(st.floats(15e-3, 25e-3))
        bodies.append(at.Sphere(place, RADIUS, density=3.0 + 1.2j, sound_speed=240.0 - 60j))
    return bodies, reflectors


CUT = at.Box((0.0, 0.0, 4e-3), (7e-3, 9e-3, 8e-3), (0.0, 0.458, -0.45), rigid=True)
"""A body whose grid is not its own image in the floor."""
SOFT = replace_reflection(-1.0)


def one_way(obstacles, reflectors, spacing=1e-3):
    """The change when sources and points change places, relative to the field or to that in free space."""
    one, other = (
        [[-25e-3, 3e-3, 12e-3], [-22e-3, -14e-3, 30e-3]],
        [[25e-3, 5e-3, 10e-3], [20e-3, -18e-3, 22e-3]],
    )
    forth, back = (
        make_propagator(room(obstacles, reflectors, *places), "box", spacing).transfer_matrix()
        for places in ((one, other), (other, one))
    )
    free = make_propagator(room([], [], one, other)).transfer_matrix()
    return (forth - back.mT).norm() / max(free.norm(), forth.norm())


@settings(max_examples=2)  # the first is always the simplest
@given(scene=rooms())
@example(scene=([CUT], [SOFT, at.Reflector((0.0, 0.0, 47.5e-3), (0.0, 0.0, -1.0), 0.3j)]))
def test_reciprocity(scene):
    assert one_way(*scene, 1.3e-3) < 1e-3


def test_reciprocity_of_boxes_of_which_one_holds_its_image():
    """Measured: 5e-5, of the Huygens surfaces; 1e-3 if the grid's images drive the other box as they are."""
    far = at.Sphere((0.0, 50e-3, 32e-3), 5e-3, rigid=True)
    assert one_way([CUT, far], [SOFT], 1e-3) < 2e-4


@pytest.mark.parametrize(("turn", "wall"), [((-0.6, -0.2, -0.5), 17e-3), ((0.1, -0.8, 0.4), 18e-3)])
def test_no_corner_of_a_turned_grid_reaches_a_plane_that_it_cannot_hold(turn, wall):
    """Of the body's own grid, and of that with its image in the floor, which turns along other faces."""
    body = at.Box((0.0, 0.0, 4e-3), (6e-3, 14e-3, 8e-3), turn, rigid=True)
    absorbing = at.Reflector((-wall, 0.0, 0.0), (1.0, 0.0, 0.0), 0.5)
    scene = room([body], [FLOOR, absorbing], [[30e-3, 3e-3, 12e-3]], [[25e-3, 20e-3, 10e-3]])
    (box,) = make_propagator(scene, "box", 1.4e-3).simulation.boxes
    assert (box.radiating[:, 0] > -wall).all()


def test_scenes_that_differ_in_a_reflector_share_no_result(tmp_path):
    sphere, facing = (
        at.Sphere((0.0, 0.0, 9e-3), RADIUS, rigid=True),
        at.Reflector((0, 0, 45e-3), (0, 0, -1), 0.1),
    )
    choices = [
        (), (FLOOR,), (at.Reflector((0, 0, 0), (0, 0, 1), -1.0),), (at.Reflector((0, 0, -1e-3), (0, 0, 1)),),
        (at.Reflector((0, 0, 0), (0, 0.01, 1)),), (FLOOR, facing),
    ]  # fmt: skip
    for method, planes in (("box", choices), ("tmatrix", choices[:3])):
        kept, alone = (
            [
                make_propagator(room([sphere], each), method, 2e-3, cache=cache).transfer_matrix()
                for each in planes
            ]
            for cache in (tmp_path, False)
        )
        assert all(torch.equal(one, other) for one, other in zip(kept, alone, strict=True))
        assert all(relative_error(one, other) > 1e-3 for one, other in combinations(kept, 2))
