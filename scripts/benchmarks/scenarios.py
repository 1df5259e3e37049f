"""Drives that hold wherever an obstacle is: foci in the shadow of two cubes, certified over a ball of places.

The nominal drive is the best for the cubes at their place, the robust one by `robust_drive`. Both are
certified for all shifts up to 3 and 5 mm; the robust one is read at held-out places, half of them on the edge
of the ball. Takes a minute or two on an idle core.
"""

import itertools

import torch
from shared.document import Page, percent, printed, table
from shared.scenes import autd3_array, weakest, with_array
from studies.pose_error import scene_of

import autdtorch as at

DOCUMENT = "conditions.md"
SCENE = "shadow of two_cubes"
RADII = (3e-3, 5e-3)
"""Largest shifts [m]."""

OPTIONS = {
    "--held-out": {"type": int, "default": 400, "help": "places at which drives are read"},
    "--effort": {"type": float, "default": 50.0, "help": "of the bounds of all drives"},
    "--spacing": {"type": float, "default": 1.5, "help": "of the simulation [mm]"},
}


def main(page: Page, held_out: int, effort: float, spacing: float) -> None:
    scene, generator = scene_of(SCENE), torch.Generator().manual_seed(0)
    propagators = [
        at.make_propagator(each, "tmatrix", 1e-3 * spacing, 2e-3)
        for each in (scene, with_array(scene, autd3_array()))
    ]
    balls = [at.PoseBall(each, radius) for each, radius in itertools.product(propagators, RADII)]
    head = ["transducers, ball", "nominal drive", "certified", "robust drive", "certified"]
    head += [f"least of {held_out} places", "bound of all drives"]
    page.write(table(head, printed(row(ball, in_ball(held_out, generator), effort) for ball in balls)))


def in_ball(count: int, generator: torch.Generator) -> torch.Tensor:
    """Return places (count, 3) in the unit ball, the second half on its surface."""
    places = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    reach = torch.rand(count, 1, dtype=torch.float64, generator=generator) ** (1 / 3)
    reach[count // 2 :] = 1
    return reach * places / places.norm(dim=1, keepdim=True)


def row(ball: at.PoseBall, places: torch.Tensor, effort: float) -> list[str]:
    """Return a row of the table, of places (N, 3) in the unit ball."""
    nominal = at.gradient_ascent(ball.transfer_matrix((0.0, 0.0, 0.0)))
    before, full = ball.certificate(nominal.drive[0]), float(nominal.score[0])
    robust = at.robust_drive(ball, effort=effort)
    matrices, certified = ball.transfer_matrix(ball.radius * places), robust.certificate.least
    least = float(weakest(matrices, robust.drive).min())
    return [
        f"{len(ball.propagator.scene.array)}, {1e3 * ball.radius:g} mm",
        f"{full:.4g} Pa",
        f"{before.least:.4g} Pa",
        f"{robust.nominal:.4g} Pa ({percent(robust.nominal / full - 1)})",
        f"{certified:.4g} Pa ({percent(certified / before.least - 1)})",
        f"{least:.4g} Pa",
        f"{robust.bound:.4g} Pa",
    ]
