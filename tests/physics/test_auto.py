"""The choice of a method and the counts of a plan."""

from __future__ import annotations

import dataclasses
import math

import pytest
from small_scenes import CUBE, relative_error, small_scene

from autdtorch.fdtd.grid import make_box, make_grid
from autdtorch.propagators import FreeSpacePropagator, SimulatedPropagator, make_propagator
from autdtorch.propagators.plan import plan
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.obstacles import Box, Obstacle, Sphere


def test_nothing_is_simulated_where_nothing_scatters() -> None:
    assert isinstance(make_propagator(small_scene()), FreeSpacePropagator)


@pytest.mark.parametrize(
    ("obstacle", "method"),
    [
        (CUBE, "box"),
        (Box((11e-3, 12e-3, 12e-3), (15e-3, 23.8e-3, 23.8e-3), rigid=True), "full"),
        (Box((12e-3,) * 3, (2e-3, 30e-3, 30e-3), rigid=True), "full"),
        (Box((12e-3,) * 3, (2e-3, 8e-3, 30e-3), rigid=True), "box"),
        (Sphere((14e-3, 12e-3, 2e-3), 4e-3, rigid=True), "box"),
    ],
    ids=["small", "filling the domain", "wall", "post", "sphere at the rim"],
)
def test_the_cheapest_accurate_method_is_chosen(obstacle: Obstacle, method: str) -> None:
    assert plan(small_scene((obstacle,))).method == method


def test_a_plan_counts_what_is_simulated() -> None:
    scene = small_scene((CUBE,))
    planned = plan(scene)
    propagator = make_propagator(scene)
    assert isinstance(propagator, SimulatedPropagator)
    matrix = propagator.transfer_matrix()
    # the place of the grid within a cell is known only with the obstacles' surfaces
    region = region_of(scene)
    assert planned.cells == pytest.approx(math.prod(make_box(region, 1e-3).shape), rel=0.1)
    whole = plan(scene, "full")
    assert whole.cells == pytest.approx(math.prod(make_grid(region, 1e-3).shape), rel=0.1)
    assert planned.runs == len(propagator.runs)
    assert planned.work < whole.work
    steps_per_period = 1 / (scene.frequency * propagator.time_step)
    # a lower limit: blocks are completed, resonances take longer, and the time step is rounded
    (grid,) = planned.grouping.grids
    assert grid.steps < 1.05 * steps_per_period * min(run.periods for run in propagator.runs)
    full = make_propagator(scene, "full").transfer_matrix()
    assert relative_error(matrix, full) < 3e-3  # as in test_box.py: the grid's error in air


def test_a_domain_too_large_for_full_is_no_obstacle_to_a_box() -> None:
    scene = dataclasses.replace(small_scene((CUBE,)), domain=((-2, -2, -2), (2, 2, 2)))
    propagator = make_propagator(scene, spacing=2e-3)  # 8e9 cells
    assert isinstance(propagator, SimulatedPropagator)
    assert propagator.method == "box"
