"""What errors are claimed, and what they are, by family of scenes.

Fills in a block of benchmarks.md, or prints the table of some families. Random scenes of `shared/families.py`
are asked for by tolerance. The truth is an exact series, or a grid 2.5 times finer that a second one
confirms; scenes whose truth is not known to a third of the tolerance are left out. Required: in every family
at most 5 % of the scenes miss their tolerance without a warning, and claims are within a factor of three in
90 %.

    python scripts/benchmark.py claims              about 20 minutes on 2 idle cores, most of them for shadows
    python scripts/benchmark.py claims --families plate slit --first 100 --scenes 10
"""

from __future__ import annotations

import argparse
import logging
import time
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from shared.document import fill_in, measured, percent, table
from shared.families import FAMILIES, scene_of
from shared.scenes import relative_error, uncached

import autdtorch as at
from autdtorch.propagators import SimulatedPropagator
from autdtorch.propagators.moved_boxes import forget_assemblies

DOCUMENT = "benchmarks.md"
TOLERANCES = (0.05, 0.02, 0.01)
FINER, FINEST = 2.5, 0.45e-3
"""Ratio of the spacing used and that of the reference, and the coarsest spacing [m] of one."""

FACTOR, NEGLIGIBLE = 3.0, 0.05
"""Largest ratio of claim and truth, and share of the tolerance below which both may be anything."""

OPTIONS = {
    "--families": {"nargs": "+", "choices": list(FAMILIES), "default": list(FAMILIES)},
    "--first": {"type": int, "default": 0, "help": "first seed"},
    "--scenes": {"type": int, "default": 10, "help": "scenes of each family"},
}


@dataclass(frozen=True)
class Judged:
    """A claim and the truth; relative errors.

    Attributes:
        missed: whether the true error is beyond the tolerance.
        silent: whether that went without a warning.
        near: whether the claim is within a factor of three.
        true: error.
        seconds: run time.
    """

    missed: bool
    silent: bool
    near: bool
    true: float
    seconds: float


class _Warnings(logging.Handler):
    """Counts the warnings of the package."""

    count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1


def judged(family: str, seed: int, tolerance: float) -> Judged | None:
    """Return what is claimed of a scene, or None if its truth is not known well enough."""
    scene, exact = scene_of(family, seed)
    heard = _Warnings(logging.WARNING)
    logging.getLogger("autdtorch").addHandler(heard)
    forget_assemblies()
    begin = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        propagator = at.make_propagator(scene, "box", spacing=None, tolerance=tolerance, cache=False)
        assert isinstance(propagator, SimulatedPropagator)
        matrix, claimed = propagator.transfer_matrix(return_error=True)
    seconds = time.perf_counter() - begin
    logging.getLogger("autdtorch").removeHandler(heard)
    reference, unsure = (exact, 0.0) if exact is not None else fine(scene, propagator.spacing)
    if unsure > tolerance / 3:
        print(f"{family} {seed}, {tolerance:g}: left out, the truth is known to {unsure:.2g}", flush=True)
        return None
    true = relative_error(matrix, reference)
    missed = true - unsure > tolerance
    near = 1 / FACTOR <= true / claimed <= FACTOR or max(true, claimed) < NEGLIGIBLE * tolerance
    if missed or not near:
        why = "missed" if missed else "claim beyond a factor of three"
        print(f"{family} {seed}, {tolerance:g}: {why}, true {true:.2g}, claimed {claimed:.2g}", flush=True)
    return Judged(missed, missed and not (caught or heard.count), near, true, seconds)


def fine(scene: at.Scene, spacing: float) -> tuple[torch.Tensor, float]:
    """Return the matrix on a fine grid, and its difference from a coarser one."""
    finest = min(spacing / FINER, FINEST)
    coarser, reference = (
        uncached(scene, "box", 1e3 * h, 3e-4).transfer_matrix() for h in (1.45 * finest, finest)
    )
    return reference, relative_error(coarser, reference)


def row(name: str, found: list[Judged | None]) -> list[str]:
    """Return the counts of a family."""
    known = [one for one in found if one is not None]
    if not known:
        return [name, f"0 of {len(found)}", *[""] * 5]
    missed, silent, near = (sum(getattr(one, part) for one in known) for part in ("missed", "silent", "near"))
    error, seconds = (float(np.median([getattr(one, part) for one in known])) for part in ("true", "seconds"))
    share = f"{near / len(known):.0%}"
    return [
        name,
        f"{len(known)} of {len(found)}",
        str(missed),
        str(silent),
        share,
        percent(error),
        f"{seconds:.2g} s",
    ]


def main(given: argparse.Namespace) -> int:
    """Judge the families and write the table; return 1 if a requirement is not met."""
    scene, _ = scene_of("plate", 0)
    uncached(scene, "box", 2.0).transfer_matrix()  # compiles the kernel
    rows, failed = [], False
    for family in given.families:
        seeds = range(given.first, given.first + given.scenes)
        found = [judged(family, seed, tolerance) for tolerance in TOLERANCES for seed in seeds]
        rows.append(row(family, found))
        known = [one for one in found if one is not None]
        failed |= sum(one.silent for one in known) > 0.05 * len(known)
        failed |= sum(one.near for one in known) < 0.9 * len(known)
    last = given.first + given.scenes - 1
    tolerances = ", ".join(percent(each) for each in TOLERANCES)
    caption = (
        f"Seeds {given.first} to {last} of each family at tolerances of {tolerances} each: scenes judged,"
        " beyond their tolerance, of these without a warning, with a claim within a factor of three; median"
        " error and time of all. Required are at most 5 % without a warning and 90 % within the factor."
    )
    header = ["family", "judged", "missed", "silent", "claim within 3", "error", "time"]
    if set(given.families) == set(FAMILIES):
        fill_in(DOCUMENT, "benchmark.py claims", [measured(), caption, table(header, rows)], given.output)
    else:  # a page has all
        print("\n".join([caption, table(header, rows)]))
    return int(failed)
