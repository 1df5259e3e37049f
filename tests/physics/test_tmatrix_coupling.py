"""Waves between bodies by steps and by a matrix, and their derivatives."""

import logging
import math

import pytest
import torch
from small_scenes import assert_slopes, relative_error

import autdtorch as at
from autdtorch.propagators.tmatrix import coupling

AIR = at.Medium(density=1.2, sound_speed=340.0)
FREQUENCY = 40e3
ARRAY = at.TransducerArray.grid((2, 3), 10e-3, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0)
DRIVE = torch.polar(torch.linspace(0.4, 1, 6).double(), 1.3 * torch.arange(6).double() ** 2)
WALL = at.Reflector((55e-3, 0.0, 0.0), (-1.0, 0.0, 0.0))
SETTING = {"array": ARRAY, "medium": AIR}


def spheres(gap: float, error: float = 1e-6, radius: float = 4e-3) -> list[at.TMatrix]:
    """Two spheres, the second of EPS, with a gap between them [m]."""
    second = (30e-3, 2e-3 + 2 * radius + gap, 1e-3)
    made = [
        at.Sphere((30e-3, 2e-3, 1e-3), radius, rigid=True),
        at.Sphere(second, radius, density=29.0, sound_speed=900.0),
    ]
    return [at.TMatrix.of(sphere, AIR, FREQUENCY, error=error) for sphere in made]


@pytest.mark.parametrize(("gap", "reflectors"), [(5e-3, ()), (1e-5, (WALL,))])
def test_steps_and_a_matrix_have_one_solution(monkeypatch, caplog, gap, reflectors):
    bodies = spheres(gap)
    bodies.append(bodies[0].moved((9e-3, -9e-3, 0), (0.3, -0.2, 0.1)))
    cluster = at.TMatrixCluster([bodies[0].moved(torch.zeros(2, 3)), *bodies[1:]], reflectors)
    with caplog.at_level(logging.DEBUG, logger="autdtorch"):
        by_steps = [at.radiation_force(cluster, DRIVE, body, **SETTING) for body in range(3)]
        assert "by a matrix" not in caplog.text
        monkeypatch.setattr(coupling, "_MOST_STEPS", 1)
        by_matrix = [at.radiation_force(cluster, DRIVE, body, **SETTING) for body in range(3)]
        assert "by a matrix" in caplog.text
    for force, expected in zip(by_steps, by_matrix, strict=True):
        assert relative_error(force, expected) < 1e-9  # steps leave 1e-11


def test_second_derivatives_beside_another_body_are_differences_of_first_ones():
    first, second = spheres(3e-3, error=1e-3, radius=3e-3)

    def slope(pose: torch.Tensor, drive: torch.Tensor) -> tuple[torch.Tensor, ...]:
        cluster = at.TMatrixCluster([first.moved(pose[:3], pose[3:]), second], [WALL])
        force = at.radiation_force(cluster, drive, **SETTING) @ torch.tensor([1.0, 2.0, -1.0]).double()
        return torch.autograd.grad(1e9 * force, (pose, drive), create_graph=True)

    pose = torch.linspace(-1e-3, 1e-3, 6).double().requires_grad_(True)
    drive, change = DRIVE.clone().requires_grad_(True), torch.linspace(-1e-6, 1e-6, 6).double()
    by_pose, _ = slope(pose, drive)
    seconds = torch.autograd.grad(by_pose @ change, (pose, drive))
    ends = [slope(pose + sign * change, drive) for sign in (0.5, -0.5)]
    for second_slope, *parts in zip(seconds, *ends, strict=True):
        # rounding of the difference
        assert relative_error(second_slope, (parts[0] - parts[1]).detach()) < 1e-5


@pytest.mark.parametrize(("count", "reflectors"), [(1, (WALL,)), (12, ())])  # by steps, and by a matrix
def test_gradients_by_poses_of_all_bodies_are_those_of_finite_differences(count, reflectors):
    first, second = spheres(3e-3, error=1e-2)
    shifts = 1e-3 * torch.arange(count, dtype=torch.float64)[:, None]
    points = torch.tensor([[50e-3, 10e-3, -5e-3]]).double() + shifts
    array = at.TransducerArray.grid((4, 4), 10e-3, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0)

    def loudness(pose: torch.Tensor) -> torch.Tensor:
        bodies = [first.moved(pose[:3], pose[3:6]), second.moved(pose[6:9], pose[9:])]
        return at.TMatrixCluster(bodies, reflectors).transfer_matrix(array, points).abs().sum()

    pose = torch.linspace(-1e-3, 1e-3, 12).double()
    assert_slopes(loudness, pose, steps=[1e-6] * 12)


def test_a_drive_of_zeros_exerts_no_force_beside_another_body():
    assert not at.radiation_force(at.TMatrixCluster(spheres(1e-3)), 0 * DRIVE, **SETTING).any()
    assert math.isfinite(at.radiation_force(at.TMatrixCluster(spheres(1e-3)), DRIVE, **SETTING).norm())


@pytest.mark.parametrize("shape", [(0, 6), (2, 0, 6)])
@pytest.mark.parametrize("is_one", [False, True])
def test_no_drives_exert_no_forces(shape, is_one):
    first, second = spheres(1e-3, error=1e-2)
    poses = torch.zeros(2, 1, 3)
    if is_one:
        cluster = at.TMatrixCluster([first, second]).moved(poses)
    else:
        cluster = at.TMatrixCluster([first.moved(poses), second])
    drives = torch.zeros(shape, dtype=torch.complex128)
    assert at.radiation_force(cluster, drives, **SETTING).shape == (2, 0, 3)
