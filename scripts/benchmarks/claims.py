"""Claimed and true errors by family of scenes.

Fills in a block of the documentation, or prints the table of some families. Random scenes of
`shared/families.py` are asked for by tolerance. The truth is an exact series, or a grid 2.5 times finer that
a second one confirms; scenes whose truth is not known to a third of the tolerance are left out. Required: in
every family at most 5 % of the scenes miss their tolerance without a warning, and claims are within a factor
of three in 90 %. Takes about 30 minutes on 2 idle cores, most of them for shadows.
"""

import warnings
from dataclasses import dataclass

import numpy as np
import torch
from shared.document import Page, percent, table
from shared.families import FAMILIES, scene_of
from shared.scenes import relative_error, uncached
from shared.timing import logged_warnings, timed

import autdtorch as at
from autdtorch.propagators import SimulatedPropagator

DOCUMENT = "benchmarks.md"
TOLERANCES = (0.05, 0.02, 0.01)
FINER, FINEST = 2.5, 0.45
"""Refinement of the reference, and its coarsest spacing [mm]."""

FACTOR, NEGLIGIBLE = 3.0, 0.05
"""Largest ratio of claim and truth, and share of the tolerance below which both may be anything."""

OPTIONS = {
    "--families": {"nargs": "+", "choices": list(FAMILIES), "default": list(FAMILIES)},
    "--first": {"type": int, "default": 0, "help": "first seed"},
    "--scenes": {"type": int, "default": 10, "help": "scenes of each family"},
}


def main(page: Page, families: list[str], first: int, scenes: int) -> int:
    """Judge the families and write the table; return 1 if a requirement is not met."""
    uncached(scene_of("plate", 0)[0], "box", 2.0).transfer_matrix()  # compiles the kernel
    seeds, rows, failed = range(first, first + scenes), [], False
    for family in families:
        cases = [judged(family, seed, tolerance) for tolerance in TOLERANCES for seed in seeds]
        known = [case for case in cases if case is not None]
        rows.append(row(f"{family} ({len(known)})" if len(known) < len(cases) else family, known))
        failed |= sum(case.silent for case in known) > 0.05 * len(known)
        failed |= sum(case.near for case in known) < 0.9 * len(known)
    caption = (
        f"Seeds {first} to {seeds[-1]} of each family at tolerances of {', '.join(map(percent, TOLERANCES))}"
        f" each, {len(seeds) * len(TOLERANCES)} scenes or those stated: beyond their tolerance without a"
        " warning, with a claim within a factor of three; median error and time of all. Required are at most"
        " 5 % without a warning and 90 % within the factor."
    )
    header = ["family", "silent", "claim within 3", "error", "time"]
    if set(families) == set(FAMILIES):
        page.write(caption, table(header, rows))
    else:
        print("\n".join([caption, table(header, rows)]))
    return int(failed)


@dataclass(frozen=True)
class Judged:
    """A claim and the truth."""

    silent: bool  # whether the true error is beyond the tolerance without a warning
    near: bool  # whether the claim is within a factor of three
    true: float  # relative error
    seconds: float


def judged(family: str, seed: int, tolerance: float) -> Judged | None:
    """Judge the claim for a scene; None if its truth is not known well enough."""
    scene, exact = scene_of(family, seed)

    def work() -> tuple[SimulatedPropagator, torch.Tensor, float]:
        propagator = uncached(scene, "box", None, tolerance)
        return propagator, *propagator.transfer_matrix(return_error=True)

    with warnings.catch_warnings(record=True) as caught, logged_warnings() as logged:
        warnings.simplefilter("always")
        (propagator, matrix, claimed), seconds = timed(work)
        silent = not (caught or logged)
        reference, unsure = (exact, 0.0) if exact is not None else fine(scene, 1e3 * propagator.spacing)
    if unsure > tolerance / 3:
        print(f"{family} {seed}, {tolerance:g}: left out, the truth is known to {unsure:.2g}", flush=True)
        return None
    true = relative_error(matrix, reference)
    missed = true - unsure > tolerance
    near = 1 / FACTOR <= true / claimed <= FACTOR or max(true, claimed) < NEGLIGIBLE * tolerance
    if missed or not near:
        why = "missed" if missed else "claim beyond a factor of three"
        print(f"{family} {seed}, {tolerance:g}: {why}, true {true:.2g}, claimed {claimed:.2g}", flush=True)
    return Judged(missed and silent, near, true, seconds)


def fine(scene: at.Scene, spacing: float) -> tuple[torch.Tensor, float]:
    """Return the matrix on a grid finer than `spacing` [mm], and its difference from a coarser one."""
    finest = min(spacing / FINER, FINEST)
    coarser, reference = (uncached(scene, "box", h, 3e-4).transfer_matrix() for h in (1.45 * finest, finest))
    return reference, relative_error(coarser, reference)


def row(name: str, known: list[Judged]) -> list[str]:
    if not known:
        return [name, *[""] * 4]
    parts = {part: np.array([getattr(case, part) for case in known]) for part in vars(known[0])}
    silent, near = (int(parts[part].sum()) for part in ("silent", "near"))
    error, seconds = (float(np.median(parts[part])) for part in ("true", "seconds"))
    return [name, str(silent), f"{near / len(known):.0%}", percent(error), f"{seconds:.2g} s"]
