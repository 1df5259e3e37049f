"""Targets and nulls by holography, on random sets of points in free space and behind the paper's two cubes.

As Fushimi, Yamamoto and Ochiai did for Diff-PAT (2021, doi:10.1038/s41598-021-91880-2): random sets of 1 to
32 points with random targets, for an AUTD3. A quarter of the points are nulls. Sets whose targets no drive
reaches, by their bound, are counted apart. Exits with 1 if the median error of the others is above 1 %, or a
null is less than 30 dB below the weakest focus in more than one of ten.

    python scripts/check.py targets --sets 1000        about four minutes on 2 idle cores
"""

from __future__ import annotations

import argparse
import math
from typing import NamedTuple

import numpy as np
import torch
from shared.scenes import autd3_array, paper_scene, with_array

import autdtorch as at
from autdtorch.analytic.green import free_space_matrix
from autdtorch.objectives.bound import level_bound

MOST, PLACES, ITERATIONS = 32, 600, 1000
SPACING = 1e-3  # [m]
ALLOWED, NULL = 0.01, 10 ** (-30 / 20)
LOWER, UPPER = (70e-3, 20e-3, 20e-3), (110e-3, 80e-3, 80e-3)  # corners of the box of all points [m]


class Outcome(NamedTuple):
    """The outcome of a set: whether it can be reached, errors of its targets, and its loudest null.

    The null is relative to the weakest focus.
    """

    reachable: bool
    errors: torch.Tensor
    null: float


def matrices() -> dict[str, torch.Tensor]:
    """Return transfer matrices (PLACES, M) of random places."""
    scene = with_array(paper_scene("two_cubes"), autd3_array())
    generator = torch.Generator().manual_seed(0)
    lower, upper = torch.tensor((LOWER, UPPER), dtype=torch.float64)
    places = lower + (upper - lower) * torch.rand(PLACES, 3, dtype=torch.float64, generator=generator)
    behind = at.make_propagator(scene, "box", SPACING, cache=False).transfer_matrix(places)
    return {
        "free space": free_space_matrix(places, scene.array, scene.wavenumber),
        "two cubes": behind.to(torch.complex128),
    }


def random_sets(matrix: torch.Tensor, count: int, points: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return matrices (count, points, M) of random places, and targets (count, points) [Pa], 0 for nulls."""
    generator = torch.Generator().manual_seed(points)
    chosen = torch.stack([torch.randperm(PLACES, generator=generator)[:points] for _ in range(count)])
    rows = matrix[chosen]
    size = 0.5 + 0.5 * torch.rand(count, points, dtype=torch.float64, generator=generator)
    level = 0.2 + torch.rand(count, 1, dtype=torch.float64, generator=generator)
    targets = size * level * rows.abs().sum(dim=-1) / math.sqrt(points)
    targets[:, : points // 4] = 0
    return rows, targets


def outcome(matrix: torch.Tensor, targets: torch.Tensor, drive: torch.Tensor) -> Outcome:
    """Return the outcome of one set, for a drive (M,)."""
    pressure, loud = (matrix @ drive).abs(), targets > 0
    errors = (pressure / targets - 1).abs()[loud]
    null = float(pressure[~loud].amax() / pressure[loud].amin()) if not loud.all() else 0.0
    reached = bool(errors.max() <= ALLOWED) and null <= NULL
    return Outcome(reached or can_be_reached(matrix, targets), errors, null)


def can_be_reached(matrix: torch.Tensor, targets: torch.Tensor) -> bool:
    """Return whether the bound leaves the targets, with nulls 30 dB below the weakest focus."""
    loud = targets > 0
    rows, wanted = matrix[loud].numpy(), targets[loud].numpy()
    if level_bound(rows, wanted)[0] < 1:
        return False
    return bool(level_bound(rows, wanted, matrix[~loud].numpy(), NULL * float(wanted.min()))[0] >= 1)


def report(name: str, outcomes: list[Outcome]) -> bool:
    """Print what was found; return whether it is within the limits."""
    left = [one for one in outcomes if one.reachable]
    errors = torch.cat([one.errors for one in left])
    nulls = np.array([one.null for one in left if one.null > 0] or [0.0])
    median, high = float(errors.median()), float(errors.quantile(0.9))
    quiet = 20 * np.log10(np.quantile(nulls, [0.5, 0.9]).clip(1e-20))
    deep = float((nulls <= NULL).mean())
    print(
        f"{name}: {len(left)} of {len(outcomes)} sets can be reached by their bounds; errors of amplitudes: "
        f"median {median:.1e}, nine of ten below {high:.1e}; loudest null: median {quiet[0]:.0f} dB, "
        f"nine of ten below {quiet[1]:.0f} dB, {100 * deep:.1f} % below -30 dB",
        flush=True,
    )
    return median <= ALLOWED and deep >= 0.9


OPTIONS = {"--sets": {"type": int, "default": 1000, "help": "random sets in each scene, at least 32"}}


def main(given: argparse.Namespace) -> int:
    """Check both scenes, with phases alone and with amplitudes."""
    fine = []
    for scene, matrix in matrices().items():
        for free in (False, True):
            outcomes = []
            for points in range(1, MOST + 1):
                count = len(range(points - 1, given.sets, MOST))
                if count == 0:
                    continue
                rows, targets = random_sets(matrix, count, points)
                drives = at.holography(rows, targets, "diff_pat", ITERATIONS, free)
                outcomes += map(outcome, rows, targets, drives)
            fine.append(report(f"{scene}, {'amplitudes free' if free else 'phases alone'}", outcomes))
    return int(not all(fine))
