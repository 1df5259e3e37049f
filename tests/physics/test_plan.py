"""What a plan chooses, and counts."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import AIR, CUBE, relative_error, small_scene

import autdtorch as at
from autdtorch.fdtd import costs, grouping
from autdtorch.fdtd.steady_state import WindowedRuns
from autdtorch.propagators import FreeSpacePropagator, simulated
from autdtorch.propagators import estimate as simulation_estimate
from autdtorch.propagators.plan import plan

CENTER, RADIUS = (12.2e-3, 11.9e-3, 12.1e-3), 3.3e-3


BALL = at.Sphere((12e-3, 20e-3, 5e-3), 3e-3, density=0.2, sound_speed=900.0)


@pytest.mark.parametrize(
    ("obstacle", "method"),
    [
        (CUBE, "box"),
        (at.Box((11e-3, 12e-3, 12e-3), (15e-3, 23.8e-3, 23.8e-3), rigid=True), "box"),
        (at.Box((12e-3,) * 3, (2e-3, 30e-3, 30e-3), rigid=True), "full"),
        (at.Box((12e-3,) * 3, (2e-3, 8e-3, 30e-3), rigid=True), "box"),
        (at.Sphere((14e-3, 12e-3, 2e-3), 4e-3, rigid=True), "tmatrix"),
        (at.VoxelMask(np.ones((4, 4, 4), bool), 1e-3, (14e-3, 12e-3, 0.0), rigid=True), "box"),
    ],
    ids=["small", "filling the domain", "wall", "post", "sphere", "at the rim"],
)
def test_the_cheapest_accurate_method_is_chosen(obstacle, method):
    assert plan(small_scene((obstacle,))).method == method


@pytest.mark.parametrize("method", ["auto", "tmatrix", "box", "full"])
def test_grids_are_chosen_where_they_are_used(method, monkeypatch):
    def choose_grids(*_):
        raise AssertionError("grids that nobody has asked for")

    monkeypatch.setattr("autdtorch.propagators.plan.choose_grids", choose_grids)
    scene = small_scene((BALL,))
    planned = plan(scene, method)  # "auto" takes the T-matrix of a sphere
    assert planned.of(replace(scene, frequency=39e3)).at(2e-3, 1e-2).method == planned.method


def test_the_domain_of_a_box_may_be_too_large_for_full():
    scene = replace(small_scene((CUBE,)), domain=((-2, -2, -2), (2, 2, 2)))
    assert at.make_propagator(scene, spacing=2e-3).method == "box"  # 8e9 cells


def test_a_plan_counts_what_is_simulated():
    scene = small_scene((replace(CUBE, center=(12e-3, 12.7e-3, 11.6e-3)),))  # without symmetries
    planned, propagator = plan(scene), at.make_propagator(scene)
    matrix = propagator.transfer_matrix()
    assert planned.runs == len(propagator.runs)
    assert planned.work < plan(scene, "full").work
    steps_per_period = 1 / (scene.frequency * propagator.time_step)
    # a lower limit: blocks are completed, resonances take longer, and the time step is rounded
    (grid,) = planned.grouping.grids
    assert grid.steps < 1.05 * steps_per_period * min(run.periods for run in propagator.runs)
    full = at.make_propagator(scene, "full").transfer_matrix()
    assert relative_error(matrix, full) < 3e-3  # as in test_box.py: the grid's error in air


@pytest.mark.parametrize(("method", "spacing"), [("box", 0.9e-3), ("full", 1.4e-3)])
def test_cells_and_runs_are_those_of_the_simulation(method, spacing):
    scene = small_scene((CUBE, BALL))
    cost = at.estimate(scene, spacing, method=method)
    propagator = at.make_propagator(scene, method, spacing)
    propagator.transfer_matrix()
    (assembly,) = propagator.simulation.assemblies
    assert cost.method == method
    # a grid may be placed so that an axis has a cell more
    shape = assembly.grid.shape
    assert math.prod(shape) == pytest.approx(cost.cells, rel=4 / min(shape))
    assert cost.runs == len(propagator.runs)


def test_symmetric_points_share_a_run_unless_memory_is_short(monkeypatch):
    points = [(20e-3, 12e-3 + y, 12e-3 + z) for y in (-4e-3, 4e-3) for z in (-3e-3, 3e-3)]
    scene = replace(small_scene((CUBE,)), control_points=points)
    assert at.estimate(scene, 2e-3, method="box").runs == 1
    monkeypatch.setattr(simulation_estimate, "available_memory", lambda: 0)  # for a coarse grid
    assert at.estimate(scene, 2e-3, method="box").runs == 4


def test_the_grid_that_finds_symmetries_resolves_slow_fluids():
    """Six cells per wavelength of air are two in a fluid where sound is a third as fast, which is refused."""
    ball = at.Sphere((12e-3,) * 3, 2e-3, density=10 * AIR.density, sound_speed=AIR.sound_speed / 3)
    assert at.estimate(small_scene((ball,)), 0.4e-3, method="box").runs > 0


def test_memory_and_time_grow_with_the_cells(monkeypatch):
    monkeypatch.setattr(simulation_estimate, "_rate", lambda *_: 1e9)  # whatever else the machine does
    scene = small_scene()
    coarse, fine = (at.estimate(scene, spacing, method="full") for spacing in (0.3e-3, 0.1e-3))
    assert fine.cells > 5 * coarse.cells
    assert 8 < fine.memory / fine.cells < 24  # two fields of four bytes a cell, and what else is held
    assert fine.seconds > 1.2 * fine.cells / coarse.cells * coarse.seconds  # with three times the steps
    double = at.estimate(scene, 0.3e-3, method="full", dtype="float64")
    assert 1.3 < double.memory / coarse.memory < 2  # less than twice: what is recorded is in double anyway


@pytest.mark.parametrize("ratio", [0.5, 1.0])
def test_the_time_of_slow_obstacles_is_the_least(ratio):
    """They may resonate: foam took 8 to 11 times as long as was told."""
    ball = at.Sphere((12e-3,) * 3, 2e-3, density=2 * AIR.density, sound_speed=ratio * AIR.sound_speed)
    cost = at.estimate(small_scene((ball,)), 0.5e-3, method="box")
    assert cost.resonates == ("at least" in repr(cost)) == (ratio < 1)


def test_free_space_takes_no_cells_and_infeasible_simulations_are_estimated():
    assert isinstance(at.make_propagator(small_scene()), FreeSpacePropagator)
    cost = at.estimate(small_scene())
    assert (cost.method, cost.spacing, cost.cells, cost.runs) == ("free_space", None, 0, 0)
    assert 0 < cost.seconds < 1e-3
    cost = at.estimate(small_scene((CUBE,), extent=0.1), 1.8e-5, method="full")
    assert cost.memory > 50e9
    assert cost.seconds > 3600


def test_waves_between_bodies_and_planes_take_time_and_memory():
    """Twice the radius is three to four times the waves, whose system is a matrix for as many transducers."""
    array = at.TransducerArray.autd3((0, 0, 0), (0, 0, 1))
    floor = at.Reflector((0, -0.2, 0), (0, 1, 0))

    def cost(radius, reflectors):
        body = at.Sphere((0, 0, 0.1), radius, rigid=True)
        scene = at.Scene(array, at.Medium(1.2, 340.0), 40e3, [(0, 0, 0.17)], [body], reflectors=reflectors)
        waves = sum(len(body.matrix) for body in at.make_propagator(scene).bodies.bodies)
        return at.estimate(scene), waves

    (alone, _), (small, few), (large, many) = cost(2e-2, ()), cost(1e-2, (floor,)), cost(2e-2, (floor,))
    assert (large.method, large.runs, large.cells) == ("tmatrix", 0, 0)
    assert large.seconds > 3 * alone.seconds  # with nothing to solve
    assert (many / few) ** 1.5 < large.seconds / small.seconds < (many / few) ** 2
    assert large.memory > 3 * 16 * many**2  # a complex matrix, its factors and what it is made of


def test_an_estimate_by_tolerance_tells_the_choice(monkeypatch):
    """Errors are usual ones within a factor of three, of which the spacing is the root."""
    monkeypatch.setattr(simulation_estimate, "_rate", lambda *_: 1e9)
    scene = small_scene((replace(CUBE, rotation=(0.2, 0.3, 0.1)),))
    costs = [at.estimate(scene, None, tolerance, method="box") for tolerance in (0.1, 0.02)]
    for tolerance, cost in zip((0.1, 0.02), costs, strict=True):
        chosen = at.make_propagator(scene, "box", None, tolerance).spacing
        assert chosen / 1.75 < cost.spacing < 1.75 * chosen
        assert cost.seconds > at.estimate(scene, cost.spacing, method="box").seconds  # coarser grids count
    loose, tight = costs
    assert tight.spacing < loose.spacing
    by_waves = at.estimate(scene, None, 0.02, method="tmatrix")
    assert (by_waves.method, by_waves.spacing) == ("tmatrix", pytest.approx(tight.spacing, rel=0.2))
    monkeypatch.setattr(simulation_estimate, "_PILOT_SECONDS", 0.0)  # all is taken to be scattered
    assert at.estimate(scene, None, 0.02, method="box").spacing < tight.spacing


@given(
    kind=st.sampled_from([at.Box, at.Cylinder]),
    size=st.tuples(*[st.floats(3e-3, 9e-3)] * 3),
    turn=st.floats(0, 1),
    density=st.sampled_from([None, 5.0, 300.0]),
    tolerance=st.sampled_from([0.03, 0.05, 0.1]),
)
@settings(max_examples=5, deadline=None)
def test_an_estimate_by_tolerance_is_the_work_of_the_choice(kind, size, turn, density, tolerance):
    """In updates of cells; those of the estimate itself are on the first of two grids at least.

    Errors of cut faces are 0.3 to 3 times the usual ones, as thin cylinders show. Spacings then differ by up
    to the root of 3, and updates by at least its square; along the grid, errors are nearer the usual ones.
    """
    material = {"rigid": True} if density is None else {"density": density, "sound_speed": 500.0}
    axis = math.sin(turn), 0, math.cos(turn)
    shape = (size, (0, 0, turn)) if kind is at.Box else (size[0] / 2, size[1], axis)
    scene = small_scene((kind((12e-3,) * 3, *shape, **material),))
    updates, advance = [], WindowedRuns.advance

    def counted(stepped):
        updates.append(len(stepped._state.now) * stepped._steps * math.prod(stepped._assembly.grid.shape))
        return advance(stepped)

    with pytest.MonkeyPatch.context() as patch:
        for name in ("CELL", "UNLIKE", "COLUMN", "PAIR", "ASSEMBLY", "MESH", "RUN", "SCENE"):
            patch.setattr(costs, f"_{name}_STEPS", 0.0)
        patch.setattr(grouping, "_LAYER", 1.0)  # as if a cell in a layer took no longer than one of air
        patch.setattr(costs.Costs, "_at_once", 1)
        patch.setattr(simulation_estimate, "_rate", lambda *_: 1.0)
        patch.setattr(simulation_estimate, "_PILOT_SECONDS", math.inf)
        patch.setattr(WindowedRuns, "advance", counted)
        estimate = at.estimate(scene, None, tolerance, method="box")
        of_estimate = sum(updates)
        at.make_propagator(scene, "box", None, tolerance, cache=False)
        taken = sum(updates) - of_estimate
    assert 0 < of_estimate < 0.8 * taken
    factor = 2 if kind is at.Box else 4
    assert estimate.seconds < factor * taken
    assert estimate.resonates or estimate.seconds > taken / factor


def test_a_choice_logs_its_cost_and_warns_if_it_is_long(monkeypatch, caplog):
    caplog.set_level(logging.DEBUG, "autdtorch")
    scene = small_scene((replace(CUBE, rotation=(0.2, 0.3, 0.1)),))
    for noticed, level in ((math.inf, logging.DEBUG), (0.0, logging.INFO)):
        monkeypatch.setattr(simulated, "_NOTICED", noticed)  # the first grid may compile its kernels
        at.make_propagator(scene, "box", None, 0.01)
        first, *_ = costs = [record for record in caplog.records if "finer grid" in record.getMessage()]
        assert {record.levelno for record in costs} == {level}
        assert "for a tolerance of 0.01: about" in first.getMessage()
        caplog.clear()
    monkeypatch.setattr(simulated, "_LONG", 0.0)
    at.make_propagator(scene, "box", None, 0.01)
    assert sum("limit them by seconds=" in record.getMessage() for record in caplog.records) == 1
    caplog.clear()
    at.make_propagator(scene, "box", None, 0.01, seconds=1e3)
    assert "limit them by seconds=" not in caplog.text
