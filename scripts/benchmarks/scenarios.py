"""Drives that hold wherever an obstacle is: foci in the shadow of two cubes, certified over a ball of places.

The nominal drive is the best for the cubes at their place, the robust one by `robust_drive`. Both are
certified for all shifts up to 3 and 5 mm; the robust one is read at held-out places, half of them on the edge
of the ball. Then random cases: no score of scenarios is above its bound, and no held-out place below its
certificate. Exits with 1 if one is. Takes about six minutes on an idle core.
"""

import itertools

import torch
from shared.document import Page, percent, printed, table
from shared.scenes import autd3_array, with_array
from studies.pose_error import scene_of

import autdtorch as at
from autdtorch.methods.gradient import climb, random_drives

DOCUMENT = "conditions.md"
SCENE = "shadow of two_cubes"
RADII = (3e-3, 5e-3)
"""Largest shifts [m]."""
BY = ("worst", "mean", 0.25)

OPTIONS = {
    "--held-out": {"type": int, "default": 400, "help": "places at which drives are read"},
    "--cases": {"type": int, "default": 1000, "help": "random scenarios; a tenth as many drives in balls"},
    "--effort": {"type": float, "default": 50.0, "help": "of the bounds of all drives"},
    "--spacing": {"type": float, "default": 1.5, "help": "of the simulation [mm]"},
}


def main(page: Page, held_out: int, cases: int, effort: float, spacing: float) -> int:
    """Write the table, and count the random cases that contradict a proof."""
    scene, generator = scene_of(SCENE), torch.Generator().manual_seed(0)
    propagators = [
        at.make_propagator(each, "tmatrix", 1e-3 * spacing, 2e-3)
        for each in (scene, with_array(scene, autd3_array()))
    ]
    balls = [at.PoseBall(each, radius) for each, radius in itertools.product(propagators, RADII)]
    head = ["transducers, ball", "nominal drive", "certified", "robust drive", "certified"]
    head += [f"least of {held_out} places", "bound of all drives"]
    lines = printed(row(ball, in_ball(held_out, generator), effort) for ball in balls)
    above = scores_above(cases, generator)
    below = sum(places_below(ball, cases // 20, generator) for ball in balls[:2])
    counts = (
        f"{above} of {cases} random scenarios score above their bound. Of {2 * (cases // 20)} drives, {below}"
    )
    counts += f" are below their certificate at one of {held_out} places."
    print(counts)
    page.write(table(head, lines), counts)
    return int(above + below > 0)


def in_ball(count: int, generator: torch.Generator) -> torch.Tensor:
    """Return places (count, 3) in the unit ball, the second half on its surface."""
    places = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    reach = torch.rand(count, 1, dtype=torch.float64, generator=generator) ** (1 / 3)
    reach[count // 2 :] = 1
    return reach * places / places.norm(dim=1, keepdim=True)


def least_at(ball: at.PoseBall, drive: torch.Tensor, places: torch.Tensor) -> float:
    """Return the weakest focus [Pa] of a drive at the worst of some places (N, 3) in the unit ball."""
    return float((ball.transfer_matrix(ball.radius * places) @ drive).abs().amin())


def row(ball: at.PoseBall, places: torch.Tensor, effort: float) -> list[str]:
    """Return a row of the table, of places (N, 3) in the unit ball."""
    nominal = at.gradient_ascent(ball.transfer_matrix((0.0, 0.0, 0.0)))
    before, full = ball.certificate(nominal.drive[0]), float(nominal.score[0])
    robust = at.robust_drive(ball, effort=effort)
    least, certified = least_at(ball, robust.drive, places), robust.certificate.least
    return [
        f"{len(ball.propagator.scene.array)}, {1e3 * ball.radius:g} mm",
        f"{full:.4g} Pa",
        f"{before.least:.4g} Pa",
        f"{robust.nominal:.4g} Pa ({percent(robust.nominal / full - 1)})",
        f"{certified:.4g} Pa ({percent(certified / before.least - 1)})",
        f"{least:.4g} Pa",
        f"{robust.bound:.4g} Pa",
    ]


def scores_above(cases: int, generator: torch.Generator) -> int:
    """Return in how many random scenarios a drive scores above the bound."""

    def integer(low: int, high: int) -> int:
        return int(torch.randint(low, high + 1, (), generator=generator))

    above = 0
    for _ in range(cases):
        scenes, points, transducers = integer(1, 5), integer(2, 4), integer(2, 12)
        matrix = torch.randn(scenes * points, transducers, dtype=torch.complex128, generator=generator)
        inner = random_goals(points, float(matrix.abs().sum(dim=1).mean()))[integer(0, 4)]
        goal = at.OverScenes(inner, scenes, BY[integer(0, 2)])
        drives = random_drives(8, transducers, generator)
        best = float(goal((matrix @ climb(goal, matrix, drives, 200)).abs()))
        bound = goal.bound(matrix)
        above += not best <= bound + 1e-12 * abs(bound)
    return above


def random_goals(points: int, unit: float) -> list[at.Goal]:
    """Return goals for control points that reach about `unit` [Pa]."""
    weights = [1.0 + point for point in range(points)]
    return [
        at.WeakestFocus(),
        at.WeakestFocus(weights),
        at.MeanPressure(),
        at.TargetPressures([unit * weight / points for weight in weights]),
        at.QuietPoints(at.WeakestFocus(), [0], 0.3),
    ]


def places_below(ball: at.PoseBall, drives: int, generator: torch.Generator) -> int:
    """Return how many drives, each climbed for a random place, are below their certificates somewhere."""
    below, transducers = 0, len(ball.propagator.scene.array)
    for place in in_ball(drives, generator):
        matrix = ball.transfer_matrix(ball.radius * place)
        drive = climb(at.WeakestFocus(), matrix, random_drives(2, transducers, generator), 100)
        below += least_at(ball, drive, in_ball(400, generator)) < ball.certificate(drive).least
    return below
