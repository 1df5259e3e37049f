"""Errors claimed of points and sources beside surfaces and edges."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_meshes import box as box_mesh
from small_meshes import inverted, merged
from small_scenes import AIR, matrix_of_sphere, relative_error, small_scene

import autdtorch as at
from autdtorch.fdtd.grid_errors import edge_errors, reading_errors, usual_errors
from autdtorch.propagators import make_propagator
from autdtorch.propagators.plan import region_of
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles import Sphere

CENTER, RADIUS = (12.2e-3, 11.9e-3, 12.1e-3), 3.3e-3
RIGID = Sphere(CENTER, RADIUS, rigid=True)
HEAVY = Sphere(CENTER, RADIUS, density=10 * AIR.density, sound_speed=1.5 * AIR.sound_speed)
EMPTY = small_scene()


@settings(max_examples=3)
@given(st.integers(0, 10**6), st.floats(1e-3, 1.0), st.floats(0.9e-3, 1.6e-3))
def test_points_within_a_cell_of_a_rigid_sphere_err_by_no_more_than_their_claims(seed, gap, spacing):
    """Required: three times the claims, at one point of 12 four times.

    Two grids may agree there by chance: 3.5 measured a cell away, 2.0 at most at 580 points of 8 others.
    """
    direction = np.random.default_rng(seed).normal(size=(12, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = torch.from_numpy(np.array(CENTER) + (RADIUS + gap * spacing) * direction)
    propagator = make_propagator(small_scene((RIGID,)), "box", spacing, tolerance=1e-3)
    series = matrix_of_sphere(propagator.scene, points)
    true = (propagator.transfer_matrix(points) - series).norm(dim=1) / series.norm(dim=1)
    ratios = (true / propagator.point_errors(points)).sort().values
    assert ratios[-2] < 3
    assert ratios[-1] < 4


@pytest.mark.parametrize(("size", "swapped"), [((3e-3, 5e-3, 7e-3), False), ((4.5e-3, 5.5e-3, 5e-3), True)])
@pytest.mark.parametrize("material", [{"rigid": True}, {"density": 60.0, "sound_speed": 900.0}])
def test_claims_hold_beside_faces_and_edges_along_the_grid(size, material, swapped):
    """Required: within a factor of 3 over 24 points, or 24 sources."""
    gaps = np.random.default_rng(0).uniform(-1, 1, (24, 3))
    near, far = CENTER + gaps * np.array(size) / 2, EMPTY.array.positions
    for number, place in enumerate(near):
        axis = number % 3
        place[axis] = CENTER[axis] + math.copysign(size[axis] / 2 + 0.1e-3, gaps[number, axis])
    sources, points = (near, far) if swapped else (far, near)
    array = at.TransducerArray(sources, (0, 0, 1))
    scene = at.Scene(array, AIR, 40e3, points, (at.Box(CENTER, size, **material),))
    matrix, error = make_propagator(scene, "box", 1.1e-3, tolerance=1e-3).transfer_matrix(return_error=True)
    true = relative_error(matrix, make_propagator(scene, "box", 0.4e-3, tolerance=1e-3).transfer_matrix())
    assert true / 3 < error < 3 * true


@settings(max_examples=3)
@example(280665, 3.264e-3, False, None)  # kernels that read around its edges erred by 4 %, at five points
@given(st.integers(0, 10**6), st.floats(0.3e-3, 6e-3), st.booleans(), st.sampled_from([None, 6.0, 200.0]))
def test_points_beside_edges_err_by_no_more_than_their_claims(seed, thickness, tilted, density):
    """Required: at most 3 times the claims, but at 4 of 40 points; for all together 0.2 to 1.8 times.

    Of 61 others, 54 have no such point, 6 one and 1 two, so about one in 5000 has five. Together they have
    0.45 to 1.32 times, 0.71 in the median: both limits are 4 standard deviations of the logarithm away.
    """
    rng = np.random.default_rng(seed)
    angles = tuple(rng.uniform(-3, 3, 3).tolist()) if tilted else (0.0, 0.0, 0.0)
    material = {"density": density * AIR.density, "sound_speed": 900.0} if density else {"rigid": True}
    size = np.array([thickness, *rng.uniform(4e-3, 7e-3, 2)])
    box = at.Box(CENTER, tuple(size), angles, **material)
    edge = rng.choice([-0.5, 0.5], (200, 3)) * size  # places on four edges, and others around these
    edge[:, 2] *= rng.uniform(-1, 1, 200)
    angle, distance = rng.uniform(0, 2 * math.pi, 200), 0.3e-3 * 10 ** rng.uniform(0, 1, 200)
    aside = np.stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(200)], axis=1)
    points = torch.from_numpy(CENTER + (edge + aside) @ rotation_matrix(angles).numpy().T)
    points = points[box.signed_distance(points) > 0.2e-3][:40]
    scene = small_scene((box,))
    propagator = make_propagator(scene, "box", 1e-3, tolerance=1e-3)
    truth = make_propagator(scene, "box", 0.37e-3, tolerance=1e-3).transfer_matrix(points)
    matrix, error = propagator.transfer_matrix(points, return_error=True)
    true = (matrix - truth).norm(dim=1) / truth.norm(dim=1)
    assert int((true > 3 * propagator.point_errors(points)).sum()) <= 4
    assert error / 5 < relative_error(matrix, truth) < 1.8 * error


def edge_errors_of(scene, points):
    matrix = torch.ones((len(points), 1), dtype=torch.complex128)
    far = torch.full((1, 1, 3), -1.0, dtype=torch.float64)
    return edge_errors(matrix, matrix, torch.from_numpy(points), far, region_of(scene), 1e-3)


@settings(max_examples=5)
@given(st.integers(0, 10**6), st.floats(0.2, 0.8), st.integers(0, 2), st.sampled_from([None, 0.2, 2.0, 60.0]))
def test_edges_that_parts_of_a_body_or_a_reflector_cover_do_not_count(seed, share, axis, density):
    """Edges count at places up to half a cell apart, the errors of a cell away are known to 4 % by that."""
    rng = np.random.default_rng(seed)
    angles, size = tuple(rng.uniform(-3, 3, 3).tolist()), rng.uniform(5e-3, 9e-3, 3)
    turn, across = rotation_matrix(angles).numpy(), np.eye(3)[axis]
    material = {"density": density * AIR.density, "sound_speed": 400.0} if density else {"rigid": True}

    def part(low, high):
        """The box from one share of its length to another."""
        center = CENTER + turn @ ((low + high - 1) / 2 * across * size)
        return at.Box(tuple(center), tuple(size * np.where(across, high - low, 1)), angles, **material)

    whole, apart = part(0, 1), [part(0, share), part(share, 1)]
    points = CENTER + rng.uniform(-1, 1, (300, 3)) * 10e-3
    points = points[whole.signed_distance(torch.from_numpy(points)).numpy() > 1e-3]
    errors = edge_errors_of(small_scene((whole,)), points)
    assert errors.any()
    assert edge_errors_of(small_scene(apart), points).numpy() == pytest.approx(errors, rel=0.05, abs=1e-4)
    normal = turn @ across
    before = points[(points - CENTER) @ normal > 0]
    scene = at.Scene(
        at.TransducerArray([CENTER + 30e-3 * normal], (0, 0, 1)), AIR, 40e3, [CENTER + 20e-3 * normal],
        [part(0.5, 1)], reflectors=[at.Reflector(CENTER, normal)],
    )  # fmt: skip
    errors = edge_errors_of(small_scene((whole,)), before)
    assert edge_errors_of(scene, before).numpy() == pytest.approx(errors, rel=0.05, abs=1e-4)


def test_concave_edges_do_not_count():
    """A room in a body has no others."""
    inner = box_mesh((-3, -4, -5), (3, 4, 5))
    body = at.Mesh.from_surface(merged(box_mesh((-12,) * 3, (12,) * 3), inverted(inner)), 1e-3, rigid=True)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * (2.9e-3, 3.9e-3, 4.9e-3)
    scene = at.Scene(at.TransducerArray([[0, 0, 50e-3]], (0, 0, 1)), AIR, 40e3, [[0, 0, 40e-3]], (body,))
    assert not edge_errors_of(scene, points).any()
    assert edge_errors_of(scene, points + np.array([0, 12.5e-3, 12.5e-3])).any()


def test_kernels_count_within_a_cell_of_surfaces_that_the_pressure_has_a_kink_at():
    gaps = [[RADIUS + gap, 0.0, 0.0] for gap in (0.0, 0.5e-3, 1.001e-3, 9e-3)]
    places = torch.tensor(CENTER, dtype=torch.float64) + torch.tensor(gaps, dtype=torch.float64)
    matrix, free, far = torch.full((4, 1), 1.0), torch.full((4, 1), 2.0), places[3:]
    as_dense = replace(HEAVY, density=AIR.density)
    for body in (RIGID, HEAVY, as_dense):
        region = region_of(small_scene((body,)))
        read = reading_errors(matrix, free, places, far[:, None], region, 1e-3)
        driven = reading_errors(matrix.mT, free.mT, far, places[:, None], region, 1e-3)
        assert read.any() == driven.any() == (body is not as_dense)
        assert read[1] == pytest.approx(float(read[0]) / 2)
        assert not read[2:].any()
        assert float(driven) == pytest.approx(float(read.norm()) / 2)  # of four sources


@given(st.integers(0, 2), st.floats(0.2e-3, 4e-3))
@settings(max_examples=4)
def test_the_usual_error_counts_edges_within_half_a_wavelength(axis, gap):
    """A choice of spacing begins with it, so that grids at points there are as fine as they need to be."""
    box = at.Box(CENTER, (5e-3, 6e-3, 7e-3), rigid=True)
    propagator = make_propagator(small_scene((box,)), "box", 1.3e-3, tolerance=1e-2)
    outwards = np.ones(3) / math.sqrt(2)
    outwards[axis] = 0.0
    edge = CENTER + np.array(box.size) / 2 * (outwards > 0)
    near, far = edge + gap * outwards, edge + 7e-3 * outwards
    errors = []
    for place in (near, far):
        comparison, plan = propagator.compared(torch.from_numpy(place[None])), propagator.plan
        waves = usual_errors(comparison.result.matrix, comparison.free, plan.spacing, plan.law)
        errors.append(comparison.usual_error - float(waves))
    assert errors[0] > 0
    assert errors[1] == 0
