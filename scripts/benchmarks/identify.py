"""Share of the best weakest focus that identification reaches, by noise.

Prints a Markdown table for the paper's scenes. Shares are of the true pressure of the drives found.

    python scripts/benchmark.py identify
"""

from __future__ import annotations

import argparse
import time

from shared.scenes import paper_objectives

import autdtorch as at

CASES = ((None, 47), (None, 64), (30, 64), (20, 64), (20, 128), (20, 256), (10, 64), (10, 256))
"""SNR [dB], None without noise, and evaluations."""

OPTIONS = {"--trials": {"type": int, "default": 40, "help": "trials of each case"}}


def main(given: argparse.Namespace) -> None:
    """Print the table."""
    print("| scene | SNR [dB] | evaluations | median | least | within 1 % | seconds |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, objective in paper_objectives().items():
        best = at.gradient_ascent(objective).score
        for snr, evaluations in CASES:
            observed = objective if snr is None else at.Noise(objective, snr, seed=1)
            start = time.perf_counter()
            found = at.identify(observed, evaluations=evaluations, trials=given.trials)
            seconds = time.perf_counter() - start
            share = objective(found.drive).amin(dim=1) / best
            near = int((share > 0.99).sum())
            shares = f"{share.median():.4f} | {share.min():.4f} | {near} of {given.trials}"
            print(f"| {name} | {snr or 'none'} | {evaluations} | {shares} | {seconds:.1f} |", flush=True)
