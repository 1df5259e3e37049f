"""A simulation that is wrong as the prior of a measurement, behind the two cubes with an AUTD3.

The array that is measured has gains and phases of its own, and the obstacle stands elsewhere. Prints the
weakest focus as a share of the optimum.

    python scripts/benchmark.py prior     15 minutes on an idle core
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import time
from collections.abc import Iterator

import torch
from benchmarks.bo import FOCI, quartiles, show
from shared.scenes import autd3_array, paper_scene, with_array

import autdtorch as at
from autdtorch.objectives.perturbations import random_rms

GAIN, PHASE = 0.1, 0.5  # rms deviations of the transducers: of the logarithm of the gain, and [rad]
SHIFT = 2e-3  # of the obstacle, in any direction [m]
BUDGETS = (16, 32, 64)

OPTIONS = {
    "--trials": {"type": int, "default": 20, "help": "arrays that are measured"},
    "--snr": {"type": float, "default": 30.0, "help": "of the readings [dB]"},
}


class Measured:
    """An array behind obstacles that are both not as they were simulated."""

    def __init__(self, scene: at.Scene, seed: int) -> None:
        """Draw the deviations, and simulate the obstacles where they are."""
        draws = torch.Generator().manual_seed(seed)
        transducers = len(scene.array)
        gain, phase = torch.randn(2, transducers, dtype=torch.float64, generator=draws)
        direction = torch.randn(3, dtype=torch.float64, generator=draws)
        self.scene, self.evaluations = scene, 0
        there = matrix_of(moved(scene, SHIFT * direction / direction.norm()))
        self.matrix = there * torch.polar((GAIN * gain).exp(), PHASE * phase)

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (B, M)."""
        self.evaluations += len(drive)
        return (drive @ self.matrix.T).abs()


def moved(scene: at.Scene, shift: torch.Tensor) -> at.Scene:
    """Move the obstacles by a vector [m]."""
    obstacles = [
        dataclasses.replace(one, center=(torch.tensor(one.center, dtype=torch.float64) + shift).tolist())
        for one in scene.obstacles
    ]
    return dataclasses.replace(scene, obstacles=tuple(obstacles))


def matrix_of(scene: at.Scene) -> torch.Tensor:
    """Simulate the transfer matrix (P, M) [Pa]."""
    return at.make_propagator(scene).transfer_matrix().to("cpu", torch.complex128)


def drive_for(scene: at.Scene, matrix: torch.Tensor) -> torch.Tensor:
    """Return the best drive (1, M) of a matrix."""
    problem = at.Problem(len(scene.array), len(scene.control_points), transfer_matrix=matrix)
    method = at.GradientAscent(steps=1000)
    return method.ask(method.start(problem))


def rows(scene: at.Scene, trials: int, snr: float) -> Iterator[list[str]]:
    """Compare the drives of simulations with those that start from one and read."""
    simulated, empty = matrix_of(scene), matrix_of(dataclasses.replace(scene, obstacles=()))
    arrays = [Measured(scene, seed) for seed in range(trials)]
    best = torch.stack([weakest(one, drive_for(scene, one.matrix)) for one in arrays])
    for name, matrix in (("free space", empty), ("simulation", simulated)):
        drive = drive_for(scene, matrix)
        shares = torch.stack([weakest(one, drive) for one in arrays]) / best
        yield [name, "0", quartiles(shares), f"{shares.min():.3f}", ""]
    # The displacement has any direction: along each axis, it has this rms.
    steps = SHIFT / 3**0.5 * torch.eye(3, dtype=torch.float64)
    variants = torch.stack([matrix_of(moved(scene, step)) for step in steps])
    priors = {"": at.Prior(simulated), ", obstacle may move": at.Prior(simulated, variants)}
    for count, (what, prior) in itertools.product(BUDGETS, priors.items()):
        methods = {"identify": at.Identify(count, prior), "bo_foci": at.BayesOpt(count, prior=prior, **FOCI)}
        for name, method in methods.items():
            begin, shares = time.process_time(), []
            for seed, one in enumerate(arrays):
                observed = at.Noise(one, snr, seed=seed, reference=random_rms(one.matrix))
                shares.append(weakest(one, at.run(method, observed, seed=seed).drive))
            seconds = (time.process_time() - begin) / trials
            found = torch.stack(shares) / best
            yield [name + what, str(count), quartiles(found), f"{found.min():.3f}", f"{seconds:.1f} s"]


def weakest(one: Measured, drive: torch.Tensor) -> torch.Tensor:
    """Return the weakest focus [Pa] of a drive (1, M)."""
    return one(drive).amin(dim=-1)[0]


def main(given: argparse.Namespace) -> None:
    """Print the table."""
    scene = with_array(paper_scene("two_cubes"), autd3_array())
    show(
        ["drive", "evaluations", "share of the optimum", "least", "time"],
        rows(scene, given.trials, given.snr),
    )
