"""Readings: drives, and the pressures that sensors said at points."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import autdtorch as at

DRIVES = at.drive_from_phases(torch.arange(12, dtype=torch.float64).reshape(4, 3))
POINTS = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.01, 0.1]], dtype=torch.float64)
PRESSURE = torch.tensor([[1.0, 2.0], [3.0, math.nan], [5.0, 6.0], [7.0, 8.0]], dtype=torch.float64)


def test_pressures_of_one_point_or_of_one_drive_may_have_one_axis():
    assert at.Readings(DRIVES, [1, 2, 3, 4]).pressure.shape == (4, 1)
    scan = at.Readings(DRIVES[0], PRESSURE[0], POINTS, phase=[0.1, math.nan])
    assert (scan.drives.shape, scan.pressure.shape, scan.phase.shape) == ((1, 3), (1, 2), (1, 2))


def test_readings_are_counted_without_gaps_and_a_gap_has_no_phase():
    readings = at.Readings(DRIVES, PRESSURE, POINTS, torch.zeros(4, 2))
    assert (len(readings), readings.count) == (4, 7)
    assert torch.equal(readings.phase.isnan(), PRESSURE.isnan())
    shown = "Readings(4 drives of 3 transducers, 2 points, 7 readings with phases, 1 gap)"
    assert repr(readings) == shown


@pytest.mark.parametrize(
    ("rows", "chosen"),
    [
        (slice(1, 3), [1, 2]),
        (-1, [3]),
        ([3, 0], [3, 0]),
        (np.array([True, False, False, True]), [0, 3]),
        (torch.tensor([2, 2]), [2, 2]),
    ],
)
def test_rows_select_drives(rows, chosen):
    part = at.Readings(DRIVES, PRESSURE, POINTS)[rows]
    assert torch.equal(part.drives, DRIVES[chosen])
    assert torch.equal(part.pressure.nan_to_num(-1), PRESSURE[chosen].nan_to_num(-1))
    assert torch.equal(part.points, POINTS)


def test_later_changes_of_an_argument_are_not_those_of_readings():
    pressure = PRESSURE.clone()
    readings = at.Readings(DRIVES, pressure)
    pressure[:] = 0
    assert readings.pressure[0, 1] == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drives": torch.angle(DRIVES)}, "drives: array of shape .*; must be complex, q = a e"),
        ({"drives": 2 * DRIVES}, r"drives\[0, 0\]: 2.0; every amplitude \|q\| must be in \[0, 1\]"),
        ({"drives": DRIVES[:0]}, r"drives: shape \(0, 3\); must be \(N, M\)"),
        ({"pressure": PRESSURE[:3]}, r"pressure: shape \(3, 2\); must be \(4, P\), a row for each drive"),
        (
            {"pressure": -PRESSURE},
            r"pressure\[0, 0\]: -1.0 Pa; must be a peak amplitude >= 0, or NaN for a gap",
        ),
        ({"pressure": PRESSURE / 0}, r"pressure: .*inf.* Pa; every entry must be finite"),
        ({"points": POINTS[:1]}, r"points: shape \(1, 3\); must be \(2, 3\)"),
        ({"phase": PRESSURE[:, :1]}, r"phase: shape \(4, 1\); must be \(4, 2\)"),
    ],
)
def test_wrong_arrays_are_refused_with_their_place(changes, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        at.Readings(**({"drives": DRIVES, "pressure": PRESSURE, "points": POINTS} | changes))


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 1)), min_size=1, max_size=30), st.booleans())
def test_every_row_is_a_reading_of_its_drive_and_point(pairs, phases):
    drive, point = map(list, zip(*pairs, strict=True))
    pressure = torch.arange(len(pairs), dtype=torch.float64)
    readings = at.Readings.of_rows(DRIVES[drive], POINTS[point], pressure, -pressure if phases else None)
    assert readings.count == len(pairs)
    assert len(readings.points) == len(set(point))
    assert len(readings) == sum(max(pairs.count((d, p)) for p in range(2)) for d in range(4))
    for row, column in (~readings.pressure.isnan()).nonzero().tolist():
        number = int(readings.pressure[row, column])
        assert torch.equal(readings.drives[row], DRIVES[drive[number]])
        assert torch.equal(readings.points[column], POINTS[point[number]])
        assert not phases or readings.phase[row, column] == -number


def test_a_scan_of_one_drive_is_one_row():
    scan = at.Readings.of_rows(DRIVES[0], POINTS, [1.0, math.nan])
    assert (scan.drives.shape, scan.count) == ((1, 3), 1)


def test_rows_of_different_numbers_are_refused():
    with pytest.raises(
        ValueError, match=r"^pressure: shape \(3,\); must be \(2,\), a number for each of the point"
    ):
        at.Readings.of_rows(DRIVES[:2], POINTS, [1, 2, 3])
    with pytest.raises(ValueError, match=r"^drives: shape \(4, 3\); must be \(2, M\)"):
        at.Readings.of_rows(DRIVES, POINTS, [1, 2])
