"""Bayesian optimisation of the phases (Algorithm 1), on BoTorch.

BoTorch takes seconds to import, so that only the functions that need it do.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

import torch

from autdtorch.drive import drive_from_phases
from autdtorch.objective import Objective, Score, weakest_focus
from autdtorch.optim.base import Ledger, Solution, Trials, trial_seeds
from autdtorch.validation import integer_at_least, invalid

if TYPE_CHECKING:
    from botorch.models import SingleTaskGP

#: Variance of the observation noise that the Gaussian process assumes, in variances of the scores. Fitted, it
#: takes the kinks of the minimum over the foci for noise, and the search ends lower.
NOISE = 1e-4

_REFIT_GROWTH = 1.1  # The length scale is fitted anew when there are this many times more observations.
_CANDIDATES = 128  # Points at which the acquisition function is compared before it is climbed.
_STARTS = 2  # The best of them are climbed from,
_CLIMB_STEPS = 20  # so many steps each.


def bayes_opt(
    objective: Objective,
    evaluations: int = 256,
    initial: int = 16,
    trials: Trials = 1,
    seed: int = 0,
    fixed_transducer: int = 6,
    score: Score = weakest_focus,
) -> Solution:
    """Maximise the score over the phases by Bayesian optimisation (Algorithm 1), all amplitudes being 1.

    A Gaussian process with zero mean and an isotropic Matern 5/2 kernel is fitted to the standardised scores;
    the next phases maximise the expected improvement (Eq. 7). As in the paper, the process does not know that
    phases are periodic.

    Args:
        objective: what is evaluated.
        evaluations: number of evaluations a trial, > `initial`.
        initial: how many of them, >= 2, are spread over all phases (a scrambled Sobol sequence) before the
            search.
        trials: number of trials T, >= 1, or their numbers.
        seed: >= 0; trial t is the same for every number of trials.
        fixed_transducer: index of the transducer whose phase stays 0, since a common offset of all phases
            changes no magnitude; 6 is the paper's 7th.
        score: what is maximised.

    Returns:
        The best drive observed in each trial.

    Raises:
        ValueError: an argument out of range, an array of one transducer, or the objective's pressures or
            scores are not finite.
    """
    initial = integer_at_least("initial", initial, 2)
    evaluations = integer_at_least("evaluations", evaluations, initial + 1)
    seeds = trial_seeds(seed, trials)
    transducers = integer_at_least("transducers of the objective's array", len(objective.scene.array), 2)
    if integer_at_least("fixed_transducer", fixed_transducer, 0) >= transducers:
        raise invalid("fixed_transducer", fixed_transducer, f"must be an integer from 0 to {transducers - 1}")

    ledger = Ledger(objective, len(seeds), score)
    generators = [torch.Generator().manual_seed(trial) for trial in seeds]
    points = torch.stack([_spread_points(initial, transducers - 1, trial) for trial in seeds])
    scores = ledger.evaluate(_drive(points, fixed_transducer))
    length_scales: list[float | None] = [None] * len(seeds)
    next_fit = initial
    for count in range(initial, evaluations):
        if count >= next_fit:
            length_scales = [None] * len(seeds)
            next_fit = math.ceil(_REFIT_GROWTH * count)
        found = [_next_point(*known) for known in zip(points, scores, length_scales, generators, strict=True)]
        length_scales = [length_scale for _, length_scale in found]
        point = torch.stack([point for point, _ in found])[:, None]
        points = torch.cat([points, point], dim=1)
        scores = torch.cat([scores, ledger.evaluate(_drive(point, fixed_transducer))], dim=1)
    return ledger.solution()


def _spread_points(count: int, dimensions: int, seed: int) -> torch.Tensor:
    from botorch.utils.sampling import draw_sobol_samples

    return draw_sobol_samples(_unit_cube(dimensions), n=count, q=1, seed=seed)[:, 0]


def _unit_cube(dimensions: int) -> torch.Tensor:
    """Lower and upper corner (2, D)."""
    return torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, dimensions)


def _drive(points: torch.Tensor, fixed_transducer: int) -> torch.Tensor:
    """Drive (..., M) of points (..., M - 1) in the unit cube."""
    before, after = points[..., :fixed_transducer], points[..., fixed_transducer:]
    turns = torch.cat([before, torch.zeros_like(points[..., :1]), after], dim=-1)
    return drive_from_phases(2 * math.pi * turns)


def _next_point(
    points: torch.Tensor, scores: torch.Tensor, length_scale: float | None, generator: torch.Generator
) -> tuple[torch.Tensor, float]:
    """The point (D,) of the unit cube with the largest expected improvement, and the length scale.

    Args:
        points: (N, D), evaluated so far.
        scores: (N,).
        length_scale: of the kernel; None to fit it.
        generator: draws the points at which the search for the maximum starts.
    """
    from botorch.acquisition.analytic import ExpectedImprovement
    from botorch.exceptions.warnings import NumericsWarning
    from botorch.optim.optimize import optimize_acqf

    # A score that never changes has no deviation to divide by.
    standard = (scores - scores.mean()) / scores.std().clamp_min(torch.finfo(scores.dtype).tiny)
    process = _gaussian_process(points, standard, length_scale)
    with warnings.catch_warnings():
        # BoTorch advises the logarithm of EI, which has a slope where EI itself rounds to 0. The climb starts
        # where EI was largest among many points, some next to the best: there both end alike, and the paper
        # names EI.
        warnings.simplefilter("ignore", NumericsWarning)
        acquisition = ExpectedImprovement(process, best_f=standard.max())
    candidates = _candidates(points[scores.argmax()], generator)[:, None]
    with torch.no_grad():
        starts = candidates[acquisition(candidates).topk(_STARTS).indices]
    point, _ = optimize_acqf(
        acquisition,
        bounds=_unit_cube(points.shape[1]),
        q=1,
        num_restarts=_STARTS,
        batch_initial_conditions=starts,
        options={"maxiter": _CLIMB_STEPS},
    )
    return point[0], process.covar_module.lengthscale.item()


def _gaussian_process(
    points: torch.Tensor, standard: torch.Tensor, length_scale: float | None
) -> SingleTaskGP:
    """The process given the standardised scores (N,) at points (N, D), with frozen hyperparameters."""
    from botorch import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from botorch.settings import validate_input_scaling
    from gpytorch.kernels import MaternKernel
    from gpytorch.means import ZeroMean
    from gpytorch.mlls import ExactMarginalLogLikelihood

    # One length scale for all phases: with one for each the fit takes longer and the search ends lower.
    kernel = MaternKernel(nu=2.5)
    if length_scale is not None:
        kernel.lengthscale = length_scale
    with validate_input_scaling(False):  # constant scores cannot have a deviation of 1
        process = SingleTaskGP(
            points,
            standard[:, None],
            train_Yvar=torch.full_like(standard, NOISE)[:, None],
            covar_module=kernel,
            mean_module=ZeroMean(),
            outcome_transform=None,  # the scores are standardised already
        )
    if length_scale is None:
        fit_gpytorch_mll(ExactMarginalLogLikelihood(process.likelihood, process))
    return process.eval().requires_grad_(False)


def _candidates(best: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Points (_CANDIDATES, D): half of them anywhere, half at all distances around the `best` point (D,)."""
    anywhere, near = torch.rand(2, _CANDIDATES // 2, len(best), dtype=torch.float64, generator=generator)
    # Normally distributed steps; their lengths are spread evenly in logarithm, from 0.001 to 0.3.
    scale = 10 ** (-3 + 2.5 * torch.rand(len(near), 1, dtype=torch.float64, generator=generator))
    steps = scale * torch.randn(near.shape, dtype=torch.float64, generator=generator)
    return torch.cat([anywhere, (best + steps).clamp(0, 1)])
