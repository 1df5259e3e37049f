"""Optimisers of others on the phases of a drive: each a function of losses, to be minimised.

They see a score of each drive, not the pressures. Each spends as many evaluations as `Losses` has left, in
steps of whole populations, and returns the phases that it recommends.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import TypeAlias

import cma
import numpy as np
import optuna
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.generation import MaxPosteriorSampling
from botorch.models import SingleTaskGP
from gpytorch.constraints import Interval
from gpytorch.kernels import MaternKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.mlls import ExactMarginalLogLikelihood
from numpy.typing import NDArray
from torch.quasirandom import SobolEngine

import autdtorch as at

Phases: TypeAlias = NDArray[np.float64]
"""Phases (M,) or (B, M) [rad], of any period."""

_TURN = 2 * math.pi
_STEP = 1.5  # standard deviation of the first population of CMA-ES [rad]


class Losses:
    """Minus the scores of phases, as long as evaluations are left.

    Attributes:
        transducers: number M.
        left: evaluations.
        best: the phases (M,) of the least loss.
    """

    def __init__(self, objective: at.Objective, goal: at.Goal, evaluations: int) -> None:
        self.transducers = len(objective.scene.array)
        self.left = evaluations
        self.best, self._least = np.zeros(self.transducers), math.inf
        self._objective, self._goal = objective, goal

    def __call__(self, phases: Phases) -> Phases:
        """Observe drives of phases (B, M), B <= `left`: losses (B,)."""
        assert len(phases) <= self.left
        self.left -= len(phases)
        losses = -self._goal(self._objective(at.drive_from_phases(torch.from_numpy(phases)))).numpy()
        if losses.min() < self._least:
            self.best, self._least = phases[losses.argmin()].copy(), float(losses.min())
        return losses


Algorithm: TypeAlias = Callable[[Losses, int], Phases]
"""From losses and a seed to the phases (M,) that it recommends."""


def cma_es(losses: Losses, seed: int) -> Phases:
    """CMA-ES, as pycma has it (Hansen 2016)."""
    first = np.random.default_rng(seed).uniform(0, _TURN, losses.transducers)
    search = cma.CMAEvolutionStrategy(first, _STEP, {"seed": seed + 1, "verbose": -9})
    while losses.left >= search.popsize:
        phases = search.ask()
        search.tell(phases, losses(np.array(phases)).tolist())
    return search.result.xfavorite


def l_shade(losses: Losses, seed: int) -> Phases:
    """L-SHADE (Tanabe and Fukunaga 2014), on the circle, with the parameters of the paper.

    The first population is smaller than its 18 M where evaluations would last for fewer than 8 generations.
    """
    rng, budget, memory = np.random.default_rng(seed), losses.left, np.full((2, 6), 0.5)
    largest = max(8, min(18 * losses.transducers, budget // 8))
    population = rng.uniform(0, _TURN, (min(largest, budget), losses.transducers))
    loss, archive, slot = losses(population), np.empty((0, losses.transducers)), 0
    while losses.left:
        count = min(len(population), losses.left)
        row, chosen = np.arange(count), rng.integers(memory.shape[1], size=count)
        crossing = rng.normal(memory[0, chosen], 0.1).clip(0, 1)
        scale = memory[1, chosen] + 0.1 * rng.standard_cauchy(count)
        while (low := scale <= 0).any():
            scale[low] = memory[1, chosen[low]] + 0.1 * rng.standard_cauchy(low.sum())
        scale = scale.clip(max=1)[:, None]
        ranked = loss.argsort()
        leader = population[ranked[rng.integers(max(2, round(0.11 * len(population))), size=count)]]
        other = population[rng.integers(len(population), size=count)]
        pool = np.concatenate((population, archive))
        third = pool[rng.integers(len(pool), size=count)]
        here = population[:count]
        trial = here + scale * (leader - here + other - third)
        crossed = rng.uniform(size=trial.shape) < crossing[:, None]
        crossed[row, rng.integers(losses.transducers, size=count)] = True
        trial = np.where(crossed, trial, here) % _TURN
        new = losses(trial)
        better = new < loss[:count]
        if better.any():
            archive = np.concatenate((archive, here[better]))
            gain = (loss[:count] - new)[better]
            for kind, value in enumerate((crossing[better], scale[better, 0])):
                memory[kind, slot] = (gain @ value**2) / max(gain @ value, 1e-300)
            slot = (slot + 1) % memory.shape[1]
            population[:count][better], loss[:count][better] = trial[better], new[better]
        survivors = max(4, round(largest + (4 - largest) * (1 - losses.left / budget)))
        order = loss.argsort()[:survivors]
        population, loss = population[order], loss[order]
        archive = rng.permutation(archive)[: round(2.6 * survivors)]
    return population[loss.argmin()]


def spsa(losses: Losses, seed: int) -> Phases:
    """Simultaneous perturbation (Spall 1998), with gains by its rules: first step 0.3 rad for each phase."""
    rng, steps, change, pairs = np.random.default_rng(seed), losses.left // 2, 0.3, 4
    phases = rng.uniform(0, _TURN, losses.transducers)

    def slope(width: float) -> Phases:
        signs = rng.choice((-1.0, 1.0), losses.transducers)
        upper, lower = losses(phases + width * np.stack((signs, -signs)))
        return (upper - lower) / (2 * width) * signs

    stable = 0.1 * steps
    size = np.mean([np.abs(slope(change)).mean() for _ in range(min(pairs, steps))])
    gain = change * (1 + stable) ** 0.602 / max(size, 1e-300)
    for step in range(1, losses.left // 2 + 1):
        phases = phases - gain / (step + stable) ** 0.602 * slope(change / step**0.101)
    return phases


def coordinate_search(losses: Losses, seed: int) -> Phases:
    """Compass search (Kolda et al. 2003): one phase after another, in steps that shrink."""
    rng, step = np.random.default_rng(seed), _TURN / 3
    phases = rng.uniform(0, _TURN, losses.transducers)
    least = losses(phases[None])[0]
    while losses.left:
        before = least
        for place in rng.permutation(losses.transducers):
            for sign in (1, -1):
                if not losses.left:
                    break
                trial = phases.copy()
                trial[place] += sign * step
                if (loss := losses(trial[None])[0]) < least:
                    phases, least = trial, loss
                    break
        if least == before:
            step /= 2
    return phases


def tpe(losses: Losses, seed: int) -> Phases:
    """Tree-structured Parzen estimator, Optuna's default sampler (Bergstra et al. 2011)."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    spaces = {
        str(place): optuna.distributions.FloatDistribution(0, _TURN) for place in range(losses.transducers)
    }
    while losses.left:
        trial = study.ask(spaces)
        study.tell(trial, float(losses(np.array([list(trial.params.values())]))[0]))
    return np.array(list(study.best_params.values()))


