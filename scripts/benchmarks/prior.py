"""An inaccurate simulation as the prior of a measurement, behind the two cubes with an AUTD3.

The transducers of the measured array differ in gain and phase, and the obstacle stands elsewhere. Prints the
weakest focus as a share of the optimum. Takes 15 minutes on an idle core.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator

import torch
from benchmarks.bo import FOCI
from shared.document import printed, quartiles, table
from shared.scenes import autd3_array, paper_scene, with_array
from shared.timing import timed

import autdtorch as at
from autdtorch.objectives.perturbations import random_rms

GAIN, PHASE = 0.1, 0.5  # rms deviations of the transducers: of the logarithm of the gain, and [rad]
SHIFT = 2e-3  # of the obstacle, in any direction [m]
BUDGETS = (16, 32, 64)
best_drive = functools.partial(at.gradient_ascent, steps=1000)

OPTIONS = {
    "--trials": {"type": int, "default": 20, "help": "arrays that are measured"},
    "--snr": {"type": float, "default": 30.0, "help": "of the readings [dB]"},
}


def main(trials: int, snr: float) -> None:
    """Print the table."""
    scene = with_array(paper_scene("two_cubes"), autd3_array())
    header = ["drive", "evaluations", "share of the optimum", "least", "time"]
    print("", table(header, printed(rows(scene, trials, snr))), sep="\n")


class Measured:
    """An array and obstacles that both differ from the simulation."""

    def __init__(self, scene: at.Scene, seed: int) -> None:
        """Draw the deviations, and simulate the obstacles where they are."""
        draws = torch.Generator().manual_seed(seed)
        transducers = len(scene.array)
        gain, phase = torch.randn(2, transducers, dtype=torch.float64, generator=draws)
        direction = torch.randn(3, dtype=torch.float64, generator=draws)
        self.scene, self.evaluations = scene, 0
        there = matrix_of(scene.moved(SHIFT * direction / direction.norm()))
        self.matrix = there * torch.polar((GAIN * gain).exp(), PHASE * phase)

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (B, M)."""
        self.evaluations += len(drive)
        return (drive @ self.matrix.T).abs()

    def weakest(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the weakest focus [Pa] of a drive (1, M)."""
        return self(drive).amin(dim=-1)[0]


def matrix_of(scene: at.Scene) -> torch.Tensor:
    """Simulate the transfer matrix (P, M) [Pa]."""
    return at.make_propagator(scene).transfer_matrix().to("cpu", torch.complex128)


def rows(scene: at.Scene, trials: int, snr: float) -> Iterator[list[str]]:
    """Compare the drives of simulations with those that start from one and read."""
    simulated, empty = matrix_of(scene), matrix_of(dataclasses.replace(scene, obstacles=()))
    arrays = [Measured(scene, seed) for seed in range(trials)]
    best = torch.stack([array.weakest(best_drive(array.matrix).drive) for array in arrays])
    for name, matrix in (("free space", empty), ("simulation", simulated)):
        drive = best_drive(matrix).drive
        shares = torch.stack([array.weakest(drive) for array in arrays]) / best
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
                return array.weakest(at.run(method, observed, seed=seed).drive) / best[seed]

            shares, seconds = timed(lambda: torch.stack([*map(share, range(trials))]), time.process_time)
            least, spent = f"{shares.min():.3f}", f"{seconds / trials:.1f} s"
            yield [name + what, str(count), quartiles(shares), least, spent]
