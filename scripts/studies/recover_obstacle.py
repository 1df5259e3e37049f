"""Position and density of a sphere, recovered from a few pressures.

The measurement is a simulation on a grid twice as fine, with the true surface and 1 % of noise. The model is
a density map in which the surface is smoothed over about a cell, so that position and density are tensors.
Adam follows the gradients of `differentiable_field`.

    python scripts/study.py recover_obstacle            4 minutes on 2 idle cores
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import torch

import autdtorch as at

AIR = at.Medium(density=1.2, sound_speed=343.0)
SIZE = (40e-3, 32e-3, 32e-3)
RADIUS = 4e-3
TRUE_CENTER, TRUE_DENSITY = (21.3e-3, 17.1e-3, 14.6e-3), 6.0
FIRST_CENTER, FIRST_DENSITY = (19.5e-3, 15.0e-3, 16.5e-3), 2.0
FIRST_STEP, SHORTER = 0.4, 0.93
"""Step of Adam [mm, or of the logarithm of the density], and the factor of each next step."""

SMOOTH = 0.3
"""Smoothing length of a surface [cells]; the density changes over about four times that length."""


@dataclass(frozen=True)
class Guess:
    """A sphere and its misfit to the measurement.

    Attributes:
        center: (3,) [m].
        density: [kg/m^3].
        misfit: relative to the field scattered by the true sphere.
    """

    center: torch.Tensor
    density: float
    misfit: float


def scene_of(obstacles: tuple[at.Obstacle, ...] = ()) -> at.Scene:
    """Return sixteen transducers, ten microphones around and behind the middle, and the obstacles."""
    array = at.TransducerArray.grid((4, 4), pitch=8e-3, center=(2e-3, 16e-3, 16e-3), normal=(1, 0, 0))
    ring = at.circle_points(center=(36e-3, 16e-3, 16e-3), radius=11e-3, count=6, normal=(1, 0, 0))
    beside = at.circle_points(center=(20e-3, 16e-3, 16e-3), radius=14e-3, count=4, normal=(1, 0, 0))
    return at.Scene(array, AIR, 40e3, torch.cat((ring, beside)), obstacles, domain=((0, 0, 0), SIZE))


def drives(count: int) -> torch.Tensor:
    """Return drives of random phases (count, M)."""
    generator = torch.Generator().manual_seed(0)
    return at.drive_from_phases(6.3 * torch.rand((count, 16), generator=generator, dtype=torch.float64))


def measured(drive: torch.Tensor, spacing: float, noise: float = 0.01) -> torch.Tensor:
    """Return the pressure (D, P) with the true sphere, with noise relative to its rms."""
    sphere = at.Sphere(TRUE_CENTER, RADIUS, density=TRUE_DENSITY, sound_speed=AIR.sound_speed)
    scene = scene_of((sphere,))
    field = at.make_propagator(scene, "box", spacing, cache=False).field(drive, scene.control_points)
    generator = torch.Generator().manual_seed(1)
    error = torch.randn(field.shape, generator=generator, dtype=field.dtype)
    return field + noise * field.abs().square().mean().sqrt() * error


def density_map(
    center: torch.Tensor, density: torch.Tensor, centers: torch.Tensor, spacing: float
) -> torch.Tensor:
    """Return the density (nx, ny, nz) of air with a sphere; reciprocals are mixed at the surface."""
    distance = (centers - center).norm(dim=-1) - RADIUS
    inside = torch.sigmoid(-distance / (SMOOTH * spacing))
    return 1 / ((1 - inside) / AIR.density + inside / density)


def recover(drive: torch.Tensor, observed: torch.Tensor, spacing: float, steps: int) -> Iterator[Guess]:
    """Follow the gradient from the first guess, and yield every guess."""
    scene = scene_of()
    centers = at.cell_centers(scene, spacing)
    direct = at.make_propagator(scene, "free_space").field(drive, scene.control_points)
    scattered = (observed - direct).abs().square().sum()
    # scaled so that the four parameters matter about equally
    place = (1e3 * torch.tensor(FIRST_CENTER, dtype=torch.float64)).requires_grad_()
    weight = torch.tensor(FIRST_DENSITY, dtype=torch.float64).log().requires_grad_()
    optimiser = torch.optim.Adam([place, weight], lr=FIRST_STEP, betas=(0.6, 0.9))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, SHORTER)
    for _ in range(steps):
        optimiser.zero_grad()
        center, density = 1e-3 * place, weight.exp()
        given = density_map(center, density, centers, spacing)
        field = at.differentiable_field(scene, drive, density=given, spacing=spacing)
        loss = (field - observed).abs().square().sum() / scattered
        loss.backward()
        yield Guess(center.detach(), float(density.detach()), float(loss.detach()) ** 0.5)
        optimiser.step()
        schedule.step()


OPTIONS = {
    "--steps": {"type": int, "default": 16, "help": "steps of Adam"},
    "--spacing": {"type": float, "default": 1.0, "help": "of the model [mm]"},
}


def main(given: argparse.Namespace) -> None:
    """Simulate the measurement, recover the sphere, and print each step."""
    spacing, drive = 1e-3 * given.spacing, drives(2)
    observed = measured(drive, spacing / 2)
    for step, guess in enumerate(recover(drive, observed, spacing, given.steps), 1):
        off = 1e3 * float((guess.center - torch.tensor(TRUE_CENTER)).norm())
        found = f"{off:5.2f} mm off, {guess.density:5.2f} kg/m^3"
        print(f"{step:2d}: misfit {100 * guess.misfit:5.1f} %, {found}", flush=True)
