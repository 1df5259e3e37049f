"""Find where a sphere is, and how heavy, from the pressure of a few drives at a few points.

    python scripts/recover_obstacle.py            4 minutes on 2 idle cores

What is measured is simulated on a grid twice as fine, with the sphere's true surface and 1 % of noise. The
model is a map of the density, in which the sphere's surface is smooth over about a cell: its place and its
density are then tensors like any others, and Adam follows the gradients of `differentiable_field`. Prints
the way and draws it (--picture FILE, recover_obstacle.png by default).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.patches import Circle

import autdtorch as at
from autdtorch.plot.style import TICK_SIZE, log_axes, looks_of, new_figure, styled

AIR = at.Medium(density=1.2, sound_speed=343.0)
SIZE = (40e-3, 32e-3, 32e-3)
RADIUS = 4e-3
TRUE_CENTER, TRUE_DENSITY = (21.3e-3, 17.1e-3, 14.6e-3), 6.0
FIRST_CENTER, FIRST_DENSITY = (19.5e-3, 15.0e-3, 16.5e-3), 2.0
FIRST_STEP, SHORTER = 0.4, 0.93
"""Of Adam [mm, or of the logarithm of the density], and how much shorter each next step is."""

SMOOTH = 0.3
"""Length over which a surface is smoothed [cells]; the density changes over about four times that."""


@dataclass(frozen=True)
class Guess:
    """A sphere, and how badly it explains what was measured.

    Attributes:
        center: (3,) [m].
        density: [kg/m^3].
        misfit: relative, of what the sphere changes.
    """

    center: torch.Tensor
    density: float
    misfit: float


def scene_of(obstacles: tuple[at.Obstacle, ...] = ()) -> at.Scene:
    """Sixteen transducers, ten microphones around and behind the middle, and what is between them."""
    array = at.TransducerArray.grid((4, 4), pitch=8e-3, center=(2e-3, 16e-3, 16e-3), normal=(1, 0, 0))
    ring = at.circle_points(center=(36e-3, 16e-3, 16e-3), radius=11e-3, count=6, normal=(1, 0, 0))
    beside = at.circle_points(center=(20e-3, 16e-3, 16e-3), radius=14e-3, count=4, normal=(1, 0, 0))
    return at.Scene(array, AIR, 40e3, torch.cat((ring, beside)), obstacles, domain=((0, 0, 0), SIZE))


def drives(count: int) -> torch.Tensor:
    """Random phases (count, M)."""
    generator = torch.Generator().manual_seed(0)
    return at.drive_from_phases(6.3 * torch.rand((count, 16), generator=generator, dtype=torch.float64))


def measured(drive: torch.Tensor, spacing: float, noise: float = 0.01) -> torch.Tensor:
    """Pressure (D, P) with the true sphere, and noise relative to its mean square."""
    sphere = at.Sphere(TRUE_CENTER, RADIUS, density=TRUE_DENSITY, sound_speed=AIR.sound_speed)
    scene = scene_of((sphere,))
    field = at.make_propagator(scene, "box", spacing, cache=False).field(drive, scene.control_points)
    generator = torch.Generator().manual_seed(1)
    error = torch.randn(field.shape, generator=generator, dtype=field.dtype)
    return field + noise * field.abs().square().mean().sqrt() * error


def density_map(
    center: torch.Tensor, density: torch.Tensor, centers: torch.Tensor, spacing: float
) -> torch.Tensor:
    """Density (nx, ny, nz) of air with a sphere: its reciprocal is what mixes in a cell at a surface."""
    distance = (centers - center).norm(dim=-1) - RADIUS
    inside = torch.sigmoid(-distance / (SMOOTH * spacing))
    return 1 / ((1 - inside) / AIR.density + inside / density)


def recover(drive: torch.Tensor, heard: torch.Tensor, spacing: float, steps: int) -> Iterator[Guess]:
    """Follow the gradient from the first guess; yields every guess on the way."""
    scene = scene_of()
    centers = at.cell_centers(scene, spacing)
    silent = at.make_propagator(scene, "free_space").field(drive, scene.control_points)
    scattered = (heard - silent).abs().square().sum()
    # in units in which all four numbers matter about alike
    place = (1e3 * torch.tensor(FIRST_CENTER, dtype=torch.float64)).requires_grad_()
    weight = torch.tensor(FIRST_DENSITY, dtype=torch.float64).log().requires_grad_()
    optimiser = torch.optim.Adam([place, weight], lr=FIRST_STEP, betas=(0.6, 0.9))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, SHORTER)
    for _ in range(steps):
        optimiser.zero_grad()
        center, density = 1e-3 * place, weight.exp()
        given = density_map(center, density, centers, spacing)
        field = at.differentiable_field(scene, drive, density=given, spacing=spacing)
        loss = (field - heard).abs().square().sum() / scattered
        loss.backward()
        yield Guess(center.detach(), float(density.detach()), float(loss.detach()) ** 0.5)
        optimiser.step()
        schedule.step()


@styled
def draw(way: list[Guess], picture: Path) -> None:
    """The way in two planes, and density and misfit along it."""
    figure = new_figure(10.0, 3.6)
    axes = figure.subplots(1, 3)
    found, other_look = looks_of(("found", "other")).values()
    centers = 1e3 * torch.stack([guess.center for guess in way])
    truth = 1e3 * torch.tensor(TRUE_CENTER)
    scene = scene_of()
    for axis, (other, name) in zip(axes, ((1, "y"), (2, "z")), strict=False):
        axis.add_patch(Circle((truth[0], truth[other]), 1e3 * RADIUS, color="0.85", label="sphere"))
        for points, mark, label in (
            (scene.array.positions, "s", "transducers"), (scene.control_points, "o", "microphones")
        ):  # fmt: skip
            axis.plot(1e3 * points[:, 0], 1e3 * points[:, other], mark, color="0.5", ms=4, label=label)
        axis.plot(centers[:, 0], centers[:, other], ".-", color=found.colour, label="centre found")
        axis.plot(truth[0], truth[other], "k+", ms=10, label="centre")
        axis.set(xlabel="x [mm]", ylabel=f"{name} [mm]", aspect="equal", xlim=(0, 40), ylim=(0, 32))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=5)
    misfit, density = [100 * guess.misfit for guess in way], [guess.density for guess in way]
    axes[2].plot(misfit, ".-", color=found.colour, label="misfit [%]")
    axes[2].plot(density, "s--", ms=3, color=other_look.colour, label="density [kg/m$^3$]")
    axes[2].axhline(TRUE_DENSITY, color=other_look.colour, ls=":", lw=1, label="true density")
    axes[2].set(xlabel="step", ylabel="misfit [%], density [kg/m$^3$]")
    log_axes(axes[2], "y")
    axes[2].legend()
    for axis in axes:
        axis.tick_params(labelsize=TICK_SIZE)
    figure.savefig(picture)


def main() -> None:
    """Measure, recover, print and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--picture", type=Path, default=Path("recover_obstacle.png"))
    spacing, drive = 1e-3, drives(2)
    picture = parser.parse_args().picture
    heard, way = measured(drive, spacing / 2), []
    for guess in recover(drive, heard, spacing, steps=16):
        way.append(guess)
        off = 1e3 * float((guess.center - torch.tensor(TRUE_CENTER)).norm())
        found = f"{off:5.2f} mm off, {guess.density:5.2f} kg/m^3"
        print(f"{len(way):2d}: misfit {100 * guess.misfit:5.1f} %, {found}", flush=True)
    draw(way, picture)


if __name__ == "__main__":
    main()