def turbo(losses: Losses, seed: int) -> Phases:
    """Trust-region BO (Eriksson et al. 2019), TuRBO-1 with Thompson sampling as BoTorch's tutorial has it."""
    torch.manual_seed(seed)
    size, batch = losses.transducers, max(4, losses.left // 32)
    count = min(2 * size, losses.left // 2)
    double, most = {"dtype": torch.float64}, 0.5**7
    places = SobolEngine(size, scramble=True, seed=seed).draw(count, **double)
    scores = torch.from_numpy(-losses(_TURN * places.numpy()))
    length, good, bad = 0.8, 0, 0
    while losses.left and length >= most:
        train = (scores - scores.mean()) / scores.std()
        kernel = ScaleKernel(MaternKernel(2.5, ard_num_dims=size, lengthscale_constraint=Interval(0.005, 4)))
        likelihood = GaussianLikelihood(noise_constraint=Interval(1e-8, 1e-3))
        model = SingleTaskGP(places, train[:, None], likelihood=likelihood, covar_module=kernel)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit_gpytorch_mll(
                ExactMarginalLogLikelihood(model.likelihood, model),
                optimizer_kwargs={"options": {"maxiter": 30}},
            )
        weights = kernel.base_kernel.lengthscale.detach()[0]
        weights = weights / weights.log().mean().exp()
        best = places[scores.argmax()]
        lower, upper = (best - weights * length / 2).clamp(0, 1), (best + weights * length / 2).clamp(0, 1)
        candidates = lower + (upper - lower) * SobolEngine(size, scramble=True).draw(2000, **double)
        moved = torch.rand(candidates.shape) <= min(20 / size, 1)
        moved[torch.arange(len(moved)), torch.randint(size, (len(moved),))] = True
        candidates = torch.where(moved, candidates, best)
        with torch.no_grad():
            new = MaxPosteriorSampling(model, replacement=False)(candidates, min(batch, losses.left))
        values = torch.from_numpy(-losses(_TURN * new.numpy()))
        better = bool(values.max() > scores.max() + 1e-3 * scores.max().abs())
        good, bad = (good + 1, 0) if better else (0, bad + 1)
        if good == 10:
            length, good = min(2 * length, 1.6), 0
        elif bad == math.ceil(max(4 / batch, size / batch)):
            length, bad = length / 2, 0
        places, scores = torch.cat((places, new)), torch.cat((scores, values))
    return _TURN * places[scores.argmax()].numpy()


ALGORITHMS: dict[str, Algorithm] = {
    "CMA-ES": cma_es,
    "L-SHADE": l_shade,
    "SPSA": spsa,
    "coordinate search": coordinate_search,
    "TPE": tpe,
    "TuRBO": turbo,
}
