"""Error of a tilted cube, on a grid that turns with it and on one that does not.

Fills in a block of the documentation. A cube of 15 mm stands between 16 transducers and four points. All turn
together, so that the exact field stays the same. The reference is the aligned cube on a grid of 0.25 mm.

    python scripts/benchmark.py tilted              about 5 minutes on 2 idle cores
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np
import torch
from shared.document import Page, percent, printed, table
from shared.scenes import relative_error
from shared.timing import timed

import autdtorch as at
from autdtorch.propagators.plan import plan
from autdtorch.propagators.simulated import SimulatedPropagator
from autdtorch.scene.geometry import rotation_matrix

DOCUMENT = "benchmarks.md"

AIR = at.Medium(1.2, 343.0)
ALIGNED = (0.0, 0.0, 0.0)
TILTS = (
    *((angle, 0.0, 0.0) for angle in np.linspace(0.08, math.pi / 4, 10)),
    (0.3, 0.0, 0.0),
    (0.5, 0.4, 0.3),
    (math.pi / 4, 0.615, 0.0),
    *((angle, 0.7 * angle, 0.3) for angle in np.linspace(0.1, 0.7, 7)),
)
"""Rotations [rad]: 20 tilts, about one axis and about three."""

MATERIALS: Mapping[str, Mapping[str, object]] = {
    "rigid": {"rigid": True},
    "density ratio 77": {"density": 77 * AIR.density, "sound_speed": 900.0},
}
SPACINGS = (1.0, 0.5)  # [mm]
REFERENCE = 0.25  # [mm]


def cube_scene(rotation: tuple[float, float, float], material: Mapping[str, object]) -> at.Scene:
    """Return the cube with its array and points, all turned about the cube's centre."""
    turn = rotation_matrix(rotation).numpy()
    array = at.TransducerArray.grid((4, 4), 10.5e-3, (0, 0, -40e-3), (0, 0, 1))
    points = np.array([[0, 0, 30], [12, 0, 30], [-10, 8, 25], [4, -14, 35]]) * 1e-3
    turned = at.TransducerArray(
        array.positions.numpy() @ turn.T, turn[:, 2], array.source_strength, array.radius
    )
    cube = at.Box((0, 0, 0), (15e-3,) * 3, rotation, **material)
    return at.Scene(turned, AIR, 40e3, points @ turn.T, [cube], domain=((-0.1,) * 3, (0.1,) * 3))


def matrix(scene: at.Scene, spacing: float, aligned: bool) -> torch.Tensor:
    """Return the matrix at a spacing [mm]; `aligned` keeps the grid from turning."""
    planned = plan(scene, "box", spacing * 1e-3, 1e-3)
    if aligned:
        axes = tuple(np.eye(3) for _ in planned.grouping.axes)
        planned = dataclasses.replace(planned, grouping=dataclasses.replace(planned.grouping, axes=axes))
    return SimulatedPropagator(planned).transfer_matrix()


def rows() -> Iterator[list[str]]:
    """Yield rows for each kind of grid, with errors and the time of a matrix."""
    for name, material in MATERIALS.items():
        reference = matrix(cube_scene(ALIGNED, material), REFERENCE, aligned=True)
        for grid in ("turned", "held"):
            cells, seconds = [], []
            for spacing in SPACINGS:
                scenes = [cube_scene(tilt, material) for tilt in TILTS]
                runs = [timed(partial(matrix, scene, spacing, grid != "turned")) for scene in scenes]
                errors = [relative_error(made, reference) for made, _ in runs]
                cells.append(f"{percent(float(np.median(errors)))} ({percent(max(errors))})")
                seconds.append(sum(spent for _, spent in runs) / len(runs))
            yield [name, grid, *cells, f"{seconds[0]:.2g} s", f"{seconds[-1]:.2g} s"]


def main(page: Page) -> None:
    """Measure both cubes and write their table."""
    spacings = [f"{spacing:g} mm" for spacing in SPACINGS]
    header = ["cube", "grid", *spacings, f"time, {spacings[0]}", f"time, {spacings[-1]}"]
    page.write(f"Median error (and the largest) over {len(TILTS)} tilts.", table(header, printed(rows())))
