"""How near identification comes to gradient ascent in the paper's scenes, without and with noise.

Shares of the gradient's weakest focus that the drives found really make, over the trials. Prints what
docs/decisions/identify.md quotes.

    python scripts/benchmark_identify.py
"""

from __future__ import annotations

import argparse
import time

from paper_objectives import paper_objectives

import autdtorch as at

#: SNR [dB], None without noise, and evaluations
CASES = ((None, 47), (None, 64), (30, 64), (20, 64), (20, 128), (20, 256), (10, 64), (10, 256))


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=40, help="of each case (default: %(default)s)")
    trials = parser.parse_args().trials
    print("| scene | SNR [dB] | evaluations | median | least | within 1 % | seconds |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, objective in paper_objectives().items():
        best = at.gradient_ascent(objective).score
        for snr, evaluations in CASES:
            observed = objective if snr is None else at.Noise(objective, snr, seed=1)
            start = time.perf_counter()
            found = at.identify(observed, evaluations=evaluations, trials=trials)
            seconds = time.perf_counter() - start
            share = objective(found.drive).amin(dim=1) / best
            near = int((share > 0.99).sum())
            shares = f"{share.median():.4f} | {share.min():.4f} | {near} of {trials}"
            print(f"| {name} | {snr or 'none'} | {evaluations} | {shares} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
