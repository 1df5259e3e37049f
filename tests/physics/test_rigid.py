"""Hard bodies are simulated as rigid."""

import logging

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import AIR, relative_error, small_scene

from autdtorch import analytic
from autdtorch.propagators import make_propagator
from autdtorch.propagators.plan import difference_from_rigid, plan, region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import circle_points
from autdtorch.scene.obstacles import Box, Cylinder, Sphere
from autdtorch.scene.scene import Scene

CENTER = (12.2e-3, 11.9e-3, 12.1e-3)
STEEL = {"density": 7800.0, "sound_speed": 5900.0}


@given(
    radius=st.floats(1e-3, 10e-3),
    heavier=st.floats(100, 1e5),
    stiffer=st.floats(2.5, 20),
    seed=st.integers(0, 1000),
)
def test_the_difference_from_a_rigid_sphere_is_known(radius, heavier, stiffer, seed):
    way = torch.randn((12, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    around = torch.tensor(CENTER, dtype=torch.float64) + 3 * radius * way / way.norm(dim=1, keepdim=True)
    where = around[:8], around[8:], EMPTY.wavenumber, CENTER, radius
    rigid, fluid = analytic.rigid_sphere(*where), analytic.fluid_sphere(*where, heavier, stiffer)
    sphere = Sphere(CENTER, radius, density=heavier * AIR.density, sound_speed=stiffer * AIR.sound_speed)
    region = region_of(small_scene((sphere,), extent=60e-3))
    # narrow resonances of stiff and heavy spheres exceed the estimate by less than a half
    assert relative_error(rigid, fluid) < 1.5 * difference_from_rigid(region.bodies[0], region)


EMPTY = small_scene()


def test_steel_is_rigid_and_a_log_says_so(caplog):
    caplog.set_level(logging.INFO, "autdtorch")
    steel, rigid = (Box(CENTER, (5e-3,) * 3, **each) for each in (STEEL, {"rigid": True}))
    inside = torch.tensor([CENTER], dtype=torch.float64)
    heavy, expected = (make_propagator(small_scene((box,)), "box", 1.3e-3) for box in (steel, rigid))
    assert torch.equal(heavy.transfer_matrix(), expected.transfer_matrix())
    assert heavy.time_step == expected.time_step
    assert heavy.transfer_matrix(inside).abs().max() == 0
    (told,) = (record for record in caplog.records if "as rigid" in record.message)
    assert told.message.startswith(
        "obstacle 0 is simulated as rigid: the material changes the field by about 0.0"
    )


def test_a_finger_is_rigid_on_cells_that_err_by_more(caplog):
    """A cylinder of tissue erred by 7 % as a fluid and claimed 2 %; a rigid one errs by 0.6 %."""
    array = TransducerArray.grid((4, 4), pitch=10e-3, center=(0.0, 0.0, 0.0))
    points = circle_points((0.0, 0.0, 60e-3), 8e-3, 3, (0.0, 0.0, 1.0))
    shape = {"center": (0.0, 0.0, 30e-3), "radius": 6e-3, "height": 20e-3, "axis": (0.0, 1.0, 0.0)}
    tissue, wood = {"density": 1050.0, "sound_speed": 1540.0}, {"density": 300.0, "sound_speed": 1500.0}
    soft, rigid, light = (
        Scene(array, AIR, 40e3, points, [Cylinder(**shape, **each)])
        for each in (tissue, {"rigid": True}, wood)
    )
    matrix, claimed = make_propagator(soft, "box", 1.2e-3).transfer_matrix(return_error=True)
    fine = make_propagator(rigid, "box", 0.75e-3).transfer_matrix()
    assert relative_error(matrix, fine) < min(0.03, 3 * claimed)
    make_propagator(light, "box", 1e-3).transfer_matrix()
    assert "times as dense as the air" in caplog.text


@pytest.mark.parametrize(
    ("body", "tolerance"),
    [
        (Sphere(CENTER, 4e-3, **STEEL), 1e-4),  # 3e-4 by its density
        (Box(CENTER, (5e-3, 5e-3, 20e-6), **STEEL), 2e-3),  # 1.4 % of the pressure passes a foil
        (Sphere(CENTER, 4e-3, density=1e4, sound_speed=AIR.sound_speed), 2e-3),  # it may resonate
        (Sphere(CENTER, 4e-3, density=0.1 * AIR.density, sound_speed=1e4), 2e-3),
    ],
    ids=["strict", "foil", "slow", "light"],
)
def test_others_keep_their_material(body, tolerance):
    assert plan(small_scene((body,)), "box", 0.5e-3, tolerance).region.bodies[0].fluid is not None


def test_what_passes_a_heavy_plate_counts_in_its_shadow():
    """The sound through a plate is below the tolerance relative to the free field, and above it behind it."""
    plate = Box((0.0, 0.0, 0.0), (60e-3, 60e-3, 5e-3), density=60.0, sound_speed=1200.0)
    array = TransducerArray([(x, 2e-3, -25e-3) for x in (-8e-3, 0.0, 8e-3)], (0, 0, 1))
    scene = Scene(array, AIR, 40e3, [(3e-3, 1e-3, 12e-3), (-5e-3, 4e-3, 14e-3)], (plate,))
    asked, spacing = 0.1, 1.3e-3
    matrix, claimed = make_propagator(scene, "box", None, asked).transfer_matrix(return_error=True)
    soft = make_propagator(scene, "box", spacing, 1e-3).transfer_matrix()
    # 0.017 was measured between this grid and one of 0.9 mm
    assert relative_error(matrix, soft) < asked - 0.02
    assert claimed < asked
    rigid = make_propagator(scene, "box", spacing, asked)
    true = relative_error(rigid.transfer_matrix(), soft)
    assert true > 0.03
    assert rigid.transfer_matrix(return_error=True)[1] > true / 3


@pytest.mark.filterwarnings("ignore::autdtorch.OverlapWarning")
def test_a_body_that_a_later_one_cuts_keeps_its_material():
    steel = Box(CENTER, (8e-3,) * 3, **STEEL)
    hollow = Box(CENTER, (7.9e-3,) * 3, density=AIR.density, sound_speed=AIR.sound_speed)
    cut = small_scene((steel, hollow))
    assert plan(cut, "box", 0.5e-3, 2e-3).region.bodies[0].fluid is not None
