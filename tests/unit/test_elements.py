import math

import numpy as np
import pytest

from autdtorch.fdtd.assembly.elements import RIGID, Elements, elements_of, speed_factor
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Obstacle, Sphere
from autdtorch.scene.scene import Medium, OverlapWarning, Scene

AIR = Medium(density=1.293, sound_speed=340.0)
STENCIL = tuned_stencil(2 * math.pi / 8.5)
GRID = Grid(1e-3, interior=(10, 10, 10), origin=(-6.5e-3,) * 3, kappa=STENCIL.kappa)
"""Cells of 1 mm whose interior fills a cube of 10 mm from the origin on."""


def box(low: tuple[float, ...], high: tuple[float, ...], ratio: float = 77.0, speed: float = 1.0) -> Box:
    """Between two corners [mm]."""
    lower, upper = 1e-3 * np.array(low), 1e-3 * np.array(high)
    material = {"density": ratio * AIR.density, "sound_speed": speed * AIR.sound_speed}
    return Box(tuple((lower + upper) / 2), tuple(upper - lower), **material)


def filled(*obstacles: Obstacle) -> Elements:
    array = TransducerArray([[-0.9, 0.0, 0.0]], (1, 0, 0))
    scene = Scene(array, AIR, 40e3, [[0.9, 0.0, 0.0]], obstacles, domain=((-1, -1, -1), (1, 1, 1)))
    return elements_of(region_of(scene), GRID, STENCIL)


def element_centers() -> np.ndarray:
    """In mm."""
    axis = 1e3 * (GRID.centers[0][:-1] + GRID.spacing / 2)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def test_speed_of_a_material_is_tuned_to_its_own_wavenumber() -> None:
    # frequency of a plane wave of that material's wavenumber, averaged over directions, is the drive's
    assert speed_factor(STENCIL, 1.0) == pytest.approx(1, rel=1e-14)
    slow = speed_factor(STENCIL, 0.5)
    assert slow * STENCIL.isotropic_symbol(2 * STENCIL.kappa) == pytest.approx(STENCIL.symbol)
    # (c / c_air)^2 but for the grid's dispersion
    assert speed_factor(STENCIL, 4.0) == pytest.approx(16, rel=0.05)


def test_materials_are_relative_to_air_and_listed_once() -> None:
    medium = filled(
        box((1, 1, 1), (3, 3, 3)),
        Sphere((5e-3,) * 3, 1e-3, rigid=True),
        box((7, 7, 7), (9, 9, 9)),
    )
    assert medium.materials.density.tolist() == pytest.approx([1, 77, RIGID])
    assert medium.materials.mass.tolist() == pytest.approx([1, 1 / 77, 1 / RIGID])
    assert medium.rigid.tolist() == [False, False, True]


def test_elements_are_cut_that_a_surface_passes_and_only_those_around() -> None:
    radius, center = 2.7, np.array((5.1, 4.8, 5.3))
    medium = filled(Sphere(tuple(1e-3 * center), 1e-3 * radius, density=100.0, sound_speed=340.0))
    distance = np.linalg.norm(element_centers() - center, axis=-1) - radius
    assert ((medium.number == 1) == (distance < 0)).all()
    shifts = 0.5 - np.array(list(np.ndindex(2, 2, 2)))
    vertices = element_centers()[..., None, :] + shifts
    within = np.linalg.norm(vertices - center, axis=-1) < radius
    passed = within.any(axis=-1) & ~within.all(axis=-1)
    cut = np.zeros(medium.number.shape, bool)
    cut.ravel()[medium.cut] = True
    assert cut[passed].all()
    assert not cut[np.abs(distance) > math.sqrt(3) / 2 + 0.01].any()  # half the diagonal


def test_of_two_overlapping_obstacles_the_later_counts() -> None:
    wide, core = box((2, 2, 2), (8, 8, 8), ratio=10.0), box((4, 4, 4), (6, 6, 6), ratio=50.0)
    with pytest.warns(OverlapWarning):
        medium = filled(wide, core)
    off = np.abs(element_centers() - 5).max(axis=-1)
    assert (medium.number[off < 0.9] == 2).all()
    assert (medium.number[(off > 1.1) & (off < 2.9)] == 1).all()
    assert (medium.number[off > 3.1] == 0).all()
    with pytest.warns(OverlapWarning):
        covered = filled(core, wide)
    assert not (covered.number == 1).any()
    assert not (covered.elements.number == 1).any()


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_mass_is_that_of_the_volume(speed: float) -> None:
    """What an obstacle displaces; its elements hold it, and the uniform ones inside."""
    radius = 2.7
    medium = filled(
        Sphere((5.1e-3, 4.8e-3, 5.3e-3), 1e-3 * radius, density=10 * AIR.density, sound_speed=speed * 340.0)
    )
    masses = medium.materials.mass[medium.number].ravel()
    masses[medium.cut] = medium.elements.mass.sum(axis=1)
    displaced = (1 - masses).sum() / (1 - medium.materials.mass[1])
    # sub-cells of a quarter: 0.2 % measured
    assert displaced == pytest.approx(4 / 3 * math.pi * radius**3, rel=5e-3)


def test_a_wall_goes_on_through_the_boundary_layer_as_it_leaves_the_interior() -> None:
    wall = filled(box((4.3, -2e3, -2e3), (6, 2e3, 2e3)))
    assert (wall.number == wall.number[:, :1, :1]).all()
    number = wall.number[:, 0, 0]
    assert (number[GRID.first[0] + 4 : GRID.first[0] + 5] == 1).all()
    assert not number[: GRID.first[0] + 3].any()
    thin = filled(box((4.3, -1, -1), (6, 11, 9)))  # which ends before the interior does
    assert not thin.number[:, :, GRID.last[2] :].any()


@pytest.mark.parametrize("joint", [5.0, 5.2, 5.5])
def test_boxes_of_one_material_that_touch_are_one_box(joint: float) -> None:
    """Also where they touch in a plane of cell centres, which would be in neither."""
    one = filled(box((3, 3, 3), (7, 7, 7)))
    two = filled(box((3, 3, 3), (joint, 7, 7)), box((joint, 3, 3), (7, 7, 7)))
    assert (two.number == one.number).all()
    inside = np.isin(two.cut, one.cut, invert=True)  # cut by the joint alone
    assert inside.any()
    assert (two.elements.number[inside] == 1).all()
    assert np.allclose(two.elements.mass[inside], 1 / (8 * 77), rtol=1e-6)


@pytest.mark.parametrize("joint", [5.0, 5.5])
def test_boxes_of_two_materials_that_touch_leave_no_air_between_them(joint: float) -> None:
    medium = filled(box((2, 2, 2), (joint, 8, 8)), box((joint, 2, 2), (8, 8, 8), ratio=20.0))
    off = np.abs(element_centers() - (joint, 5, 5))
    held = np.isin(medium.cut, np.flatnonzero((off < (1, 2, 2)).all(axis=-1)))
    assert held.any()
    assert (medium.elements.number[held] > 0).all()


def test_no_obstacles_cut_nothing() -> None:
    medium = filled()
    assert not medium.number.any()
    assert len(medium.cut) == len(medium.elements.coupling) == 0
