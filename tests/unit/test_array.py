import math

import numpy as np
import pytest
import torch

from autdtorch.scene.arrays import AUTD3_UNIT, PAPER_SOURCE_STRENGTH, TransducerArray
from autdtorch.scene.geometry import circle_points
from autdtorch.utils.spatial import distances

PITCH = 10.16e-3
ROUNDING = 1e-12  # of lengths below 1 m in float64, with margin


def test_grid_is_row_major_along_the_axes_of_its_plane():
    array = TransducerArray.grid((2, 3), pitch=10e-3, center=(1e-3, 50e-3, 50e-3))
    expected = [[1, y, z] for y in (45, 55) for z in (40, 50, 60)]  # normal x: u is y, v is z
    # Decimal millimetres are not exact in binary: a few roundings at 0.1 m.
    torch.testing.assert_close(1e3 * array.positions, torch.tensor(expected).double(), rtol=1e-14, atol=0)
    assert torch.equal(array.normals, torch.tensor([[1.0, 0.0, 0.0]]).double().repeat(6, 1))
    assert len(array) == 6


def test_each_transducer_may_point_its_own_way():
    positions = torch.tensor([[0.0, 0, 0], [0, 0.01, 0]], requires_grad=True)
    array = TransducerArray(positions, [[2, 0, 0], [0, 3, 4]])
    assert not array.positions.requires_grad
    assert array.source_strength == PAPER_SOURCE_STRENGTH == 1 / (4 * np.pi)
    assert array.normals.tolist() == [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]


@pytest.mark.parametrize("convert", [torch.from_numpy, np.asarray], ids=["tensor", "numpy"])
def test_array_keeps_its_own_copy(convert):
    positions = convert(np.array([[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]]))
    array = TransducerArray(positions, (1, 0, 0))
    positions[1, 1] = 5.0
    assert array.positions.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]]
    assert array.positions.dtype == torch.float64


def test_a_point_is_one_node_and_a_radius_of_zero_a_point():
    points, zero = (
        TransducerArray.grid((2, 2), pitch=10e-3, center=(0, 0, 0), radius=radius) for radius in (None, 0)
    )
    assert points.radius == zero.radius == 0
    for array in (points, zero):
        positions, weights = array.nodes
        assert torch.equal(positions[:, 0], array.positions)
        assert weights.tolist() == [1.0]
        assert not array.half_extents.any()


def test_nodes_lie_on_the_discs_and_have_their_moments():
    """Mean of x^2 over a disc of radius a: a^2/4; of x^4: a^4/8; of x^2 y^2: a^4/24; odd powers vanish."""
    normals = torch.tensor([[0, 0, 1], [1, 2, 3]]).double()
    array = TransducerArray([[0, 0, 0], [0.01, 0, 0]], normals, radius=5e-3)
    positions, weights = array.nodes
    assert positions.shape == (2, len(weights), 3)
    x, y, z = (positions[0] / 5e-3).unbind(dim=1)
    moments = [x**0, x, x**2, x**4, x**2 * y**2, x * y, x**3, z**2]
    found = torch.stack([weights @ moment for moment in moments])
    expected = torch.tensor([1, 0, 1 / 4, 1 / 8, 1 / 24, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=1e-14, atol=1e-15)  # rounding of 80 terms
    # tilted: in the plane of the disc, and around its middle
    offset = positions[1] - array.positions[1]
    assert (offset @ array.normals[1]).abs().max() < 1e-17
    torch.testing.assert_close(weights @ offset, torch.zeros(3).double(), rtol=0, atol=1e-17)
    assert offset.norm(dim=1).max() < 5e-3
    assert (offset.abs().amax(dim=0) <= array.half_extents[1]).all()


def test_half_extents_are_those_of_a_fine_circle():
    array = TransducerArray([[0, 0, 0]], (1, 2, 3), radius=5e-3)
    circle = circle_points((0, 0, 0), 5e-3, 3600, (1, 2, 3))
    # the nearest of 3600 points is at most 1/20 degree off: 4e-7 of the radius
    torch.testing.assert_close(array.half_extents[0], circle.amax(dim=0), rtol=1e-6, atol=0)


def test_autd3_counts_row_by_row_and_leaves_out_three():
    array = TransducerArray.autd3((0, 0, 0), normal=(0, 0, 1))
    place = (array.positions[:, :2] - array.positions[0, :2]) / PITCH
    counted = place.round().long().tolist()
    # As autd3-core 0.12 has them: 18 in the first row; (1, 1), (2, 1) and (16, 1) are missing in the second.
    assert len(array) == 249
    assert counted[17:20] == [[17, 0], [0, 1], [3, 1]]
    assert counted[31:34] == [[15, 1], [17, 1], [0, 2]]
    assert counted[248] == [17, 13]
    torch.testing.assert_close(place, place.round(), rtol=0, atol=1e-9)
    corners = torch.stack((array.positions[0], array.positions[248]))
    assert corners.mean(dim=0).abs().max() < ROUNDING


def test_units_of_autd3_lie_side_by_side():
    one = TransducerArray.autd3((1e-3, 50e-3, 50e-3))
    four = TransducerArray.autd3((1e-3, 50e-3, 50e-3), units=(2, 2))
    assert (len(one), len(four)) == (249, 996)
    assert four.positions.mean(0) == pytest.approx(one.positions.mean(0), abs=ROUNDING)
    extent = four.positions.amax(0) - four.positions.amin(0)
    assert extent[1:] == pytest.approx([AUTD3_UNIT[0] + 17 * PITCH, AUTD3_UNIT[1] + 13 * PITCH], abs=ROUNDING)
    assert four.positions[249] - four.positions[0] == pytest.approx([0, 0, AUTD3_UNIT[1]], abs=ROUNDING)
    nearest = distances(four.positions, four.positions).fill_diagonal_(1)
    assert float(nearest.min()) == pytest.approx(PITCH, abs=ROUNDING)


def test_square_boards_begin_at_the_top_left():
    rows = TransducerArray.sonicsurface((0, 0, 0), normal=(0, 0, 1)).positions * 1e3
    columns = TransducerArray.openmpd((0, 0, 0), normal=(0, 0, 1)).positions * 1e3
    first, right, below, last = [-78.75, 78.75, 0], [-68.25, 78.75, 0], [-78.75, 68.25, 0], [78.75, -78.75, 0]
    for positions, second, seventeenth in ((rows, right, below), (columns, below, right)):
        for index, place in ((0, first), (1, second), (16, seventeenth), (255, last)):
            assert positions[index].tolist() == pytest.approx(place, abs=1e-9)


@pytest.mark.parametrize("device", ["autd3", "sonicsurface", "openmpd"])
def test_devices_go_where_they_are_put(device):
    make = getattr(TransducerArray, device)
    flat = make((0, 0, 0), normal=(0, 0, 1))
    turned = make((0.1, 0.2, 0.3), normal=(0, 2, 0), angle=math.pi / 2)
    # Facing +y, (u, v) is (z, x); turned by a right angle, the device's x is v = x and its y is -u = -z.
    x, y, _ = flat.positions.T
    expected = torch.stack((0.1 + x, torch.full_like(x, 0.2), 0.3 - y), dim=1)
    torch.testing.assert_close(turned.positions, expected, rtol=0, atol=ROUNDING)
    assert turned.normals[0].tolist() == [0, 1, 0]
    assert turned.radius == 4.5e-3
    assert make((0, 0, 0), source_strength=2.0, radius=0).source_strength == 2.0
