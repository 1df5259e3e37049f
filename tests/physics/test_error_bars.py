"""Error estimates against exact solutions."""

from __future__ import annotations

import math

import pytest
import torch
from small_scenes import AIR, relative_error, small_scene

from autdtorch import analytic
from autdtorch.analytic.green import free_space_matrix
from autdtorch.fdtd.spacing import RATIO, coarsest_spacing, grid_error, second_spacing, spacing_for
from autdtorch.propagators import FreeSpacePropagator, make_propagator
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.obstacles import Sphere

CENTER, RADIUS = (12.2e-3, 11.9e-3, 12.1e-3), 3.3e-3


def exact_sphere(rigid: bool = True) -> tuple[Sphere, torch.Tensor]:
    scene = small_scene()
    where = (scene.control_points, scene.array.positions, scene.wavenumber, CENTER, RADIUS)
    strength = 4 * math.pi * scene.array.source_strength
    if rigid:
        return Sphere(CENTER, RADIUS, rigid=True), strength * analytic.rigid_sphere(*where)
    heavy = Sphere(CENTER, RADIUS, density=10 * AIR.density, sound_speed=1.5 * AIR.sound_speed)
    return heavy, strength * analytic.fluid_sphere(*where, 10.0, 1.5)


@pytest.mark.parametrize("rigid", [True, False], ids=["rigid", "heavy"])
@pytest.mark.parametrize("spacing", [1.8e-3, 1.3e-3])
def test_the_estimate_is_honest(rigid: bool, spacing: float) -> None:
    """Required: within a factor of 3 of the true error, or above it."""
    sphere, exact = exact_sphere(rigid)
    propagator = make_propagator(small_scene((sphere,)), "full", spacing, tolerance=1e-3)
    matrix, error = propagator.transfer_matrix(return_error=True)
    true = relative_error(matrix, exact)
    assert true / 3 < error < 20 * true


def test_the_estimate_is_honest_in_free_space() -> None:
    scene = small_scene()
    propagator = make_propagator(scene, "full", 1.3e-3, tolerance=1e-3)
    matrix, error = propagator.transfer_matrix(return_error=True)
    exact = free_space_matrix(scene.control_points, scene.array, scene.wavenumber)
    assert relative_error(matrix, exact) / 3 < error < 0.02


def test_exact_fields_have_no_error_and_ignored_obstacles_an_unknown_one() -> None:
    assert FreeSpacePropagator(small_scene()).transfer_matrix(return_error=True)[1] == 0
    sphere, _ = exact_sphere()
    assert FreeSpacePropagator(small_scene((sphere,))).transfer_matrix(return_error=True)[1] == math.inf


def test_a_tolerance_chooses_a_spacing_that_meets_it() -> None:
    sphere, exact = exact_sphere()
    loose, tight = (
        make_propagator(small_scene((sphere,)), "full", None, tolerance=tolerance)
        for tolerance in (0.2, 0.06)
    )
    assert tight.spacing < loose.spacing <= coarsest_spacing(region_of(loose.scene))  # type: ignore[union-attr]
    assert relative_error(tight.transfer_matrix(), exact) < 0.06


def test_a_spacing_is_chosen_also_where_nothing_scatters() -> None:
    like_air = Sphere(CENTER, RADIUS, density=AIR.density, sound_speed=AIR.sound_speed)
    scene = small_scene((like_air,))
    propagator = make_propagator(scene, "box", None, tolerance=0.1)
    assert propagator.spacing == coarsest_spacing(region_of(scene))


@pytest.mark.filterwarnings("ignore:no steady state")
def test_without_an_estimate_no_spacing_is_chosen() -> None:
    sphere, _ = exact_sphere()
    with pytest.raises(ValueError, match=r"^max_periods: 1; "):
        make_propagator(small_scene((sphere,)), "box", None, tolerance=0.1, max_periods=1)


def test_spacings_and_errors_scale_with_the_order() -> None:
    exact, h = torch.ones(2, 3, dtype=torch.complex128), 1e-3
    fine, coarse = (exact * (1 + 1e-3 * scale ** (4 / 3)) for scale in (1, RATIO))
    assert grid_error(fine, coarse, coarser=True) == pytest.approx(1e-3, rel=2e-3)
    assert grid_error(coarse, fine, coarser=False) == pytest.approx(1e-3 * RATIO ** (4 / 3), rel=3e-3)
    assert spacing_for(1e-3, 1e-3 * 2 ** (4 / 3), 2 * h) == pytest.approx(h)
    scene = small_scene()
    assert second_spacing(region_of(scene), h) == RATIO * h
    assert second_spacing(region_of(scene), 2e-3) == 2e-3 / RATIO
