from __future__ import annotations

import pytest
import torch
from benchmarks.scaling import foci
from shared.scenes import autd3_array, with_array

from autdtorch.plot.costs import fit_power

SIZES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


@pytest.mark.parametrize(
    ("costs", "exponent", "sizes"),
    [
        ([0.3 * size**-4.0 for size in SIZES], -4.0, (1.0, 16.0)),
        ([max(4.0, size) for size in SIZES], 1.0, (8.0, 32.0)),  # a constant overhead is not fitted
        ([max(0.125, 1 / size) for size in SIZES], -1.0, (1.0, 4.0)),
    ],
)
def test_exponent_of_a_power_law_is_its_power(
    costs: list[float], exponent: float, sizes: tuple[float, float]
) -> None:
    fit = fit_power(SIZES, costs)
    assert fit is not None
    assert (fit.exponent, *fit.sizes) == pytest.approx((exponent, *sizes), rel=1e-12)
    assert fit_power(SIZES, [1.0, 1.2, 0.9, 1.0, 1.1, 1.7]) is None  # they do not grow


def test_domain_holds_paper_and_large_array() -> None:
    scene = foci(4)
    large = with_array(scene, autd3_array((2, 1)))
    lower, upper = torch.tensor(large.domain)
    assert (lower < torch.tensor(scene.domain[0])).all()
    assert (upper > torch.tensor(scene.domain[1])).all()
