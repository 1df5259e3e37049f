import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from autdtorch.objectives.metrics import focus_metrics

pressures = st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=6)


def plane_distances(size, cells):
    """Distances (cells, cells) of the cells of a square plane from its centre."""
    along = size * ((torch.arange(cells, dtype=torch.float64) + 0.5) / cells - 0.5)
    return torch.hypot(along[:, None], along[None, :])


def test_figures_of_known_pressures():
    metrics = focus_metrics([[1.0, 3.0], [2.0, 2.0], [0.0, 0.0]])
    assert metrics.mean.tolist() == [2.0, 2.0, 0.0]
    assert metrics.min.tolist() == [1.0, 2.0, 0.0]
    assert metrics.std.tolist() == [1.0, 0.0, 0.0]  # of the population: the foci are all there are
    assert metrics.uniformity.tolist() == [0.5, 1.0, 1.0]
    assert metrics.area is None


@given(pressures, st.floats(1e-3, 1e3), st.randoms())
def test_louder_foci_in_another_order_are_louder_by_exactly_that(pressure, factor, random):
    louder = [factor * p for p in random.sample(pressure, len(pressure))]
    metrics, other = focus_metrics(pressure), focus_metrics(louder)
    for name, power in (("mean", 1), ("min", 1), ("std", 1), ("uniformity", 0)):
        # Sums of at most six terms in another order; a std near 0 is the rounding of the mean.
        expected = getattr(metrics, name) * factor**power
        torch.testing.assert_close(getattr(other, name), expected, rtol=1e-12, atol=1e-12 * max(louder))


@pytest.mark.parametrize(
    ("shape", "radius", "foci"),
    [
        (lambda distance: (distance < 20e-3).double(), 20e-3, 4),
        # Half the intensity of a Gaussian focus: exp(-r^2 / 2w^2) = 1 / sqrt(2) at r^2 = w^2 log 2.
        (lambda distance: torch.exp(-(distance**2) / 2e-4), 10e-3 * math.sqrt(math.log(2)), 1),
    ],
    ids=["disc", "gaussian"],
)
def test_the_area_within_half_the_intensity_is_shared_among_the_foci(shape, radius, foci):
    cells, size = 400, 100e-3
    cell = size / cells
    area = focus_metrics([1.0] * foci, shape(plane_distances(size, cells)), cell**2).area
    # Only cells cut by the circle can be wrong, about 8 radius / cell of them, and on average by nothing.
    assert foci * area.item() == pytest.approx(math.pi * radius**2, abs=8 * radius * cell)


def test_area_belongs_to_the_drive_whose_plane_it_is():
    plane = torch.tensor([[[1.0, 0.0]], [[1.0, 1.0]], [[0.0, 0.0]]])
    area = focus_metrics(torch.ones(3, 2), plane, 4.0).area
    assert area.tolist() == [2.0, 4.0, 0.0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.0, math.nan],), "pressure: .*nan.* Pa; every entry must be finite"),
        (([1.0, -0.5],), r"pressure: -0\.5 Pa; every magnitude must be >= 0"),
        ((1.0,), r"pressure: shape \(\); must be \(\.\.\., P\)"),
        (([],), r"pressure: shape \(0,\)"),
        (([1.0 + 1j],), "pressure: .*real"),
        (([1.0], [[1.0]]), "cell_area: None"),
        (([1.0], None, 1.0), "plane_pressure: None"),
        (([1.0], [1.0], 1.0), r"plane_pressure: shape \(1,\)"),
        (([[1.0], [2.0]], [[1.0]], 1.0), r"plane_pressure: shape \(1, 1\); must be \(2, Nu, Nv\)"),
        (([1.0], [[1.0]], 0.0), r"cell_area: 0\.0 m\^2"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        focus_metrics(*arguments)
