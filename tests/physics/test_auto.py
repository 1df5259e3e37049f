"""What `method="auto"` chooses, why, and what it says of it."""

from __future__ import annotations

import dataclasses
import logging
import math
import re

import pytest
from small_scenes import CUBE, relative_error, small_scene

from autdtorch.fdtd.grid import make_box, make_grid
from autdtorch.propagators import FreeSpacePropagator, SimulatedPropagator, make_propagator
from autdtorch.propagators.auto import method_for
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.obstacles import Box, Obstacle, Sphere


def test_nothing_is_simulated_where_nothing_scatters(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        assert isinstance(make_propagator(small_scene()), FreeSpacePropagator)
    assert "no obstacles: nothing to simulate" in caplog.text


@pytest.mark.parametrize(
    ("obstacle", "method", "reason"),
    [
        (CUBE, "box", "times cheaper than full"),
        (Box((11e-3, 12e-3, 12e-3), (15e-3, 23.8e-3, 23.8e-3), rigid=True), "full", "times cheaper than box"),
        (Box((12e-3,) * 3, (2e-3, 30e-3, 30e-3), rigid=True), "full", "a wall goes on without end"),
        (Box((12e-3,) * 3, (2e-3, 8e-3, 30e-3), rigid=True), "box", "reach out of the domain"),
        (Sphere((14e-3, 12e-3, 2e-3), 4e-3, rigid=True), "box", "reach out of the domain"),
    ],
    ids=["small", "filling the domain", "wall", "post", "sphere at the rim"],
)
def test_the_cheapest_that_is_right(
    obstacle: Obstacle, method: str, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        assert method_for(small_scene((obstacle,)), "auto", 1e-3, 2e-3) == method
    assert reason in caplog.text


def test_the_log_counts_what_is_simulated(caplog: pytest.LogCaptureFixture) -> None:
    scene = small_scene((CUBE,))
    with caplog.at_level(logging.INFO):
        propagator = make_propagator(scene, spacing=1e-3)
        assert isinstance(propagator, SimulatedPropagator)
        assert propagator.method == "box"
        matrix = propagator.transfer_matrix()
    chosen, naive = (
        [int(number.replace(",", "")) for number in counts]
        for counts in re.findall(r"([\d,]+) cells x ([\d,]+) steps x (\d+) runs", caplog.text)
    )
    # the place of the grid within a cell is not known before the obstacles' surfaces are
    assert chosen[0] == pytest.approx(math.prod(make_box(region_of(scene), 1e-3).shape), rel=0.1)
    assert naive[0] == pytest.approx(math.prod(make_grid(region_of(scene), 1e-3).shape), rel=0.1)
    assert chosen[2] == len(propagator.runs)
    assert naive[2] == len(scene.array)
    steps_per_period = 1 / (scene.frequency * propagator.time_step)
    # at least, and in air: blocks are finished, resonances are awaited, and the time step is rounded
    assert chosen[1] < 1.05 * steps_per_period * min(run.periods for run in propagator.runs)
    full = make_propagator(scene, "full", 1e-3).transfer_matrix()
    assert relative_error(matrix, full) < 3e-3  # as in test_box.py: the grid's error in air


def test_a_domain_too_large_for_full_is_no_obstacle_to_a_box() -> None:
    scene = dataclasses.replace(small_scene((CUBE,)), domain=((-2, -2, -2), (2, 2, 2)))
    propagator = make_propagator(scene, spacing=2e-3)  # 8e9 cells
    assert isinstance(propagator, SimulatedPropagator)
    assert propagator.method == "box"
