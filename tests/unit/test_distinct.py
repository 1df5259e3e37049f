"""Distinct rows and cells are those of `numpy.unique`."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autdtorch.utils import spatial


@given(st.integers(0, 200), st.integers(1, 5), st.integers(1, 3), st.sampled_from(["f4", "f8", "i8"]))
def test_rows_and_cells_are_numbered(count, columns, values, kind):
    draw = np.random.default_rng([count, columns, values])
    rows = draw.integers(0, values, (count, columns)).astype(kind)
    first, number = spatial.distinct_rows(rows)
    assert len(first) == len(np.unique(rows, axis=0)) if count else len(first) == 0
    assert (rows[first][number] == rows).all()
    cells = draw.integers(0, 50, (count, columns))
    some = spatial.distinct_cells(cells, 50)
    assert (some == np.unique(cells)).all()
    assert (some[spatial.places_among(some, 50)[cells]] == cells).all()


def test_rows_with_one_digest_stay_apart(monkeypatch):
    monkeypatch.setattr(spatial, "_MULTIPLIER", np.uint64(0))  # all digests are zero
    first, number = spatial.distinct_rows(np.array([[1, 2], [2, 1], [1, 2]]))
    assert first[number].tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("interior", "turns"), [((408, 408, 17), 1), ((408, 17, 408), 2), ((17, 408, 408), 0)]
)
def test_the_first_axis_of_a_large_flat_grid_is_its_shortest(interior, turns):
    from autdtorch.fdtd.grouping import _turns_to_flat

    assert np.roll(interior, _turns_to_flat(interior))[0] == 17
    assert _turns_to_flat(interior) == turns
    assert _turns_to_flat((40, 40, 10)) == _turns_to_flat((200, 200, 150)) == 0
