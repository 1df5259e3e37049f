"""The estimated cost of simulations."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from small_scenes import CUBE, small_scene

import autdtorch as at
from autdtorch.propagators import estimate as simulation_estimate

BALL = at.Sphere((12e-3, 20e-3, 5e-3), 3e-3, density=0.2, sound_speed=900.0)


@pytest.mark.parametrize("method", ["box", "full"])
@pytest.mark.parametrize("spacing", [1.4e-3, 0.9e-3])
def test_cells_and_runs_are_those_of_the_simulation(method: str, spacing: float) -> None:
    scene = small_scene((CUBE, BALL))
    cost = at.estimate(scene, spacing, method=method)
    propagator = at.make_propagator(scene, method, spacing)
    propagator.transfer_matrix()
    (assembly,) = propagator._simulation.assemblies  # type: ignore[union-attr]
    assert cost.method == method
    # a grid may be placed so that an axis has a cell more
    shape = assembly.grid.shape
    assert math.prod(shape) == pytest.approx(cost.cells, rel=4 / min(shape))
    assert cost.runs == len(propagator.runs)  # type: ignore[union-attr]


def test_symmetric_points_share_a_run() -> None:
    points = [(20e-3, 12e-3 + y, 12e-3 + z) for y in (-4e-3, 4e-3) for z in (-3e-3, 3e-3)]
    assert at.estimate(replace(small_scene((CUBE,)), control_points=points), 2e-3, method="box").runs == 1


def test_without_memory_for_a_coarse_grid_symmetries_are_neglected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation_estimate, "available_memory", lambda: 0)
    assert at.estimate(small_scene((CUBE,)), 1e-3, method="full").runs == 3  # one for each control point


def test_memory_and_time_grow_with_the_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation_estimate, "_rate", lambda *_: 1e9)  # whatever else the machine does
    scene = small_scene()
    coarse, fine = (at.estimate(scene, spacing, method="full") for spacing in (0.3e-3, 0.1e-3))
    assert fine.cells > 5 * coarse.cells
    assert 8 < fine.memory / fine.cells < 24  # two fields of four bytes a cell, and what else is held
    assert fine.seconds > 1.2 * fine.cells / coarse.cells * coarse.seconds  # with three times the steps


def test_free_space_takes_no_cells() -> None:
    cost = at.estimate(small_scene())
    assert (cost.method, cost.spacing, cost.cells, cost.runs) == ("free_space", None, 0, 0)
    assert 0 < cost.seconds < 1e-3


def test_infeasible_simulations_are_estimated_too() -> None:
    cost = at.estimate(small_scene((CUBE,), extent=0.1), 1.8e-5, method="full")
    assert cost.memory > 50e9
    assert cost.seconds > 3600


def test_double_precision_takes_twice_the_memory_of_fields() -> None:
    scene = small_scene()
    single, double = (
        at.estimate(scene, 0.4e-3, method="full", dtype=dtype) for dtype in ("float32", "float64")
    )
    assert 1.3 < double.memory / single.memory < 2  # less than twice: what is recorded is in double anyway


@pytest.mark.parametrize(
    ("field", "arguments"),
    [
        ("spacing", {"spacing": 0.0}),
        ("spacing", {"spacing": 5e-3, "method": "full"}),
        ("spacing", {"spacing": 1e-9, "method": "full"}),
        ("tolerance", {"tolerance": 1.0}),
        ("method", {"method": "fem"}),
        ("kernel", {"kernel": "tpu"}),
        ("dtype", {"dtype": "float16"}),
    ],
)
def test_bad_input_is_refused_by_name(field: str, arguments: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=f"^{field}: "):
        at.estimate(small_scene(), **arguments)  # type: ignore[arg-type]
