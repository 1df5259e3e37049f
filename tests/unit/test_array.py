import numpy as np
import pytest
import torch

from autdtorch.scene.arrays import PAPER_SOURCE_STRENGTH, TransducerArray
from autdtorch.scene.geometry import circle_points


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
