"""Estimates of error, method and cost, and the spacings that are chosen by them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import pyvista
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import AIR, matrix_of_sphere, relative_error, small_scene

import autdtorch as at
from autdtorch.fdtd.grid_errors import Law, errors_by_grids, grid_errors, rigid_errors
from autdtorch.fdtd.region import RATIO
from autdtorch.propagators import FreeSpacePropagator, make_propagator
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.propagators.plan import plan, region_of, with_rigid
from autdtorch.scene.obstacles import Cylinder, Sphere, VoxelMask

CENTER, RADIUS = (12.2e-3, 11.9e-3, 12.1e-3), 3.3e-3
RIGID = Sphere(CENTER, RADIUS, rigid=True)
HEAVY = Sphere(CENTER, RADIUS, density=10 * AIR.density, sound_speed=1.5 * AIR.sound_speed)
EMPTY = small_scene()
LAW = Law(1.0, aligned=False)


def ball(radius, ratios):
    """A sphere of a density and sound speed relative to air, or a rigid one."""
    if ratios is None:
        return Sphere(CENTER, radius, rigid=True)
    density, speed = ratios
    return Sphere(CENTER, radius, density=density * AIR.density, sound_speed=speed * AIR.sound_speed)


@pytest.mark.parametrize("sphere", [RIGID, HEAVY], ids=["rigid", "heavy"])
@pytest.mark.parametrize(("method", "spacing"), [("full", 1.8e-3), ("box", 1e-3)])
def test_the_estimate_is_honest(sphere, method, spacing):
    """Required: within a factor of 3 of the true error, or above it."""
    scene = small_scene((sphere,))
    matrix, error = make_propagator(scene, method, spacing, tolerance=1e-3).transfer_matrix(return_error=True)
    true = relative_error(matrix, matrix_of_sphere(scene))
    assert true / 3 < error < 20 * true


@pytest.mark.filterwarnings("ignore::autdtorch.ScaleWarning")  # of a light fluid of a low sound speed
@pytest.mark.parametrize(("spacing", "factor"), [(0.377e-3, 3), (0.496e-3, 4)])
def test_a_resonance_narrower_than_its_shift_on_both_grids_is_claimed(spacing, factor):
    """Required: within a factor. Where it is next to the drive's frequency, it is on neither grid.

    Its width is 0.4 %, and the grids shift it by 6 and 2 %: they agree to 0.5 % and are 9 % off. On cells of
    0.5 mm it moves too far to be the same resonance on both, and only its usual shift is known.
    """
    center, radius, density, speed = (-0.65e-3, 0.12e-3, 1.77e-3), 2.344e-3, 0.2384, 0.35145
    air = at.Medium(1.2, 343.0)
    ball = Sphere(center, radius, density=density * air.density, sound_speed=speed * air.sound_speed)
    array = at.TransducerArray([[20e-3, 0, 10e-3], [-15e-3, 18e-3, 0], [0, -22e-3, -9e-3]], (1, 0, 0))
    points = [[-20e-3, -6e-3, 12e-3], [8e-3, 24e-3, -7e-3], [5e-3, 3e-3, 27e-3]]
    scene = at.Scene(array, air, 40e3, points, [ball])
    matrix, error = make_propagator(scene, "box", spacing, tolerance=1e-3).transfer_matrix(return_error=True)
    true = relative_error(matrix, matrix_of_sphere(scene))
    assert true > 0.03  # the resonance is there
    assert true / factor < error < factor * true


@pytest.mark.filterwarnings("ignore::autdtorch.ScaleWarning")  # of a light fluid of a low sound speed
def test_resonances_in_several_boxes_are_claimed():
    """Required: within a factor of 3. Two balls apart, as in the test before; 1 % was claimed at 17 %."""
    gas = {"density": 0.2384 * AIR.density, "sound_speed": 0.35145 * AIR.sound_speed}
    places = CENTER, (CENTER[0], CENTER[1], 70e-3)
    balls = [Sphere(place, radius, **gas) for place, radius in zip(places, (2.31e-3, 2.28e-3), strict=True)]
    scene = at.Scene(EMPTY.array, AIR, 40e3, EMPTY.control_points, balls)
    exact = make_propagator(scene, "tmatrix", None, tolerance=1e-5).transfer_matrix()
    propagator = make_propagator(scene, "box", 0.377e-3, tolerance=1e-3)
    matrix, error = propagator.transfer_matrix(return_error=True)
    true = relative_error(matrix, exact)
    assert len(propagator.plan.grouping.grids) == 2
    assert true > 0.03  # the resonances are there
    assert true / 3 < error < 3 * true


@pytest.mark.filterwarnings("ignore::autdtorch.ScaleWarning")  # of a light fluid with a high sound speed
@pytest.mark.parametrize(
    ("radius", "ratios"), [(1.8e-3, None), (5e-3, None), (6e-3, (0.7, 10.0)), (4e-3, (4.0, 1.0))]
)
def test_the_usual_error_is_that_of_spheres_of_any_size_and_density(radius, ratios):
    """Elsewhere, rigid spheres of 1.4 to 7 mm have 0.5 to 1.0 times this error, fluid ones 0.2 to 2 times.

    Stiff balls of air's density had a tenth of it before their small kinks counted.
    """
    scene = small_scene((ball(radius, ratios),))
    law, series = plan(scene, "box", 1e-3).law, matrix_of_sphere(scene)
    free = free_space_matrix(scene.control_points, scene.array, scene.wavenumber)
    error = (make_propagator(scene, "box", 1e-3, tolerance=1e-4).transfer_matrix() - series).norm()
    share = float(error / (series - free).norm())
    assert 1 / 3 < share / law.usual(1e-3) < 3


@pytest.mark.parametrize("radius", [0.5e-3, 2e-3, 4e-3])
def test_what_heavy_balls_differ_from_rigid_ones_is_claimed(radius):
    """Required: a third to 12 times it; 40 random balls had 0.7 to 8 times, once up to 10,000 times."""
    scenes = [small_scene((ball(radius, ratios),)) for ratios in (None, (300.0, 5.0))]
    rigid, fluid = map(matrix_of_sphere, scenes)
    region = with_rigid(region_of(scenes[1]), 0.2)
    true = (rigid - fluid).norm(dim=1) / rigid.norm(dim=1)
    free = free_space_matrix(EMPTY.control_points, EMPTY.array, EMPTY.wavenumber)
    claimed = rigid_errors(rigid, free, region)
    assert (claimed > true / 3).all()
    assert (claimed < 12 * true).all()


def test_the_estimate_of_a_cube_of_many_wavelengths_is_no_larger_than_its_edges_leave():
    """Required: within a factor of 3; once 5 times as much, as of small cubes, which are all edges."""
    points = [(75e-3, 5e-3, 2e-3), (35e-3, 40e-3, -4e-3), (60e-3, -7e-3, 40e-3)]
    cube = at.Box((35e-3, 0.0, 0.0), (40e-3,) * 3, rigid=True, rotation=(0.2, 0.3, 0.1))
    scene = at.Scene(EMPTY.array, AIR, 40e3, points, (cube,))
    matrix, error = make_propagator(scene, "box", 1.2e-3, tolerance=1e-4).transfer_matrix(return_error=True)
    finer = make_propagator(scene, "box", 0.75e-3, tolerance=1e-4).transfer_matrix()
    true = relative_error(matrix, finer)
    assert true / 3 < error < 3 * true


@pytest.mark.parametrize(
    "size", [(0.6e-3, 0.55e-3, 0.6e-3), (0.9e-3, 1.1e-3, 1.0e-3), (1.7e-3, 1.2e-3, 0.8e-3)]
)
def test_the_estimate_of_boxes_of_about_a_cell(size):
    """Required: a quarter to 10 times the error, by chance; measured 0.4 to 6, once down to 0.17."""
    box = at.Box(tuple(np.add(CENTER, (0.1e-3, 0.2e-3, 0.15e-3))), size, rigid=True)
    scene = small_scene((box,))
    matrix, error = make_propagator(scene, "box", 1e-3, tolerance=1e-5).transfer_matrix(return_error=True)
    true = relative_error(matrix, make_propagator(scene, "box", 0.3e-3, tolerance=1e-5).transfer_matrix())
    assert true / 4 < error < 10 * true


def test_the_estimate_of_rigid_rings_of_two_cells_across():
    """Errors fall with the cells, not their square: claims were 0.35 to 0.44 of them, now 0.6 to 0.8."""
    rng = np.random.default_rng(0)
    tube = pyvista.ParametricTorus(ringradius=5.5, crosssectionradius=1.0, u_res=60, v_res=30)
    place = {"scale": 1e-3, "rotation": tuple(rng.uniform(-3, 3, 3).tolist()), "offset": CENTER}
    ring = at.Mesh.from_surface(tube.clean().triangulate(), **place, rigid=True)
    scene = small_scene((ring,))
    matrix, error = make_propagator(scene, "box", 1.05e-3, tolerance=1e-3).transfer_matrix(return_error=True)
    true = relative_error(matrix, make_propagator(scene, "box", 0.42e-3, tolerance=1e-3).transfer_matrix())
    assert 0.4 * true < error < 3 * true


@pytest.mark.parametrize("count", [1, 2])
def test_boxes_have_twelve_edges_each(count):
    a, b, c = size = (5e-3, 8e-3, 20e-3)
    boxes = [at.Box((50e-3 * (n + 1), 0.0, 0.0), size, rigid=True) for n in range(count)]
    region = region_of(at.Scene(EMPTY.array, AIR, 40e3, EMPTY.control_points, boxes))
    assert region.edges_per_area == pytest.approx(2 * (a + b + c) / (a * b + b * c + c * a))
    assert region.largest_extent == pytest.approx(c)


@pytest.mark.filterwarnings("ignore::autdtorch.OverlapWarning")
def test_a_fluid_in_a_rigid_body_counts_by_its_density_and_one_beside_it_does_not(caplog):
    tube = Cylinder(CENTER, 3e-3, 9e-3, (1, 1, 0), rigid=True)
    heavy, light = (
        Cylinder(CENTER, 2e-3, 9e-3, (1, 1, 0), density=ratio * AIR.density, sound_speed=AIR.sound_speed)
        for ratio in (4.0, 1 / 3)
    )
    beside = at.Box(np.add(CENTER, (0, 0, 5e-3)), (4e-3,) * 3, density=4 * AIR.density, sound_speed=400.0)
    scenes = [small_scene((tube, *bodies)) for bodies in ((heavy,), (light,), (beside,), ())]
    assert [region_of(scene).held_contrast for scene in scenes] == pytest.approx([4, 3, 1, 1])
    law = plan(scenes[0], "box", 1e-3).law
    assert law.usual(1e-3) == pytest.approx(4 * replace(law, held=1.0).usual(1e-3))
    make_propagator(scenes[2], "box", 1e-3)
    assert "resonates sharply" not in caplog.text
    make_propagator(scenes[0], "box", 1e-3)
    assert "resonates sharply" in caplog.text


@pytest.mark.filterwarnings("ignore::autdtorch.OverlapWarning")
def test_the_thickness_of_a_tube_is_that_of_its_wall():
    outer, wall, long = 3e-3, 0.5e-3, 9e-3
    air = {"density": AIR.density, "sound_speed": AIR.sound_speed}
    tube = Cylinder(CENTER, outer, long, (1, 1, 0), rigid=True)
    bore = Cylinder(CENTER, outer - wall, long + 1e-3, (1, 1, 0), **air)
    volume = math.pi * (outer**2 - (outer - wall) ** 2) * long
    area = 2 * volume / wall + 2 * volume / long
    # 400 places a surface: 0.2 to 1.5 % measured
    assert region_of(small_scene((tube, bore))).mean_thickness == pytest.approx(2 * volume / area, rel=0.05)


def test_the_estimate_is_honest_in_free_space():
    propagator = make_propagator(EMPTY, "full", 1.3e-3, tolerance=1e-3)
    matrix, error = propagator.transfer_matrix(return_error=True)
    free = free_space_matrix(EMPTY.control_points, EMPTY.array, EMPTY.wavenumber)
    assert relative_error(matrix, free) / 3 < error < 0.02


def test_estimates_of_exact_fields_silent_rows_and_grids_that_agree_by_chance():
    assert FreeSpacePropagator(EMPTY).transfer_matrix(return_error=True)[1] == 0
    assert FreeSpacePropagator(small_scene((RIGID,))).transfer_matrix(return_error=True)[1] == math.inf
    one = torch.ones(2, 3, dtype=torch.complex128)
    others = [(one * (1 + 1e-7), 0.2), (one * 1.01, 0.13)]
    assert (errors_by_grids(one, one, 0.1, others, LAW) > 1e-5).all()
    quiet, free = torch.full((1, 3), 1e-9), torch.ones(1, 3)
    assert grid_errors(quiet, free, 1.0, [(0 * quiet, 2.0)], Law(8.0, aligned=True)).item() < 1e-4


def test_a_tolerance_is_met():
    scene = small_scene((RIGID,))
    loose, tight = (make_propagator(scene, "box", None, tolerance=tolerance) for tolerance in (0.1, 0.01))
    assert tight.spacing < loose.spacing <= region_of(scene).coarsest_spacing
    for propagator, tolerance in ((loose, 0.1), (tight, 0.01)):
        runs = len(propagator.runs)
        matrix, error = propagator.transfer_matrix(return_error=True)
        assert relative_error(matrix, matrix_of_sphere(scene)) < tolerance
        assert error < tolerance
        assert len(propagator.runs) == runs  # the run that chose the grid


def test_a_coarse_grid_at_a_resonance_tells_of_that_alone():
    """Required: a third of the error, 0.2 %, to 5 times it. Two absorbing layers gave 2.7 and 3.1.

    All grids have the same layer: one that reflects less lowers the error and leaves the claim.
    """
    scene = small_scene((ball(2.25e-3, (0.1, 0.32)),))
    matrix, error = make_propagator(scene, "box", None, tolerance=0.02).transfer_matrix(return_error=True)
    true = relative_error(matrix, matrix_of_sphere(scene))
    assert true / 3 < error < 5 * true


def test_a_budget_returns_the_finest_grid_within_it(caplog):
    scene, tolerance = small_scene((RIGID,)), 1e-3
    least = make_propagator(scene, "box", None, tolerance, memory=1.0)
    assert "time or memory end" in caplog.text
    assert "error not estimated, which takes a second grid" in caplog.text
    memory = 2 * plan(scene, "box", least.spacing).memory
    more = make_propagator(scene, "box", None, tolerance, memory=memory)
    assert more.spacing < least.spacing
    assert plan(scene, "box", more.spacing).memory <= memory
    assert more.transfer_matrix(return_error=True)[1] > tolerance
    in_no_time = make_propagator(scene, "box", None, tolerance, seconds=1e-6)
    assert in_no_time.spacing == least.spacing


def test_a_budget_that_is_not_reached_changes_nothing():
    ball = Sphere(CENTER, 1.5e-3, density=3 * AIR.density, sound_speed=0.5 * AIR.sound_speed)
    budgets = [{}, {"seconds": 1e4}, {"memory": 1e11}]
    chosen = [make_propagator(small_scene((ball,)), "box", None, 0.5, **budget) for budget in budgets]
    assert len({propagator.spacing for propagator in chosen}) == 1


def test_the_error_of_each_point():
    propagator = make_propagator(small_scene((RIGID,)), "box", 1.3e-3, tolerance=1e-3)
    matrix, reference = propagator.transfer_matrix(), matrix_of_sphere(propagator.scene)
    true = (matrix - reference).norm(dim=1) / reference.norm(dim=1)
    errors = propagator.point_errors()
    assert errors.shape == true.shape
    assert (errors > true / 3).all()
    assert (errors < 20 * true).all()


@pytest.mark.filterwarnings("ignore:no steady state")
@settings(max_examples=3)
@given(st.integers(0, 10**6), st.integers(30, 300), st.floats(0.1, 0.4), st.floats(2.7e-3, 3e-3))
def test_points_beside_a_resonance_err_together_as_their_matrix(seed, count, density, radius):
    """Required: within a factor of 2, as grids may agree at single points; each once counted for all."""
    scene = small_scene((ball(radius, (density, 0.5)),))
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = torch.from_numpy(CENTER + (radius + rng.uniform(0.5e-3, 9e-3, (count, 1))) * direction)
    propagator = make_propagator(scene, "box", 1e-3, tolerance=1e-3)
    matrix, error = propagator.transfer_matrix(points, return_error=True)
    together = float((propagator.point_errors(points) * matrix.norm(dim=1)).norm() / matrix.norm())
    assert error / 2 < together < 2 * error


@pytest.mark.filterwarnings("ignore:no steady state")
def test_a_spacing_is_chosen_where_nothing_scatters_and_none_without_an_estimate():
    scene = small_scene((Sphere(CENTER, RADIUS, density=AIR.density, sound_speed=AIR.sound_speed),))
    assert make_propagator(scene, "box", None, tolerance=0.1).spacing < region_of(scene).coarsest_spacing
    with pytest.raises(ValueError, match=r"^max_periods: 1; "):
        make_propagator(small_scene((RIGID,)), "box", None, tolerance=0.1, max_periods=1)


@given(st.floats(1.25, 3.0), st.floats(1e-5, 5e-3), st.floats(0.02, 0.3), st.floats(0.1, 1.0))
def test_errors_are_known_from_either_grid(ratio, error, spacing, edges):
    one, law = torch.ones(2, 3, dtype=torch.complex128), Law(1.0, aligned=True, edges=edges)
    other = error * law.growth(ratio * spacing) / law.growth(spacing)
    fine, coarse = one * (1 + error), one * (1 + other)
    known = errors_by_grids(fine, one, spacing, [(coarse, ratio * spacing)], law)
    assert (known * (1 + error) / error).numpy() == pytest.approx(1)
    known = errors_by_grids(coarse, one, ratio * spacing, [(fine, spacing)], law)
    assert (known * (1 + other) / other).numpy() == pytest.approx(1)


@given(st.floats(0.05, 0.25), st.floats(0.01, 1.0), st.floats(-7, 0))
def test_estimates_lean_towards_the_usual_error(spacing, scattered, logarithm):
    """The logarithm moves by 0.3 of the way, downwards by 0.3 at most, and no claim is below 0.37 of it."""
    free = torch.ones(1, 3, dtype=torch.complex128)
    matrix, usual = free * (1 + scattered), LAW.usual(spacing) * scattered / (1 + scattered)
    coarser = matrix * (1 + 10**logarithm), 1.3 * spacing
    (by_grids,), (claim,) = (
        of(matrix, free, spacing, [coarser], LAW).tolist() for of in (errors_by_grids, grid_errors)
    )
    leaning = by_grids**0.7 * max(usual, by_grids / 10) ** 0.3
    assert claim == pytest.approx(max(leaning, 0.37 * usual))
    (agreed,) = grid_errors(matrix, free, spacing, [(matrix, 1.3 * spacing)], LAW).tolist()
    assert agreed == pytest.approx(0.37 * usual)


@pytest.mark.parametrize("ratio", [0.5, 1.0])
def test_bodies_of_slow_fluids_start_on_a_finer_grid(ratio):
    """Loose enough for two grids, the second 1.25 times as fine as the first."""
    ball = Sphere(CENTER, 1.5e-3, density=3 * AIR.density, sound_speed=ratio * AIR.sound_speed)
    scene = small_scene((ball,))
    chosen = make_propagator(scene, "box", None, tolerance=0.5).spacing
    assert chosen == pytest.approx(region_of(scene).coarsest_spacing / 1.25 / min(1 / ratio, 1.6))


def test_the_second_grid_is_no_finer_than_the_usual_error_asks():
    """Both choices take two grids; steps to the second are 1.25 and 1.6, up to 8 % for the place of faces."""
    scene = small_scene((at.Box(CENTER, (8e-3, 9e-3, 10e-3), rigid=True),))
    loose, tight = (make_propagator(scene, "box", None, tolerance) for tolerance in (0.3, 0.05))
    assert loose.spacing > 1.15 * tight.spacing
    assert loose.compared().usual_error < 0.3 / 2


def test_a_choice_ends_where_voxels_are_too_coarse(caplog):
    """No grid tells where between the centres of voxels the surface is."""
    mask = np.zeros((10, 10, 10), bool)
    mask[2:8, 2:8, 2:8] = np.indices((6, 6, 6)).sum(axis=0) > 2
    voxels = VoxelMask(mask, 1.1e-3, (6.5e-3,) * 3, rigid=True)
    propagator = make_propagator(small_scene((voxels,)), "box", None, tolerance=2e-3)
    assert propagator.spacing > 0.3e-3
    assert propagator.transfer_matrix(return_error=True)[1] > 2e-3
    assert "the surface of obstacle 0 is known to" in caplog.text


@given(st.floats(1e-4, 0.3), st.floats(1.0, 1e3))
def test_a_spacing_has_its_growth(spacing, edges):
    law = Law(8.5e-3, aligned=True, edges=edges)
    assert law.spacing_of(law.growth(spacing)) == pytest.approx(spacing)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-5])
def test_exact_spheres_claim_the_waves_left_out(tolerance):
    """T-matrices in closed form: measured 1e-7, where once the whole tolerance was claimed."""
    propagator = make_propagator(small_scene((RIGID,)), "tmatrix", None, tolerance)
    matrix, error = propagator.transfer_matrix(return_error=True)
    true = relative_error(matrix, matrix_of_sphere(propagator.scene))
    assert true < max(3 * error, 1e-10)
    assert error < max(10 * true, 1e-10)
    assert propagator.point_errors().max() < 10 * max(error, 1e-10)


def test_the_second_grid_is_coarser_where_fair():
    region = region_of(EMPTY)
    assert region.second_spacing(1e-3) == RATIO * 1e-3
    assert region.second_spacing(2e-3) == 2e-3 / RATIO
