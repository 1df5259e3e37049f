"""One trial of Bayesian optimisation: its observations, and the next phases to observe.

Phases are in turns here, 0 to 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.methods.bayes.acquisition import largest
from autdtorch.methods.bayes.process import Process

_REFIT_GROWTH = 1.1  # Growth of the number of observations after which the hyperparameters are fitted again.
_CANDIDATES = 128  # Points at which the acquisition function is compared before it is climbed.


@dataclass(frozen=True)
class Settings:
    """The settings of all trials.

    Attributes:
        dimensions: number of phases D.
        evaluations: of a trial.
        initial: evaluations before the search.
        log: whether the logarithm of the expected improvement is climbed.
        circle: whether the kernel measures distances between points on the circle.
        sobol: whether the initial points are a scrambled Sobol sequence.
        noise: variance of the observations in variances of the process; None to fit it.
    """

    dimensions: int
    evaluations: int
    initial: int
    log: bool
    circle: bool
    sobol: bool
    noise: float | None


class BayesTrial:
    """A trial, independent of all others."""

    def __init__(self, settings: Settings, seed: int) -> None:
        """A trial that has observed nothing; `seed` is for its random choices."""
        self._settings = settings
        self._seed = seed
        self._generator = torch.Generator("cpu").manual_seed(seed)
        self._process = Process(settings.dimensions, settings.evaluations, settings.circle, settings.noise)
        self._next_fit = settings.initial
        self._best_score = -math.inf

    @property
    def count(self) -> int:
        """Number of observations so far."""
        return self._process.count

    def initial_points(self) -> torch.Tensor:
        """Points (initial, D) all over the space."""
        initial, dimensions = self._settings.initial, self._settings.dimensions
        if not self._settings.sobol:
            return self._uniform(initial, dimensions)
        sequence = torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=self._seed)  # type: ignore[no-untyped-call]
        points = sequence.draw(initial, dtype=torch.float64)
        points[0] = sequence.shift.double() / 2**sequence.MAXBIT  # the engine rounds it to PyTorch's default
        return points

    def next_point(self, points: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
        """The next point (D,), after the scores (B,) of points (B, D) have been observed."""
        self._process.add(points.numpy(), scores.numpy())
        if scores.max() > self._best_score:
            self._best_score = float(scores.max())
            self._best_point = points[scores.argmax()]
        if self._process.count >= self._next_fit:
            self._process.fit()
            self._next_fit = math.ceil(_REFIT_GROWTH * self._process.count)
        candidates = self._candidates()
        if self._settings.circle:
            lower, upper = np.full((2, self._settings.dimensions), [[-np.inf], [np.inf]])
        else:
            candidates.clamp_(0, 1)
            lower, upper = np.full((2, self._settings.dimensions), [[0.0], [1.0]])
        point = largest(self._process.posterior(), self._settings.log, candidates.numpy(), lower, upper)
        return torch.from_numpy(point % 1 if self._settings.circle else point)

    def _candidates(self) -> torch.Tensor:
        """Points (_CANDIDATES, D): half of them anywhere, half at all distances around the best point."""
        anywhere, near = self._uniform(2, _CANDIDATES // 2, len(self._best_point))
        # Normally distributed steps; their lengths are spread evenly in logarithm, from 0.001 to 0.3.
        scale = 10 ** (-3 + 2.5 * self._uniform(len(near), 1))
        steps = scale * torch.randn(near.shape, dtype=torch.float64, generator=self._generator, device="cpu")
        return torch.cat([anywhere, self._best_point + steps])

    def _uniform(self, *shape: int) -> torch.Tensor:
        """Random numbers in [0, 1)."""
        return torch.rand(shape, dtype=torch.float64, generator=self._generator, device="cpu")
