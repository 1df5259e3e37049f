"""The force on bodies by the field around them, of any propagator."""

import math
from dataclasses import replace

import pytest
import torch
from small_scenes import CUBE, small_scene

import autdtorch as at
from autdtorch.propagators.field_forces import forces_on_obstacles

BALLS = (
    at.Sphere((10e-3, 15e-3, 12e-3), 2e-3, rigid=True),
    at.Sphere((17e-3, 6e-3, 12e-3), 1e-3, density=100.0, sound_speed=340.0),
)


class ByField:
    """A propagator of which pressures alone are known."""

    def __init__(self, propagator):
        self.scene, self.field = propagator.scene, propagator.field


@pytest.mark.parametrize("absorption", [0.0, 20.0])
def test_pressures_around_bodies_give_the_force_of_their_t_matrices(absorption):
    propagator = at.make_propagator(small_scene(BALLS, absorption=absorption), "tmatrix", tolerance=1e-8)
    drive = torch.tensor([1, 0.3 + 0.7j, -0.5, 0.9j], dtype=torch.complex128)
    exact, by_field = (forces_on_obstacles(one, drive) for one in (propagator, ByField(propagator)))
    # Waves of some 10 degrees; rounding is magnified by h_l of the highest
    assert (by_field - exact).norm() < 1e-7 * exact.norm()
    assert torch.equal(exact[1], at.radiation_force(propagator, drive, body=1))


def test_a_grid_gives_its_force_and_none_where_another_body_is_too_near():
    drive = torch.ones(4, dtype=torch.complex128)
    simulated = at.make_propagator(small_scene((CUBE,)), "box", spacing=1e-3)
    exact = at.radiation_force(at.make_propagator(small_scene((CUBE,)), "tmatrix", spacing=1e-3), drive)
    force = forces_on_obstacles(simulated, drive)[0]
    assert (force - exact).norm() < 0.05 * exact.norm()  # two simulations of 1 mm, each with its own grid
    near = replace(BALLS[0], center=(13e-3, 8e-3, 12e-3))
    alone = forces_on_obstacles(ByField(replaced(simulated, (near, BALLS[1]))), drive)
    assert alone.isnan().all()


def replaced(propagator, obstacles):
    """The field of a propagator in the scene of other obstacles."""
    other = at.make_propagator(propagator.scene, "free_space")
    other.scene = small_scene(obstacles)
    return other


def test_obstacles_that_touch_have_the_force_on_both():
    touching = (BALLS[0], at.Sphere((13e-3, 15e-3, 12e-3), 1.2e-3, rigid=True))
    forces = forces_on_obstacles(replaced(at.make_propagator(small_scene()), touching), torch.ones(4) + 0j)
    assert not math.isnan(float(forces.sum()))
    assert torch.equal(forces[0], forces[1])
