"""Loss of the foci if obstacles are not in their assumed pose.

Writes pose_errors.png and a block of the documentation. Drives are the best for the paper's cubes at their
place. Then all cubes of a scene are shifted in random directions, or turned about random axes, as one body.
T-matrices give the transfer matrix of each pose. Takes about two minutes on 2 idle cores.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from shared.document import Page, percent, table
from shared.scenes import PAPER, paper_scene, weakest

import autdtorch as at
from autdtorch.plot.style import TICK_SIZE, add_legend, looks_of, new_figure, readable, styled

DOCUMENT = "conditions.md"
SCENES = ("two_cubes", "three_cubes", "shadow of two_cubes")
SHADOW = 10e-3
"""Radius of the circle of the foci that are in the shadow of the larger cube [m]; the paper's is 30 mm."""

SHIFTS = (0.2, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
"""Distances [mm]."""
TURNS = (1.0, 2.0, 5.0, 7.0, 10.0, 15.0, 20.0)
"""Angles [degrees]."""
SHOWN = {"mm": (1.0, 5.0), "degrees": (5.0, 20.0)}
"""Pose errors in the table."""
STARTS = 8
"""First guesses of the drives that follow the pose."""

OPTIONS = {
    "--poses": {"type": int, "default": 200, "help": "random directions of each pose error"},
    "--spacing": {"type": float, "default": 1.0, "help": "of the simulations [mm]"},
}


def main(page: Page, poses: int, spacing: float) -> None:
    rows = []
    for name in SCENES:
        for loss in losses(name, poses, 1e-3 * spacing):
            rows.append(loss)
            print(f"{name}, {loss.error:g} {loss.unit}: {percent(float(loss.same.median()))}", flush=True)
    page.write(
        "![Share of the weakest focus that is left, over shifts and turns of the obstacles](pose_errors.png)",
        f"Share of the weakest focus that is left [%]: median of {poses} directions (least of 95 %)",
        shares(rows),
    )
    page.save("pose_errors.png", plot_losses(rows))


class Losses(NamedTuple):
    """Shares of the weakest focus under a pose error [`unit`], for each direction (N,)."""

    scene: str
    unit: str
    error: float
    same: torch.Tensor  # with the drive of the assumed pose
    new: torch.Tensor  # with a drive that was computed for the pose


def scene_of(name: str) -> at.Scene:
    """Return one of the paper's scenes, or the two cubes with foci in their shadow."""
    scene = paper_scene(name.removeprefix("shadow of "))
    if name in PAPER:
        return scene
    foci = at.circle_points(center=(80e-3, 50e-3, 50e-3), radius=SHADOW, count=4, normal=(1, 0, 0))
    return replace(scene, control_points=foci)


def losses(name: str, count: int, spacing: float) -> Iterator[Losses]:
    """Yield the losses of one of the scenes, for `count` directions, on cells of `spacing` [m]."""
    scene = scene_of(name)
    body = at.TMatrix.of(scene.obstacles, scene.medium, scene.frequency, spacing)
    objective = at.SimulatedObjective(scene, at.make_propagator(scene, "tmatrix", spacing, 1e-3))
    best = at.gradient_ascent(objective)
    drive, full = best.drive[0], float(best.score[0])
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    directions = directions / directions.norm(dim=1, keepdim=True)
    for unit, errors in (("mm", SHIFTS), ("degrees", TURNS)):
        for error in errors:
            if unit == "mm":
                poses = [body.moved(1e-3 * error * direction) for direction in directions]
            else:
                turns = Rotation.from_rotvec(math.radians(error) * directions.numpy()).as_euler("xyz")
                poses = [body.moved(rotation=turn) for turn in turns]
            matrix = torch.stack([pose.transfer_matrix(scene.array, scene.control_points) for pose in poses])
            new = at.holography(matrix, starts=STARTS)
            yield Losses(name, unit, error, weakest(matrix, drive) / full, weakest(matrix, new) / full)


@styled
def plot_losses(losses: Sequence[Losses]) -> Figure:
    """Plot the share that is left over the pose error: the median, and nine of ten directions."""
    figure, looks = new_figure(6.6, 3.0), looks_of(SCENES)
    panels = figure.subplots(1, 2, sharey=True)
    for ax, unit, label in zip(panels, SHOWN, ("shift [mm]", "turn [degrees]"), strict=True):
        for name in SCENES:
            rows = [loss for loss in losses if (loss.scene, loss.unit) == (name, unit)]
            errors = [0.0, *(loss.error for loss in rows)]
            shares = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
            low, middle, high = torch.stack([torch.ones(3), *(loss.same.quantile(shares) for loss in rows)]).T
            new = [1.0, *(float(loss.new.median()) for loss in rows)]
            colour = looks[name].colour
            ax.plot(errors, middle, color=colour, label=readable(name))
            ax.fill_between(errors, low, high, color=colour, alpha=0.2, linewidth=0)
            ax.plot(errors, new, color=colour, linestyle=":", label=f"{readable(name)}, new drive")
        ax.set_xlabel(label)
        ax.set_xlim(left=0)
        ax.set_ylim(0.4, 1.1)
        ax.tick_params(labelsize=TICK_SIZE)
    panels[0].set_ylabel("share of the weakest focus")
    add_legend(figure, panels[0].get_legend_handles_labels()[0])
    return figure


def shares(losses: Sequence[Losses]) -> str:
    """Return the table of the pose errors shown, a column for each scene."""
    lines: dict[str, list[str]] = {}
    for loss in losses:
        if loss.error in SHOWN[loss.unit]:
            median, least = (100 * float(loss.same.quantile(share)) for share in (0.5, 0.05))
            lines.setdefault(f"{loss.error:g} {loss.unit}", []).append(f"{median:.3g} ({least:.3g})")
    return table(["pose error", *map(readable, SCENES)], [[error, *cells] for error, cells in lines.items()])
