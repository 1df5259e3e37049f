import math

import pytest
import torch

from autdtorch.scene.arrays import AUTD3_UNIT, TransducerArray
from autdtorch.utils.neighbours import distances

PITCH = 10.16e-3
ROUNDING = 1e-12  # of lengths below 1 m in float64, with margin


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
