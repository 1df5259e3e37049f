"""Random rooms: grids and T-matrices agree within their claims, and reciprocity holds.

Each scene has one to three bodies, rigid, of a fluid, absorbing or with an impedance, three monopoles and
three control points; most have one or two reflectors. Its transfer matrix is computed in boxes, on the whole
domain where that has the reflectors, and by T-matrices where these have a closed form or few waves. The
difference of two methods is compared with the sum of their claims. Reciprocity compares runs that begin at
the transducers with runs that begin at the points. Scenes that take too many
steps or ring too long are named and counted, and not compared. Prints each scene beyond the limits, then a
table. Exits with 1 if reciprocity fails, or if more than a twentieth of the differences are beyond three
times the claims.

    python scripts/check.py rooms                      100 scenes, about 20 minutes on 2 idle cores
    python scripts/check.py rooms --seed 3 --only 17   one of them
"""

import logging
import math
import multiprocessing
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from shared.document import table
from shared.random_scenes import AIR, FREQUENCY, draw_material, log_uniform, make_obstacle
from tqdm import tqdm

import autdtorch as at
from autdtorch.fdtd.symmetry import orbits_of_points, orbits_of_transducers
from autdtorch.propagators.propagator import Propagator
from autdtorch.propagators.simulated import SimulatedPropagator

SIZE = 30e-3
"""Edge of the domain [m]."""
RECIPROCITY = 1e-3
"""Largest difference of the two ways, relative to the field."""
BEYOND, MOST_BEYOND = 3.0, 0.05
"""Difference over claims that is too large, and the largest share of such differences."""
CLEARANCE = 3e-3
"""Distance [m] of points and transducers from surfaces: three cells, with which either way is accurate."""
KINDS = ("sphere", "box", "rotated box", "cylinder", "plate", "voxels", "mesh")
MOST_WAVES = 12
"""Most simulations of T-matrices."""
TOLERANCE = 2e-4
"""Distance to the steady state at which runs end: a fifth of what reciprocity may be off."""

MOST_PERIODS = 300
"""Periods after which runs end; a usual run takes 15 to 60."""
MOST_UPDATES = 3e8
"""Most cells times steps in a period: a scene takes 2 minutes of a core at 1.3e8, and most have 1e7."""

OPTIONS = {
    "--scenes": {"type": int, "default": 100, "help": "number of scenes"},
    "--seed": {"type": int, "default": 0, "help": "seed of the scenes"},
    "--only": {"type": int, "help": "number of the one scene to run"},
    "--spacing": {"type": float, "default": 1e-3, "help": "edge of a cell in m"},
    "--processes": {"type": int, "default": 2, "help": "scenes at once"},
}


@dataclass(frozen=True)
class Outcome:
    """The comparisons of a scene: differences over claims, by pair of methods."""

    number: int
    labels: tuple[str, ...]
    reciprocity: float  # relative difference of the two ways; the larger of those of box and full
    claims: dict[str, float]  # estimated errors by method
    ratios: dict[str, float]  # difference over the sum of both claims, by pair of methods
    failure: str = ""  # the error that ended it
    too_long: str = ""  # the method whose runs would take too long; then nothing is compared

    @property
    def failed(self) -> bool:
        """Return whether it is to be shown."""
        beyond = any(not ratio <= BEYOND for ratio in self.ratios.values())
        return bool(self.failure) or not self.reciprocity <= RECIPROCITY or beyond

    def __str__(self) -> str:
        """Return a line."""
        if self.too_long:
            return f"room {self.number} ({', '.join(self.labels)}): too long, not compared: {self.too_long}"
        claims = ", ".join(f"{method} {claim:.1e}" for method, claim in self.claims.items())
        ratios = ", ".join(f"{pair} {ratio:.2g}" for pair, ratio in self.ratios.items())
        figures = f"reciprocity {self.reciprocity:.1e}; claims {claims}; differences over claims {ratios}"
        return f"room {self.number} ({', '.join(self.labels)}): {self.failure or figures}"


