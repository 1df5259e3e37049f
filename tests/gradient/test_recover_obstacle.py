"""The pose of a body from magnitudes: simulated in cells finer than those of the operator that is fitted."""

import math

import pytest
import torch
from studies.recover_obstacle import fits, measured, pose_errors, pose_of

import autdtorch as at

AIR = at.Medium(density=1.2, sound_speed=340.0)
ARRAY = at.TransducerArray.grid((3, 3), 10e-3, (0, 0, 0), (1, 0, 0), radius=0)
RINGS = [at.circle_points((x, 0, 0), radius, 8, (1, 0, 0)) for x, radius in ((30e-3, 14e-3), (45e-3, 8e-3))]
BLOCK = at.Box(center=(30e-3, 0, 0), size=(12e-3, 8e-3, 6e-3), rigid=True)
SCENE = at.Scene(ARRAY, AIR, 40e3, torch.cat(RINGS), [BLOCK])
TRUE = pose_of((0.6e-3, -0.6e-3, 0.5e-3), (3.5, -2.5, 2.5))  # 1 mm and 5 degrees


@pytest.fixture(scope="module")
def body() -> at.TMatrix:
    return at.TMatrix.of(BLOCK, AIR, 40e3, spacing=1.5e-3, error=1e-2)


def test_operator_and_scene_agree_in_a_pose(body):
    moved = body.moved(TRUE[:3], TRUE[3:]).transfer_matrix(ARRAY, SCENE.control_points).abs()
    exact = measured(SCENE, TRUE, 1e-3, seed=0, noise=0.0)
    # cells of 1.5 and 1 mm differ by 0.15 %, the block at rest by 6 %
    assert float((moved - exact).norm() / exact.norm()) < 0.01


def test_a_pose_is_fitted_to_noisy_magnitudes(body):
    (fit,) = fits(body, SCENE, measured(SCENE, TRUE, 1e-3, seed=0), [pose_of(0.0, 0.0)])
    place, turn = pose_errors(fit.pose, TRUE)
    # three to seven standard errors, 0.03 mm and 0.6 degrees, that 1 % of noise gives to these 144 magnitudes
    assert place < 0.2
    assert turn < 2.0
    assert fit.misfit == pytest.approx(0.01, rel=0.2)  # the noise; the model errs by a sixth of it
    assert 1e3 * float(fit.error[:3].norm()) < 0.05
    assert math.degrees(float(fit.error[3:].norm())) < 1.0


def test_images_of_the_two_cubes_are_one_pose():
    for turns in range(4):
        assert pose_errors(pose_of(1e-3, (90.0 * turns, 0, 0)), pose_of(1e-3, 0.0))[1] < 1e-3
    place, turn = pose_errors(pose_of((3e-3, 0, 4e-3), (80.0, 0, 0)), pose_of(0.0, 0.0))
    assert (place, turn) == pytest.approx((5.0, 10.0), rel=1e-5)
