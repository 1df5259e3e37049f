"""Bounds on the goals: no method may exceed them.

Half of the random scenes have an unstructured transfer matrix, the others one of transducers and control
points in air; 2 to 32 transducers, 1 to 8 foci. For contrast, 2 to 8 transducers and enough background points
that it has a bound. Exits with 1 if a score is above its bound.
"""

from collections import defaultdict

import numpy as np
import torch
from shared.scenes import paper_objectives

import autdtorch as at
from autdtorch.propagators.free_space import free_space_matrix

OPTIONS = {
    "--scenes": {"type": int, "default": 1000, "help": "number of random scenes"},
    "--seed": {"type": int, "default": 0, "help": "seed of the random scenes"},
}

FREQUENCY = 40e3
ROUNDING = 1e-12
AIR = at.Medium(density=1.2, sound_speed=340.0)


def main(scenes: int, seed: int) -> int:
    check_paper_scenes()
    return int(check_goals(scenes, seed) > 0)


def random_objective(generator: torch.Generator, background: bool = False) -> at.SimulatedObjective:
    """Return an objective of 2 to 32 transducers and 1 to 8 foci, of either kind.

    With `background`, of 2 to 8 transducers and up to 8 more control points than transducers.
    """

    def integer(low: int, high: int) -> int:
        return int(torch.randint(low, high + 1, (), generator=generator))

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, dtype=torch.float64, generator=generator)

    transducers, foci, physical = integer(2, 8 if background else 32), integer(1, 8), integer(0, 1)
    foci += transducers if background else 0
    # Transducers on a 10 mm grid of 8 x 8, foci in a cube of 100 mm that begins 40 mm in front of it.
    places = torch.randperm(64, generator=generator)[:transducers]
    positions = 10e-3 * torch.stack([torch.zeros(transducers), places // 8, places % 8], dim=1).double()
    points = 100e-3 * uniform(foci, 3) + torch.tensor([40e-3, -15e-3, -15e-3])
    array = at.TransducerArray(positions, (1.0, 0.0, 0.0))
    scene = at.Scene(array, AIR, frequency=FREQUENCY, control_points=points)
    matrix = torch.randn(foci, transducers, dtype=torch.complex128, generator=generator)
    if physical:
        matrix = free_space_matrix(points, array, scene.wavenumber)
    return at.SimulatedObjective.of_matrix(scene, matrix)


def random_goals(objective: at.SimulatedObjective, generator: torch.Generator) -> list[at.Goal]:
    """Return a goal of each kind, and quiet points for each, with random settings."""
    points = len(objective.scene.control_points)
    weights = (0.5 + torch.rand(points, dtype=torch.float64, generator=generator)).tolist()
    unit = at.focus_bound(objective.transfer_matrix) * float(torch.rand((), generator=generator))

    def loud(first: int) -> list[at.Goal]:
        targets = [at.TargetPressures([unit * weight for weight in weights[first:]])] if unit > 0 else []
        return [at.WeakestFocus(weights[first:]), at.MeanPressure(), *targets]

    if points == 1:
        return loud(0)
    ratio = float(10 ** (-2 * torch.rand((), generator=generator)))
    return loud(0) + [at.QuietPoints(goal, [0], ratio) for goal in loud(1)]


def check_goals(count: int, seed: int) -> int:
    """Print the differences from the bounds of goals in `count` random scenes; return how many are above."""
    generator, above, scores = torch.Generator().manual_seed(seed), 0, 0
    gaps = defaultdict(list)
    for _ in range(count):
        objective, wide = random_objective(generator), random_objective(generator, background=True)
        goals = [(goal, objective) for goal in random_goals(objective, generator)]
        goals.append((at.Contrast(range(len(wide.scene.array))), wide))
        for goal, objective in goals:
            bound = goal.bound(objective.transfer_matrix)
            ascent, *others = (
                solve(objective, goal=goal).score.item()
                for solve in (at.gradient_ascent, at.gabs, at.random_search)
            )
            if not max(ascent, *others) <= bound + ROUNDING * abs(bound):
                print(f"above its bound {bound}: {max(ascent, *others)}, {goal}")
                above += 1
            scores += 1
            inner = type(goal.goal).__name__ + " and quiet points" if isinstance(goal, at.QuietPoints) else ""
            gaps[inner or type(goal).__name__].append(
                (bound - ascent) / bound if goal.unit else bound - ascent
            )
    print(f"{count} random scenes, seed {seed}: {above} of {scores} best scores of goals above their bounds")
    for name, values in gaps.items():
        below = f"median {np.median(values):.2%}, most {max(values):.2%} below the bound"
        print(f"  {name}, gradient ascent: {below}")
    return above


def check_paper_scenes() -> None:
    """Print the gaps of gradient ascent in the paper's scenes, without weights and with 20 random sets."""
    generator = torch.Generator().manual_seed(0)
    weights = (1 + 2 * torch.rand(20, 4, dtype=torch.float64, generator=generator)).tolist()
    for name, objective in paper_objectives().items():
        plain, *weighted = (
            1 - at.gradient_ascent(objective, goal=goal).score.item() / goal.bound(objective.transfer_matrix)
            for goal in (at.WeakestFocus(), *map(at.WeakestFocus, weights))
        )
        gaps = f"median {np.median(weighted):.3%}, most {max(weighted):.3%} with weights from 1 to 3"
        print(f"{name}: gradient ascent is {plain:.3%} below the bound; {gaps}")
