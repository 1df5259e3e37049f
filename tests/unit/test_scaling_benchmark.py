from __future__ import annotations

from pathlib import Path

import pytest
import torch
from benchmark_scaling import foci
from large_arrays import autd3_array, with_array
from scaling_report import Point, exponents, figure, measurements

from autdtorch.plot.scaling import fit_power

SIZES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


def points(series: str = "box", power: float = 1.5) -> list[Point]:
    """Time by a power law, memory always the same."""
    return [Point("foci", series, size, 0.1 * size**power, 30.0, int(size), 50) for size in SIZES]


@pytest.mark.parametrize("power", [-4.0, 0.5, 3.0])
def test_exponent_of_a_power_law_is_its_power(power: float) -> None:
    fit = fit_power(SIZES, [0.3 * size**power for size in SIZES])
    assert fit is not None
    # rounding
    assert fit.exponent == pytest.approx(power, rel=1e-12)
    assert fit.factor == pytest.approx(0.3, rel=1e-12)


def test_constant_overhead_is_not_fitted() -> None:
    fit = fit_power(SIZES, [max(4.0, size) for size in SIZES])
    assert fit is not None
    assert fit.sizes == (8.0, 32.0)
    assert fit.exponent == pytest.approx(1, rel=1e-12)


def test_costs_that_fall_with_the_size_are_fitted_at_the_small_sizes() -> None:
    fit = fit_power(SIZES, [max(0.125, 1 / size) for size in SIZES])
    assert fit is not None
    assert fit.sizes == (1.0, 4.0)
    assert fit.exponent == pytest.approx(-1, rel=1e-12)


def test_no_exponent_of_costs_that_do_not_grow() -> None:
    assert fit_power(SIZES, [1.0, 1.2, 0.9, 1.0, 1.1, 1.7]) is None


def test_tables_state_exponents_and_ranges() -> None:
    text = exponents(points())
    assert "| box | P^1.50 | 2 to 32 |  | none: within a factor 1 |" in text
    assert text.count("\n") == 2
    assert exponents(points("box, mirror images")[:1]).count("\n") == 1  # a single point has none
    assert measurements(points()).count("| 30 MB |") == len(SIZES)


def test_plot_has_a_panel_for_each_cost_and_growth(tmp_path: Path) -> None:
    drawn = figure([*points(), *points("box, mirror images")[:1]], "python it.py")
    assert len(drawn.axes) == 2
    labels = [text.get_text() for ax in drawn.axes for text in ax.get_legend().get_texts()]
    assert labels == [
        "box, slope 1.5",
        "box, mirror images",
        "box, within a factor 1",
        "box, mirror images",
    ]
    drawn.savefig(tmp_path / "scaling.png")


def test_domain_holds_paper_and_large_array() -> None:
    scene = foci(4)
    large = with_array(scene, autd3_array((2, 1)))
    lower, upper = torch.tensor(large.domain)
    assert (lower < torch.tensor(scene.domain[0])).all()
    assert (upper > torch.tensor(scene.domain[1])).all()