def main(scenes: int, seed: int, only: int | None, spacing: float, processes: int) -> int:
    """Run the scenes; print each failure when it occurs, then the table."""
    if only is not None:
        outcome = _numbered((seed, only, spacing))
        print(draw_room(seed, only)[0].obstacles, outcome, sep="\n")
        return int(outcome.failed)
    outcomes = []
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        tasks = [(seed, number, spacing) for number in range(scenes)]
        for outcome in tqdm(pool.imap_unordered(_numbered, tasks), total=len(tasks)):
            outcomes.append(outcome)
            if outcome.failed or outcome.too_long:
                tqdm.write(str(outcome))
    print(summary(outcomes))
    ratios = [ratio for outcome in outcomes for ratio in outcome.ratios.values()]
    beyond = sum(not ratio <= BEYOND for ratio in ratios)
    wrong = any(outcome.failure or not outcome.reciprocity <= RECIPROCITY for outcome in outcomes)
    return int(wrong or beyond > MOST_BEYOND * len(ratios))


def draw_room(seed: int, number: int) -> tuple[at.Scene, tuple[str, ...]]:
    """Draw scene `number` of a seed, and its labels."""
    rng = np.random.default_rng((seed, number))
    while True:
        bodies, labels = [], set()
        for _ in range(rng.integers(1, 4)):
            kind = str(rng.choice(KINDS))
            size = 1e-3 * np.exp(rng.uniform(math.log(3.0), math.log(9.0), 3))
            if kind == "plate":
                size[rng.integers(3)] = log_uniform(rng, 0.2e-3, 2e-3)
            material, names = draw_material(rng, slowest=0.6, most_dense=300.0)
            place = SIZE * rng.uniform(0.2, 0.8, 3)
            axis, turn = rng.normal(size=3), rng.uniform(-math.pi, math.pi, 3)
            bodies.append(make_obstacle(kind, place, size, axis, turn, rng, material))
            labels |= {kind} | (names & {"rigid", "absorbing", "impedance"})
        reflectors = []
        for axis in rng.permutation(3)[: rng.integers(0, 3)]:
            normal = np.eye(3)[axis] * rng.choice((-1.0, 1.0))
            point = np.where(normal > 0, 0.0, SIZE) + rng.uniform(0, 4e-3) * normal
            reflectors.append(at.Reflector(point, normal, rng.choice((1.0, 1.0, -1.0))))
        labels |= {f"{len(reflectors)} reflectors"}
        scene = _scene(rng, bodies, reflectors)
        if scene is not None:
            return scene, tuple(sorted(labels))


def _scene(rng: np.random.Generator, bodies: list, reflectors: list) -> at.Scene | None:
    """Return a scene with transducers and points in its air; None for too little of it, or bodies behind."""
    places = torch.from_numpy(SIZE * rng.uniform(0.07, 0.93, (400, 3)))
    gaps = [body.signed_distance(places) for body in bodies] + [
        reflector.mirror.height(places) for reflector in reflectors
    ]
    free = places[torch.stack(gaps).amin(dim=0) > CLEARANCE]
    hidden = any(
        reflector.mirror.height(body.surface()[0]).max() < 1e-4 for reflector in reflectors for body in bodies
    )
    chosen: list[torch.Tensor] = []
    for place in free:  # no source next to a point
        if all((place - other).norm() > CLEARANCE for other in chosen):
            chosen.append(place)
    if hidden or len(chosen) < 6:
        return None
    array = at.TransducerArray(torch.stack(chosen[:3]), (1.0, 0.0, 0.0), radius=0.0)
    return at.Scene(
        array, AIR, FREQUENCY, torch.stack(chosen[3:6]), bodies, domain=((0,) * 3, (SIZE,) * 3),
        reflectors=reflectors,
    )  # fmt: skip


class TooLong(Exception):
    """Runs of a method that would take `MOST_UPDATES`, or that did not converge in `MOST_PERIODS`."""


