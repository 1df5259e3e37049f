import itertools
import logging
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autdtorch.fdtd import stability
from autdtorch.fdtd.stability import fewest_steps, largest_eigenvalue, whole_steps
from autdtorch.fdtd.stencil import tuned_stencil

STENCIL = tuned_stencil(2 * math.pi / 8.5)
SHAPE = (8, 8, 8)


def test_of_uniform_air_it_is_that_of_the_shortest_wave() -> None:
    nothing = np.zeros(0, np.int64), np.zeros((0, 27))
    assert largest_eigenvalue(*nothing, STENCIL, SHAPE) == STENCIL.largest_symbol


def test_many_cells_get_the_bound(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    inside = np.zeros(SHAPE, bool)
    inside[2:-2, 2:-2, 2:-2] = True
    index = np.flatnonzero(inside)
    weight = np.tile(4 * STENCIL.weights, (len(index), 1))  # a body of a quarter of the mass
    iterated = largest_eigenvalue(index, weight, STENCIL, SHAPE)
    monkeypatch.setattr(stability, "MOST_CELLS", len(index) - 1)
    with caplog.at_level(logging.INFO):
        assert largest_eigenvalue(index, weight, STENCIL, SHAPE) > iterated
    assert f"{len(index)} heterogeneous cells" in caplog.text


@given(st.floats(2.5, 1e3))
def test_steps_are_whole_in_the_shortest_block_that_is_long_enough(fewest: float) -> None:
    steps = whole_steps(fewest)
    assert stability.LONG_ENOUGH * steps <= fewest <= steps * (1 + 1e-9)
    for periods in range(1, steps.denominator):
        assert math.ceil(periods * fewest) * stability.LONG_ENOUGH > periods * fewest
    # a block of q periods loses less than 1 / (q fewest)
    assert steps.denominator <= 1 + stability.LONG_ENOUGH / (1 - stability.LONG_ENOUGH) / fewest


def test_fewest_steps_are_those_of_leapfrog() -> None:
    steps = fewest_steps(STENCIL, largest=9.0)
    assert STENCIL.time_factor(steps) * 9.0 == pytest.approx(4, rel=1e-12)
    assert all(a < b for a, b in itertools.pairwise(fewest_steps(STENCIL, value) for value in (7, 8, 9)))
