import pickle

import numpy as np
import pytest
import torch

from autdtorch.array import PAPER_SOURCE_STRENGTH, TransducerArray


def test_grid_is_row_major_along_the_axes_of_its_plane():
    array = TransducerArray.grid((2, 3), pitch=10e-3, center=(1e-3, 50e-3, 50e-3))
    expected = [[1, y, z] for y in (45, 55) for z in (40, 50, 60)]  # normal x: u is y, v is z
    # Decimal millimetres are not exact in binary: a few roundings at 0.1 m.
    torch.testing.assert_close(1e3 * array.positions, torch.tensor(expected).double(), rtol=1e-14, atol=0)
    assert torch.equal(array.normals, torch.tensor([[1.0, 0.0, 0.0]]).double().repeat(6, 1))
    assert len(array) == 6


def test_grid_of_one_transducer_sits_at_the_centre():
    array = TransducerArray.grid((1, 1), pitch=10e-3, center=(0.1, 0.2, 0.3), normal=(0, 0, -2))
    assert array.positions.tolist() == [[0.1, 0.2, 0.3]]
    assert array.normals.tolist() == [[0.0, 0.0, -1.0]]


def test_source_strength_is_the_papers_by_default():
    assert TransducerArray([[0, 0, 0]], (1, 0, 0)).source_strength == PAPER_SOURCE_STRENGTH == 1 / (4 * np.pi)


def test_each_transducer_may_point_its_own_way():
    array = TransducerArray([[0, 0, 0], [0, 0.01, 0]], [[2, 0, 0], [0, 3, 4]])
    assert array.normals.tolist() == [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]


@pytest.mark.parametrize("convert", [torch.from_numpy, np.asarray], ids=["tensor", "numpy"])
def test_array_keeps_its_own_copy(convert):
    positions = convert(np.array([[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]]))
    array = TransducerArray(positions, (1, 0, 0))
    positions[1, 1] = 5.0
    assert array.positions.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]]
    assert array.positions.dtype == torch.float64


def test_positions_that_require_grad_leave_no_graph_behind():
    positions = torch.zeros(1, 3, requires_grad=True)
    assert not TransducerArray(positions * 2, (1, 0, 0)).positions.requires_grad


def test_array_survives_pickling():
    array = TransducerArray.grid((4, 4), pitch=10e-3, center=(0, 0, 0), normal=(1, 2, 3), source_strength=2.0)
    copy = pickle.loads(pickle.dumps(array))
    assert torch.equal(copy.positions, array.positions)
    assert torch.equal(copy.normals, array.normals)
    assert copy.source_strength == array.source_strength


def test_repr_names_count_place_and_units():
    array = TransducerArray.grid((4, 4), pitch=10e-3, center=(1e-3, 50e-3, 50e-3))
    shown = "TransducerArray(16 transducers around (1, 50, 50) mm, source strength 0.07958 Pa m)"
    assert repr(array) == shown