def compare(scene: at.Scene, spacing: float) -> tuple[float, dict[str, float], dict[str, float]]:
    """Return reciprocity, claims by method and differences over claims by pair of methods.

    Raises:
        TooLong: a method's runs do not end.
    """
    matrices, claims, reciprocity = {}, {}, 0.0
    for method, propagator in _propagators(scene, spacing).items():
        if method == "tmatrix" and propagator.planned_runs > MOST_WAVES:
            continue
        if isinstance(propagator, SimulatedPropagator):
            propagator.transfer_matrix()
            if not all(run.reached for run in propagator.runs):
                raise TooLong(f"{method}, {MOST_PERIODS} periods")
        matrices[method], claims[method] = propagator.transfer_matrix(return_error=True)
        if isinstance(propagator, SimulatedPropagator):
            reciprocity = max(reciprocity, _reciprocity(propagator))
    ratios = {}
    for one, other in (("box", "full"), ("box", "tmatrix")):
        if other in matrices:
            difference = (matrices[one] - matrices[other]).norm() / matrices[other].norm()
            ratios[f"{one} - {other}"] = float(difference) / (claims[one] + claims[other])
    return reciprocity, claims, ratios


def _propagators(scene: at.Scene, spacing: float) -> dict[str, Propagator]:
    """Return the propagators by method; raise `TooLong` if one would take too many steps."""
    propagators = {}
    for method in ("box", "full", "tmatrix"):
        try:
            propagator = at.make_propagator(
                scene, method, spacing, TOLERANCE, max_periods=MOST_PERIODS, cache=False
            )
        except ValueError as error:
            if method != "tmatrix" or "spheres around obstacles" not in str(error):
                raise
            continue
        propagators[method] = propagator
        if isinstance(propagator, SimulatedPropagator):
            assemblies = propagator.simulation.assemblies
            updates = sum(math.prod(each.grid.shape) * float(each.steps_per_period) for each in assemblies)
            if updates > MOST_UPDATES:
                raise TooLong(f"{method}, {updates:.1e} updates of cells in a period")
    return propagators


def _reciprocity(propagator: SimulatedPropagator) -> float:
    """Return the relative difference of runs from the transducers and from the control points."""
    simulation, points = propagator.simulation, propagator.scene.control_points
    audible = points[~simulation.silent(points[:, None])]
    if not len(audible):
        return 0.0
    alone = simulation.symmetries[:1]  # the identity
    orbits = orbits_of_transducers(audible, alone), orbits_of_points(audible, alone)
    forward, backward = (simulation._matrix_of_orbits(audible, each).matrix for each in orbits)
    return float((forward - backward).norm() / forward.norm())


def summary(outcomes: list[Outcome]) -> str:
    """Return a table of outcomes by label; a scene counts under each of its labels."""
    rows = []
    for label in ("any", *sorted({label for outcome in outcomes for label in outcome.labels})):
        chosen = [outcome for outcome in outcomes if label == "any" or label in outcome.labels]
        row = [label, str(len(chosen)), str(sum(bool(outcome.too_long) for outcome in chosen))]
        row.append(str(sum(bool(outcome.failure) for outcome in chosen)))
        compared = [outcome.reciprocity for outcome in chosen if not outcome.too_long]
        row.append(f"{max(compared):.1e}" if compared else "none")
        for pair in ("box - full", "box - tmatrix"):
            ratios = np.array([outcome.ratios[pair] for outcome in chosen if pair in outcome.ratios])
            figures = "none"
            if len(ratios):
                within = f"{100 * (ratios <= 1).mean():.0f}, {100 * (ratios <= BEYOND).mean():.0f} %"
                figures = f"{np.median(ratios):.2f}, {ratios.max():.2f}; {within} of {len(ratios)}"
            row.append(figures)
        rows.append(row)
    pairs = [
        f"{pair} over claims: median, largest; within 1, {BEYOND:g}"
        for pair in ("box - full", "box - tmatrix")
    ]
    return table(["scenes with", "count", "too long", "errors", "reciprocity", *pairs], rows)


def _numbered(task: tuple[int, int, float]) -> Outcome:
    torch.set_num_threads(1)
    logging.getLogger("autdtorch").setLevel(logging.ERROR)
    seed, number, spacing = task
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene, labels = draw_room(seed, number)
        try:
            return Outcome(number, labels, *compare(scene, spacing))
        except TooLong as error:
            return Outcome(number, labels, 0.0, {}, {}, too_long=str(error))
        except Exception as error:  # counts as a failure: all scenes are valid
            return Outcome(number, labels, math.inf, {}, {}, repr(error))
