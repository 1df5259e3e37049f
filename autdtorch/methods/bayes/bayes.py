"""Bayesian optimisation of the phases (Algorithm 1), many trials at once."""

from __future__ import annotations

import math
from typing import Literal

import torch

from autdtorch.methods.base import Ledger, Solution, Trials, trial_seeds
from autdtorch.objectives.simulated import Objective, Score, weakest_focus
from autdtorch.scene.drive import drive_from_phases
from autdtorch.utils.threads import spread
from autdtorch.utils.validation import integer_at_least, invalid, number_between, require_one_of

#: Variance of the observation noise that the Gaussian process assumes, in its own variances. Fitted, it takes
#: the kinks of the minimum over the foci for noise, and the search ends lower.
NOISE = 1e-4


def bayes_opt(
    objective: Objective,
    evaluations: int = 256,
    initial: int = 16,
    trials: Trials = 1,
    seed: int = 0,
    fixed_transducer: int = 6,
    score: Score = weakest_focus,
    *,
    acquisition: Literal["ei", "log_ei"] = "ei",
    embedding: Literal["phases", "circle"] = "phases",
    initial_points: Literal["sobol", "random"] = "sobol",
    noise: float | Literal["inferred"] = NOISE,
) -> Solution:
    """Maximise the score over the phases by Bayesian optimisation (Algorithm 1), all amplitudes being 1.

    A Gaussian process with zero mean and an isotropic Matern 5/2 kernel is fitted to the standardised scores;
    the next phases maximise the expected improvement (Eq. 7). By default the process does not know that
    phases are periodic, as in the paper.

    Trials take each step together, in one call of the objective, and search for the next phases side by side
    on threads of their own, as many as PyTorch has.

    Args:
        objective: what is evaluated.
        evaluations: number of evaluations a trial, > `initial`.
        initial: how many of them, >= 2, are spread over all phases before the search.
        trials: number of trials T, >= 1, or their numbers.
        seed: >= 0; trial t is the same for every number of trials.
        fixed_transducer: index of the transducer whose phase stays 0, since a common offset of all phases
            changes no magnitude; 6 is the paper's 7th.
        score: what is maximised.
        acquisition: "ei", the expected improvement, or "log_ei", its logarithm (Ament et al. 2023), which has
            a slope also where the improvement itself rounds to 0.
        embedding: what the kernel measures distances between: the "phases" as numbers from 0 to 2 pi, or
            their points (cos, sin) on the "circle", which makes the process periodic.
        initial_points: a scrambled "sobol" sequence, or independent "random" points.
        noise: variance of the observations, in variances of the process, from 1e-6 to 1; "inferred" fits it.

    Returns:
        The best drive observed in each trial.

    Raises:
        ValueError: an argument out of range, an array of one transducer, or the objective's pressures or
            scores are not finite.
    """
    initial = integer_at_least("initial", initial, 2)
    evaluations = integer_at_least("evaluations", evaluations, initial + 1)
    seeds = trial_seeds(seed, trials)
    require_one_of("acquisition", acquisition, ("ei", "log_ei"))
    require_one_of("embedding", embedding, ("phases", "circle"))
    require_one_of("initial_points", initial_points, ("sobol", "random"))
    if isinstance(noise, str):
        require_one_of("noise", noise, ("inferred",))
    variance = None if isinstance(noise, str) else number_between("noise", noise, 1e-6, 1)
    ledger = Ledger(objective, len(seeds), score)
    transducers = integer_at_least("transducers of the objective's array", ledger.transducers, 2)
    if integer_at_least("fixed_transducer", fixed_transducer, 0) >= transducers:
        raise invalid("fixed_transducer", fixed_transducer, f"must be an integer from 0 to {transducers - 1}")
    # each trial's process holds a matrix of all pairs of evaluations
    ledger.require_memory(float(evaluations) ** 2 / 2, evaluations=evaluations)

    from autdtorch.methods.bayes.trial import BayesTrial, Settings  # loads Numba

    settings = Settings(
        dimensions=transducers - 1,
        evaluations=evaluations,
        initial=initial,
        log=acquisition == "log_ei",
        circle=embedding == "circle",
        sobol=initial_points == "sobol",
        noise=variance,
    )
    searches = [BayesTrial(settings, trial) for trial in seeds]
    points = torch.stack([search.initial_points() for search in searches])
    scores = ledger.evaluate(_drive(points, fixed_transducer))
    for _ in range(initial, evaluations):
        told = zip(searches, points, scores, strict=True)
        points = torch.stack(spread(lambda one: one[0].next_point(*one[1:]), told))[:, None]
        scores = ledger.evaluate(_drive(points, fixed_transducer))
    return ledger.solution()


def _drive(points: torch.Tensor, fixed_transducer: int) -> torch.Tensor:
    """Drive (..., M) of points (..., M - 1) in turns."""
    before, after = points[..., :fixed_transducer], points[..., fixed_transducer:]
    turns = torch.cat([before, torch.zeros_like(points[..., :1]), after], dim=-1)
    return drive_from_phases(2 * math.pi * turns)
