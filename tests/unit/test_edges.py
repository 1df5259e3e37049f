import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.fdtd.assembly.edge_energy import _reduction, changes
from autdtorch.fdtd.assembly.edges import edges_of, rims_of
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles import Box, Cylinder

STENCIL = tuned_stencil(0.6, 0.0)
angles = st.tuples(*[st.floats(-3, 3)] * 3)
within = st.floats(-1.0, 1.0)


@settings(max_examples=10)
@given(turn=angles, angle=st.floats(0.4, 2.7), x=within, y=within, axis=st.integers(0, 2))
def test_the_change_at_an_edge_is_that_of_its_image_and_of_its_faces_in_any_order(turn, angle, x, y, axis):
    first, along = (rotation_matrix(turn).numpy() @ unit for unit in ((1.0, 0, 0), (0, 0, 1.0)))
    second = math.cos(angle) * first + math.sin(angle) * np.cross(along, first)
    normals, way = np.array([first, second]), x * first + y * np.cross(along, first)
    mirror = np.where(np.arange(3) == axis, -1.0, 1.0)
    ways = np.array([way, way, way * mirror])
    change = _reduction(ways, np.array([normals, normals[::-1], normals * mirror]), STENCIL)
    assert change[1:] == pytest.approx(change[0], abs=1e-6)


@settings(max_examples=4)
@given(turn=angles, radius=st.floats(1.5e-3, 4e-3), shift=st.floats(-2e-3, 2e-3))
def test_the_rim_of_a_bore_that_a_fluid_cuts_is_the_edge_of_what_is_left(turn, radius, shift):
    rotation = rotation_matrix(turn).numpy()
    block = Box((0, 0, 0), (14e-3, 14e-3, 6e-3), turn, rigid=True)
    center, axis = (tuple(rotation @ place) for place in ((shift, 0, 0), (0, 0, 1.0)))
    bore = Cylinder(center, radius, 8e-3, axis, density=1.2, sound_speed=343.0)
    around = np.random.default_rng(0).uniform(0, 2 * math.pi, 40)
    on = np.column_stack(
        (shift + radius * np.cos(around), radius * np.sin(around), np.full(40, 3e-3) * (-1) ** np.arange(40))
    )
    off = np.random.default_rng(1).uniform(-4e-4, 4e-4, (40, 3))
    (rim,) = rims_of([block, bore], [True, False], [1.0, 1.0], 1e-3)
    way, normals, _ = rim.nearest((on + off) @ rotation.T)
    circle = np.hypot(on[:, 0] + off[:, 0] - shift, on[:, 1] + off[:, 1]) - radius
    # the bore's curvature is left out, to second order
    assert np.linalg.norm(way, axis=1) == pytest.approx(np.hypot(circle, off[:, 2]), abs=1e-6)
    assert np.abs(normals[:, 0] @ axis) == pytest.approx(1)
    # the fluid ends above the block, and has no edge there, nor along the bore
    beyond = (on + (0, 0, 0.5e-3) * np.sign(on)) @ rotation.T
    assert np.linalg.norm(rim.nearest(beyond).way, axis=1) == pytest.approx(0.5e-3, abs=1e-6)
    assert np.isinf(rim.nearest((on * (1, 1, 0)) @ rotation.T).way).all()


def test_two_edges_of_a_sheet_add_up_and_corners_count_once():
    centers = np.array([[5.1e-3, 0, 0.5e-3], [5.1e-3, 0, -1.5e-3]])
    thick, sheet = (
        changes(edges_of(Box((0, 0, -z / 2), (1e-2, 1e-2, z), rigid=True)), centers, 1e-3, STENCIL).reductions
        for z in (9e-3, 1.9e-3)
    )
    assert thick[0] == pytest.approx(sheet[0], rel=0.2, abs=1e-2)
    assert np.abs(sheet[1]).max() > 0.5 * np.abs(thick[1]).max()
    assert np.trace(sheet, axis1=1, axis2=2).max() < 2


@settings(max_examples=10)
@given(turn=angles, cut=st.floats(0.02, 0.98), place=st.tuples(within, within, within))
def test_pieces_of_an_edge_count_as_the_whole_one_alone_and_where_others_meet_it(turn, cut, place):
    edge, *others = edges_of(Box((0, 0, 0), (9e-3, 8e-3, 7e-3), turn, rigid=True))
    middle = edge.begin + cut * (edge.end - edge.begin)
    parts = [replace(edge, end=middle), replace(edge, begin=middle)]
    centers = np.stack((edge.begin, edge.end, middle)) + 1e-3 * np.array(place)
    for rest in ([], others):
        whole, parted = (changes([*edges, *rest], centers, 1e-3, STENCIL) for edges in ([edge], parts))
        assert parted.reductions == pytest.approx(whole.reductions, abs=1e-9)
        assert (parted.beside == whole.beside).all()


def test_a_body_flush_with_a_face_covers_a_part_of_its_edge():
    plate = Box((0, 0, 0), (12e-3, 8e-3, 3e-3), rigid=True)
    leg = Box((1e-3, -2e-3, -4e-3), (3e-3, 4e-3, 5e-3), rigid=True)  # its back is in the plane of the plate's
    edges = [
        edge
        for edge in edges_of(plate, [leg])
        if np.allclose(edge.begin[1:], (-4e-3, -1.5e-3)) and np.allclose(edge.end[1:], (-4e-3, -1.5e-3))
    ]
    ends = sorted(sorted((edge.begin[0], edge.end[0])) for edge in edges)
    # places of 32 along the edge tell which parts are covered
    np.testing.assert_allclose(ends, [[-6e-3, -0.5e-3], [2.5e-3, 6e-3]], atol=12e-3 / 32)


def test_an_element_beyond_the_end_of_an_edge_is_unchanged():
    edge, *_ = edges_of(Box((0, 0, 0), (9e-3, 8e-3, 7e-3), rigid=True))
    along = (edge.end - edge.begin) / np.linalg.norm(edge.end - edge.begin)
    place = edge.end + 0.3e-3 * edge.normals.sum(axis=0)
    centers = np.array([place - 1e-3 * along, place, place + 1e-3 * along])
    within, at_end, beyond = np.trace(changes([edge], centers, 1e-3, STENCIL).reductions, axis1=1, axis2=2)
    assert at_end == pytest.approx(within / 2)
    assert within != 0
    assert beyond == 0


def test_elements_on_the_axis_of_a_cylinder_have_no_edge_near():
    rims = edges_of(Cylinder((0, 0, 0), 4e-3, 8e-3, (0, 0, 1), rigid=True))
    assert np.linalg.norm(rims[0].nearest(np.array([rims[0].center])).way) == pytest.approx(4e-3)
    centers = np.array([(0, 0, 4.1e-3), (4e-3, 0, 4.1e-3)])
    near = changes(rims, centers, 1e-3, STENCIL).reductions.any(axis=(1, 2))
    assert near.tolist() == [False, True]
