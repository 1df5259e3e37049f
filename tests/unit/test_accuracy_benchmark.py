from __future__ import annotations

import json
import math
from pathlib import Path

import benchmark_accuracy
import numpy as np
import pytest
import torch
from accuracy_report import Row, write_report
from benchmark_accuracy import (
    CUBE_ORDER,
    Simulation,
    compare,
    cube_case,
    extrapolate,
    make_reference,
    observed_order,
    orders,
    piston_case,
    slab_case,
    sphere_case,
    wall_case,
    worst_point,
)
from generated_block import with_block
from surface_variants import TREATMENTS, treatment

import autdtorch as at
from autdtorch.analytic.green import free_space_matrix
from autdtorch.fdtd import medium
from autdtorch.fdtd.assembly.interface import (
    LATTICE,
    PAIRS,
    VERTICES,
    Materials,
    interface_elements,
    uniform_coupling,
)
from autdtorch.fdtd.stencil import tuned_stencil

STENCIL = tuned_stencil(2 * math.pi / 8.5)
MATERIALS = Materials(np.array([1.0, 77.3]), np.array([1.0, 1 / 77.3]))


def half_filled(depth: float):
    """An element that obstacle 1 fills from its high face in x down to `depth` [cells]."""
    return (depth - LATTICE[:, 0])[None, None], np.array([1])


def test_order_of_a_power_law_is_its_power() -> None:
    spacings = (2.0, 1.5, 1.0)
    assert observed_order(spacings, [0.3 * h**1.7 for h in spacings]) == pytest.approx(1.7, rel=1e-12)


@pytest.mark.parametrize("spacings", [(1.0, 0.7), (1.0, 0.7, 0.5)])
def test_extrapolation_removes_its_own_power(spacings: tuple[float, ...]) -> None:
    limit, slope = torch.randn(2, 3, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
    found = extrapolate(spacings, [limit + slope * h**1.5 for h in spacings], 1.5)
    assert torch.allclose(found, limit, rtol=1e-12)


def test_extrapolation_from_two_spacings_is_richardsons() -> None:
    coarse, fine = torch.tensor([1.3 + 0.2j]), torch.tensor([1.1 - 0.1j])
    richardson = fine + (fine - coarse) / (1.5**2 - 1)
    assert torch.allclose(extrapolate((1.5, 1.0), (coarse, fine), 2.0), richardson, rtol=1e-6)  # complex64


def test_orders_are_per_case_and_treatment() -> None:
    rows = [Row("a", name, h, h**p, None, 1.0, True) for name, p in (("x", 1), ("y", 2)) for h in (1.0, 0.5)]
    found = orders([*rows, Row("b", "x", 1.0, 0.1, None, 1.0, True)])
    assert list(found) == ["a"]
    assert found["a"] == pytest.approx({"x": 1, "y": 2}, rel=1e-12)


def test_scattered_error_is_that_of_the_scattered_field() -> None:
    case = sphere_case("sphere", (0.2e-3, -0.3e-3, 0.1e-3))
    free = free_space_matrix(case.points, case.scene.array, case.scene.wavenumber)
    row = compare(case, "nothing scattered", 1.0, Simulation(free, 0.0, True))
    # two sums of the same series; of the smaller scattered field 1e-9 is far above rounding
    assert row.scattered == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("name", TREATMENTS)
def test_treatments_of_air_are_air(name: str) -> None:
    distance, material = half_filled(10.0)
    found = TREATMENTS[name](distance, material, MATERIALS, STENCIL)
    assert np.allclose(found.bonds, uniform_coupling(STENCIL), rtol=1e-12)
    assert np.allclose(found.mass, 1 / 8, rtol=1e-12)


@pytest.mark.parametrize(("name", "share"), [("staircase", 0.5), ("series bonds", 0.7)])
def test_treatments_of_a_layer(name: str, share: float) -> None:
    distance, material = half_filled(0.3)
    found = TREATMENTS[name](distance, material, MATERIALS, STENCIL)
    number = VERTICES[:, 0]
    assert (found.number == number).all()
    # mass: half of the cells are heavy, or 70 % of the volume
    assert found.mass.sum() == pytest.approx(1 - share + share / 77.3, rel=1e-12)
    # bonds: across the face in series, along it those of a uniform material
    ends = number[PAIRS]
    across, air = ends[:, 0] != ends[:, 1], ~ends.any(axis=1)
    ratio = uniform_coupling(STENCIL) / found.bonds[0]
    assert np.allclose(ratio[across], 1 - share + share * 77.3, rtol=1e-12)
    assert np.allclose(ratio[air], 1, rtol=1e-12)


def test_a_treatment_ends_with_its_context() -> None:
    with treatment("staircase"):
        assert medium.interface_elements is TREATMENTS["staircase"]
    assert medium.interface_elements is interface_elements


def test_cases_are_normalised_as_free_space() -> None:
    for case in (sphere_case("rigid sphere"), slab_case(), wall_case(), piston_case()):
        free = free_space_matrix(case.points, case.scene.array, case.scene.wavenumber)
        # of the order of the incident field: a wall at most doubles it, 4 pi would be far outside
        assert 0.3 < float(case.exact.norm() / free.norm()) < 2


def test_cubes_reference_is_the_limit_of_what_was_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class PowerLaw:
        """Transfer matrices that differ from that of free space by a power of the spacing."""

        def __init__(self, scene: at.Scene, _: str, spacing: float, tolerance: float, cache: bool) -> None:
            self.scene, self.factor = scene, 1 + (10 * spacing) ** CUBE_ORDER

        def transfer_matrix(self, points: torch.Tensor) -> torch.Tensor:
            return self.factor * free_space_matrix(points, self.scene.array, self.scene.wavenumber)

    monkeypatch.setattr(benchmark_accuracy, "CUBE_MATRICES", tmp_path / "reference" / "cubes.json")
    monkeypatch.setattr(at, "make_propagator", PowerLaw)
    make_reference()
    case = cube_case("two_cubes")
    free = free_space_matrix(case.scene.control_points[:1], case.scene.array, case.scene.wavenumber)
    assert torch.allclose(case.exact, free, rtol=1e-10)


def test_simulations_are_measured() -> None:
    row = worst_point(piston_case(), 1.5)
    # 0.4 % for points at 2 mm (docs/numerics.md); a wrong normalisation would be of the order of one
    assert row.total < 5e-3
    assert row.settled
    assert row.seconds > 0


def test_report_fills_in_its_block_and_keeps_the_rest(tmp_path: Path) -> None:
    rows = [Row("sphere", "default", h, 0.02 * h, 0.05 * h, 3 / h, h > 1) for h in (2.0, 1.0)]
    write_report(rows, orders(rows), "python it.py", tmp_path)
    stored = json.loads((tmp_path / "accuracy.json").read_text(encoding="utf-8"))
    assert stored["command"] == "python it.py"
    assert [Row(**row) for row in stored["rows"]] == rows
    text = (tmp_path / "benchmarks.md").read_text(encoding="utf-8")
    assert "python it.py" in text
    assert "| sphere, default, 1 mm, total | at most 3 % | 2 % | yes |" in text
    assert (tmp_path / "accuracy.png").stat().st_size > 0
    with pytest.raises(ValueError, match="once each"):
        with_block("no marks", "script", "block")
