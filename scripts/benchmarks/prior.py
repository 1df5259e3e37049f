"""An inaccurate simulation as the prior of a measurement, behind the two cubes with an AUTD3.

The transducers of the measured array differ in gain and phase, and the obstacle stands elsewhere. Prints the
weakest focus as a share of the optimum. Takes 15 minutes on an idle core.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator
from typing import Any

import torch
from benchmarks.pictures import SHIFT, Bench
from shared.document import printed, quartiles, table
from shared.scenes import autd3_array, paper_scene, weakest, with_array
from shared.timing import timed

import autdtorch as at
from autdtorch.objectives.perturbations import random_rms

BUDGETS = (16, 32, 64)
FOCI: dict[str, Any] = {"model": "foci", "kernel": "phasor", "noise": "inferred"}
best_drive = functools.partial(at.gradient_ascent, steps=1000)

OPTIONS = {
    "--trials": {"type": int, "default": 20, "help": "arrays that are measured"},
    "--snr": {"type": float, "default": 30.0, "help": "of the readings [dB]"},
}


def main(trials: int, snr: float) -> None:
    scene = with_array(paper_scene("two_cubes"), autd3_array())
    header = ["drive", "evaluations", "share of the optimum", "least", "time"]
    print("", table(header, printed(rows(scene, trials, snr))), sep="\n")


def matrix_of(scene: at.Scene) -> torch.Tensor:
    return at.make_propagator(scene).transfer_matrix().to("cpu", torch.complex128)


def rows(scene: at.Scene, trials: int, snr: float) -> Iterator[list[str]]:
    """Compare the drives of simulations with those that start from one and read."""
    simulated, empty = matrix_of(scene), matrix_of(dataclasses.replace(scene, obstacles=()))
    changes = dict.fromkeys(("obstacles.x", "obstacles.y", "obstacles.z"), SHIFT / 3**0.5)
    arrays = [Bench(at.make_propagator(scene), changes, seed) for seed in range(trials)]
    best = torch.stack([weakest(array.matrix, best_drive(array.matrix).drive[0]) for array in arrays])
    for name, matrix in (("free space", empty), ("simulation", simulated)):
        drive = best_drive(matrix).drive
        shares = torch.stack([weakest(array.matrix, drive[0]) for array in arrays]) / best
        yield [name, "0", quartiles(shares), f"{shares.min():.3f}", ""]
    # The displacement has any direction: along each axis, it has this rms.
    steps = SHIFT / 3**0.5 * torch.eye(3, dtype=torch.float64)
    variants = torch.stack([matrix_of(scene.moved(step)) for step in steps])
    priors = {"": at.Prior(simulated), ", obstacle may move": at.Prior(simulated, variants)}
    for count, (what, prior) in itertools.product(BUDGETS, priors.items()):
        methods = {"identify": at.Identify(count, prior), "bo_foci": at.BayesOpt(count, prior=prior, **FOCI)}
        for name, method in methods.items():

            def share(seed: int, method: at.Method = method) -> torch.Tensor:
                array = arrays[seed]
                observed = at.Noise(array, snr, seed=seed, reference=random_rms(array.matrix))
                drive = at.run(method, observed, seed=seed).drive[0]
                return weakest(array.matrix, drive) / best[seed]

            shares, seconds = timed(lambda: torch.stack([*map(share, range(trials))]), time.process_time)
            least, spent = f"{shares.min():.3f}", f"{seconds / trials:.1f} s"
            yield [name + what, str(count), quartiles(shares), least, spent]
