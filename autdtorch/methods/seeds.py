"""The seeds of trials, and the random generators that they begin."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import torch

from autdtorch.utils.process import require_memory
from autdtorch.utils.validation import integer_at_least, integers, invalid

Trials: TypeAlias = int | Sequence[int]
"""A number of trials T, or the numbers of the T trials to run, so that a study can run them in blocks."""

TRIAL_BYTES = 6_000.0
"""Memory of a trial [bytes]; most of it is the state of its random generator."""


def generators_of(seeds: Sequence[int]) -> list[torch.Generator]:
    """Return a random generator for each seed."""
    return [torch.Generator("cpu").manual_seed(seed) for seed in seeds]


def uniform(generator: torch.Generator, *shape: int) -> torch.Tensor:
    """Return random numbers in [0, 1), float64."""
    return torch.rand(shape, dtype=torch.float64, generator=generator, device="cpu")


def states_of(generators: Sequence[torch.Generator]) -> torch.Tensor:
    """Return the states (T, N), uint8, of generators, as a `State` keeps them."""
    return torch.stack([generator.get_state() for generator in generators])


def restored(states: torch.Tensor) -> list[torch.Generator]:
    """Return generators in the states (T, N), uint8."""
    generators = [torch.Generator("cpu") for _ in states]
    for generator, state in zip(generators, states, strict=True):
        generator.set_state(state.clone())  # it would read a row from the beginning of the whole tensor
    return generators


def trial_seeds(seed: int, trials: Trials) -> list[int]:
    """Return the seed of each trial, which does not depend on the other trials."""
    seed = integer_at_least("seed", seed, 0)
    if isinstance(trials, numbers.Integral):
        count = integer_at_least("trials", trials, 1)
        require_memory("trials", count, TRIAL_BYTES * count)
        return [trial_seed(seed, trial) for trial in range(count)]
    accepted = "must be an integer >= 1, or trial numbers, each once"
    if isinstance(trials, Sequence):
        require_memory("trials", f"{len(trials)} numbers", TRIAL_BYTES * len(trials))
    chosen = integers("trials", trials, 0, accepted)
    if not chosen or len(set(chosen)) < len(chosen):
        raise invalid("trials", chosen, accepted)
    return [trial_seed(seed, trial) for trial in chosen]


def trial_seed(seed: int, trial: int) -> int:
    """Return the seed of one trial."""
    # Half the range of uint64: torch takes seeds as signed.
    return int(np.random.SeedSequence((seed, trial)).generate_state(1, np.uint64)[0] >> np.uint64(1))
