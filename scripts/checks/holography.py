"""Holography on random sets of points: "wgs" against its iterates and "gs", all algorithms against the bound.

Sets have 1 to 32 points: in free space before 16, 64 or 144 transducers, in every other of these sets at most
3 to 15 mm apart, and behind the paper's two cubes, of an AUTD3. Exits with 1 if "wgs" ends below one of its
iterates, or more than 1 % below "gs", or if any algorithm is above the bound.
"""

from collections.abc import Iterator

import torch
from shared.scenes import cube_shadow, weakest

import autdtorch as at
from autdtorch.methods.holography.algorithms import SOLVERS
from autdtorch.propagators.free_space import free_space_matrix

OPTIONS = {
    "--sets": {"type": int, "default": 2000, "help": "number of random sets"},
    "--bounds": {"type": int, "default": 1000, "help": "number of sets that are compared with their bound"},
    "--seed": {"type": int, "default": 0, "help": "seed of the random sets"},
}

ALIKE = 20  # sets of one number of points and transducers, solved at once
SHADOW = 300  # points behind the cubes
ITERATIONS = 50  # of those whose iterates are compared
LEAST = 0.99  # of "gs"
ROUNDING = 1e-12
SIDES = 4, 8, 12  # of square arrays, in transducers
WAVENUMBER = 740.0  # of 40 kHz [rad/m]


def main(sets: int, bounds: int, seed: int) -> int:
    """Compare all random sets, and some with their bounds."""
    generator = torch.Generator().manual_seed(seed)
    ratios, short, above, compared = [], 0, 0, 0
    for matrix in random_sets(sets, generator):
        levels = {
            name: weakest(matrix, at.holography(matrix, algorithm=name)) for name in (*SOLVERS, "diff_pat")
        }
        ratios.append(levels["wgs"] / levels["gs"])
        short += below_iterates(matrix)
        for number in range(min(len(matrix), bounds - compared)):
            bound = at.focus_bound(matrix[number])
            above += sum(not level[number] <= bound * (1 + ROUNDING) for level in levels.values())
            compared += 1
    ratio = torch.cat(ratios)
    print(f"{len(ratio)} random sets, seed {seed}: wgs below its best iterate in {short}")
    worse = int((ratio < LEAST).sum())
    print(f"  wgs over gs: least {ratio.min():.4f}, median {ratio.median():.3f}; below {LEAST} in {worse}")
    print(f"  {above} of {compared * len(levels)} drives above their bound")
    return int(short + above + worse > 0)


def random_sets(count: int, generator: torch.Generator) -> Iterator[torch.Tensor]:
    """Yield transfer matrices (N, P, M) of sets in turn in free space, close together, and behind cubes."""
    shadow, kind = cube_shadow(SHADOW), 0
    while count > 0:
        many, points = min(count, ALIKE), int(torch.randint(1, 33, (), generator=generator))
        if kind % 3 == 2:
            places = [torch.randperm(SHADOW, generator=generator)[:points] for _ in range(many)]
            yield torch.stack([shadow[place] for place in places])
        else:
            side = SIDES[int(torch.randint(len(SIDES), (), generator=generator))]
            array = at.TransducerArray.grid((side, side), 10e-3, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
            edge = 3e-3 + 12e-3 * torch.rand(many, 1, 1, dtype=torch.float64, generator=generator)
            edge = edge if kind % 3 else torch.full_like(edge, 100e-3)
            places = edge * (torch.rand(many, points, 3, dtype=torch.float64, generator=generator) - 0.5)
            places[..., 2] += 0.1
            yield free_space_matrix(places.reshape(-1, 3), array, WAVENUMBER).reshape(many, points, -1)
        kind, count = kind + 1, count - many


def below_iterates(matrix: torch.Tensor) -> int:
    """Return in how many sets "wgs" ends below the highest weakest pressure of its iterates."""
    levels = []

    def limited(drive: torch.Tensor) -> torch.Tensor:
        levels.append(weakest(matrix, drive.sgn()[..., 0]))
        return drive.sgn()

    best = SOLVERS["wgs"](matrix, torch.ones_like(matrix[..., :1]).real, ITERATIONS, limited)[..., 0]
    return int((weakest(matrix, best) < (1 - ROUNDING) * torch.stack(levels).amax(dim=0)).sum())
