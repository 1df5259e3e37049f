"""How near identification comes to gradient ascent in the paper's scenes, without and with noise.

Noise is circular Gaussian on the phasors, so many decibels below their rms under random phases. Shares of the
gradient's weakest focus, without noise, over the trials. Prints what docs/decisions/identify.md quotes.

    python scripts/benchmark_identify.py
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch

import autdtorch as at

SCENES = Path(__file__).parents[1] / "configs" / "scene"
PAPER_SCENES = ("homogeneous", "three_cubes", "two_cubes")
#: Decibels and evaluations
CASES = ((math.inf, 47), (math.inf, 64), (30, 64), (20, 64), (20, 128), (20, 256), (10, 64), (10, 256))


class Noisy:
    """An objective whose phasors carry noise."""

    def __init__(self, objective: at.SimulatedObjective, decibels: float, seed: int) -> None:
        """Noise of `decibels` below the rms pressure, of its own `seed`."""
        assert objective.transfer_matrix is not None
        self.scene, self.evaluations = objective.scene, 0
        self._matrix = objective.transfer_matrix
        self._level = self._matrix.abs().square().sum(dim=1).mean().sqrt() * 10 ** (-decibels / 20)
        self._generator = torch.Generator().manual_seed(seed)

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (B, M)."""
        self.evaluations += len(drive)
        pressure = drive @ self._matrix.T
        noise = torch.randn(pressure.shape, dtype=pressure.dtype, generator=self._generator)
        return (pressure + self._level * noise).abs()


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=40, help="of each case (default: %(default)s)")
    trials = parser.parse_args().trials
    print("| scene | SNR [dB] | evaluations | median | least | within 1 % | seconds |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in PAPER_SCENES:
        scene = at.load_scene(SCENES / f"{name}.yaml")
        objective = at.SimulatedObjective(scene, at.make_propagator(scene))
        best = at.gradient_ascent(objective).score
        for decibels, evaluations in CASES:
            start = time.perf_counter()
            found = at.identify(Noisy(objective, decibels, seed=1), evaluations=evaluations, trials=trials)
            seconds = time.perf_counter() - start
            share = objective(found.drive).amin(dim=1) / best
            near = int((share > 0.99).sum())
            print(
                f"| {name} | {decibels:g} | {evaluations} | {share.median():.4f} | {share.min():.4f} "
                f"| {near} of {trials} | {seconds:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
