"""Share of the best weakest focus that identification reaches, by noise.

Prints a Markdown table for the paper's scenes. Shares are those of the true pressure of the drives.
"""

from collections.abc import Iterator

from shared.document import printed, table
from shared.scenes import paper_objectives
from shared.timing import timed

import autdtorch as at

CASES = ((None, 47), (None, 64), (30, 64), (20, 64), (20, 128), (20, 256), (10, 64), (10, 256))
"""SNR [dB], None without noise, and evaluations."""

OPTIONS = {"--trials": {"type": int, "default": 40, "help": "trials of each case"}}


def main(trials: int) -> None:
    header = ["scene", "SNR [dB]", "evaluations", "median", "least", "within 1 %", "seconds"]
    print("", table(header, printed(rows(trials))), sep="\n")


def rows(trials: int) -> Iterator[list[str]]:
    for name, objective in paper_objectives().items():
        best = at.gradient_ascent(objective).score
        for snr, evaluations in CASES:
            observed = objective if snr is None else at.Noise(objective, snr, seed=1)
            solution, seconds = timed(lambda o=observed, n=evaluations: at.identify(o, n, trials=trials))
            share = objective(solution.drive).amin(dim=1) / best
            shares = f"{share.median():.4f}", f"{share.min():.4f}", f"{int((share > 0.99).sum())} of {trials}"
            yield [name, str(snr or "none"), str(evaluations), *shares, f"{seconds:.1f}"]
