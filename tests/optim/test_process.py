"""The Gaussian process and its acquisition functions, against BoTorch's and against finite differences."""

import math

import numpy as np
import pytest
import torch

from autdtorch.methods.bayes.acquisition import _climb, _value, expected_improvement, largest, posterior
from autdtorch.methods.bayes.acquisition import log_expected_improvement as log_ei
from autdtorch.methods.bayes.process import Process, features_of

CIRCLE = pytest.mark.parametrize("circle", [False, True], ids=["phases", "circle"])
DIMENSIONS = 4
ROUNDING = {"rtol": 0, "atol": 1e-9}
"""Of values up to 1: the condition of the matrix, up to N / noise or 2e5, times a few 1e-16."""


def smooth(points):
    return np.cos(2 * math.pi * points).sum(axis=1) * (1 + points[:, 0])


def filled(circle, points=24, noise=1e-4, seed=0):
    """A process that got its points before, between and after fits."""
    at = np.random.default_rng(seed).random((points, DIMENSIONS))
    process = Process(DIMENSIONS, points + 5, circle, noise)
    process.add(at[:10], smooth(at[:10]))
    process.fit()
    process.add(at[10:], smooth(at[10:]))
    return process, at


def oracle(process, points):
    """BoTorch's process of the same points, scores and hyperparameters."""
    from botorch.models import SingleTaskGP
    from botorch.settings import validate_input_scaling
    from gpytorch.kernels import MaternKernel, ScaleKernel
    from gpytorch.means import ZeroMean

    scores = torch.from_numpy(smooth(points))
    standard = ((scores - scores.mean()) / scores.std())[:, None]
    kernel = ScaleKernel(MaternKernel(nu=2.5)).double()
    variance = process.posterior().scale ** 2
    kernel.outputscale = torch.tensor(variance, dtype=torch.float64)
    kernel.base_kernel.lengthscale = torch.tensor(process.length_scale, dtype=torch.float64)
    with validate_input_scaling(False):
        return SingleTaskGP(
            features(points, process.circle),
            standard,
            train_Yvar=torch.full_like(standard, variance * process.noise),
            covar_module=kernel,
            mean_module=ZeroMean(),
            outcome_transform=None,
        )


def features(points, circle):
    return torch.from_numpy(np.stack([features_of(point, circle) for point in points]))


@CIRCLE
def test_posterior_and_likelihood_are_botorchs(circle):
    from gpytorch.mlls import ExactMarginalLogLikelihood

    process, points = filled(circle)
    model = oracle(process, points)
    # gpytorch divides by the number of points.
    likelihood = ExactMarginalLogLikelihood(model.likelihood, model)(
        model(*model.train_inputs), model.train_targets
    )
    assert process.log_likelihood() == pytest.approx(likelihood.item() * len(points), rel=1e-8)

    # More than the block of candidates, and not a multiple of it; some of them known.
    there = np.concatenate([np.random.default_rng(1).random((70, DIMENSIONS)), points[:5]])
    expected = model.eval().posterior(features(there, circle))
    mean, deviation = posterior(process.posterior(), there)
    torch.testing.assert_close(torch.from_numpy(mean), expected.mean[:, 0].detach(), **ROUNDING)
    torch.testing.assert_close(torch.from_numpy(deviation**2), expected.variance[:, 0].detach(), **ROUNDING)


@CIRCLE
def test_fit_is_as_likely_as_botorchs(circle):
    from botorch import fit_gpytorch_mll
    from gpytorch.mlls import ExactMarginalLogLikelihood

    process, points = filled(circle)
    model = oracle(process, points)
    process.fit()
    fitted = ExactMarginalLogLikelihood(model.likelihood, model)
    fit_gpytorch_mll(fitted)
    ours = process.log_likelihood()
    process.length_scale = model.covar_module.base_kernel.lengthscale.item()
    # The likelihood is flat within the last step of the search, 2 % of the length scale.
    assert ours > process.log_likelihood() - 0.02


def test_inferred_noise_is_that_of_the_scores():
    generator = np.random.default_rng(2)
    points = generator.random((150, DIMENSIONS))
    scores = smooth(points) + 0.3 * generator.standard_normal(150)
    process = Process(DIMENSIONS, 150, True, None)
    process.add(points, scores)
    process.fit()
    # 150 points alone would tell a variance to 12 %; the function in 4 dimensions takes most of them.
    assert 0.5 < process.posterior().scale ** 2 * process.noise / (0.3**2 / scores.var()) < 2


@CIRCLE
def test_points_added_one_by_one_are_as_if_fitted_together(circle):
    process, points = filled(circle)
    before = process.posterior()
    together = Process(DIMENSIONS, 29, circle, 1e-4)
    together.length_scale = process.length_scale
    together.add(points, smooth(points))
    torch.testing.assert_close(before.weights[:24], together.posterior().weights[:24], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("u", [5.0, 0.0, -1.0, -3.0, -9.9, -10.1, -30.0, -1e3, -1e6])
def test_expected_improvement_is_botorchs(u):
    from botorch.acquisition.analytic import _ei_helper, _log_ei_helper

    at = torch.tensor(u, dtype=torch.float64)
    deviation = 0.3
    value, by_mean, by_deviation = log_ei(u * deviation, deviation, 0.0)
    assert value == pytest.approx(math.log(deviation) + _log_ei_helper(at).item(), rel=1e-10)
    plain = expected_improvement(u * deviation, deviation, 0.0)
    assert plain[0] == pytest.approx(deviation * _ei_helper(at).item(), rel=1e-10, abs=1e-300)
    if plain[0] > 0:
        assert by_mean == pytest.approx(plain[1] / plain[0], rel=1e-8)
        assert by_deviation == pytest.approx(plain[2] / plain[0], rel=1e-8)


@CIRCLE
@pytest.mark.parametrize("log", [False, True], ids=["ei", "log_ei"])
def test_gradient_of_the_acquisition(circle, log):
    process, _ = filled(circle)
    known = process.posterior()
    point = np.random.default_rng(3).random(DIMENSIONS)
    gradient, room = np.empty(DIMENSIONS), tuple(np.empty((4, known.size)))
    _value(known, log, point, gradient, room)
    for d in range(DIMENSIONS):
        step = 1e-5 * np.eye(DIMENSIONS)[d]
        up, down = (_value(known, log, point + sign * step, np.empty(DIMENSIONS), room) for sign in (1, -1))
        # Third derivatives times 1e-10, and rounding of 1e-12 over 1e-5.
        assert gradient[d] == pytest.approx((up - down) / 2e-5, rel=1e-5, abs=1e-6)


def test_climb_ends_no_lower_than_botorchs():
    from botorch.acquisition.analytic import LogExpectedImprovement
    from botorch.optim.optimize import optimize_acqf

    ours, theirs = [], []
    for seed in range(6):
        process, points = filled(False, seed=seed)
        known = process.posterior()
        acquisition = LogExpectedImprovement(oracle(process, points).eval(), best_f=known.best)
        start = np.random.default_rng(seed + 10).random(DIMENSIONS)
        point, value = _climb(known, True, start, np.zeros(DIMENSIONS), np.ones(DIMENSIONS))
        found = acquisition(torch.from_numpy(point)[None]).item()
        assert value == pytest.approx(found, rel=1e-6)
        _, best = optimize_acqf(
            acquisition,
            bounds=torch.tensor([[0.0], [1.0]]).double().expand(2, DIMENSIONS),
            q=1,
            num_restarts=1,
            batch_initial_conditions=torch.from_numpy(start)[None, None],
            options={"maxiter": 20},
        )
        ours.append(value)
        theirs.append(best.item())
    # Each may end on another hill; on the whole ours are as high.
    assert np.median(np.subtract(ours, theirs)) > -0.05


@CIRCLE
def test_the_largest_is_within_bounds_and_not_below_any_candidate(circle):
    process, _ = filled(circle)
    known = process.posterior()
    candidates = 0.4 + 0.2 * np.random.default_rng(4).random((50, DIMENSIONS))
    lower, upper = np.full((2, DIMENSIONS), [[0.4], [0.6]])
    point = largest(known, True, candidates, lower, upper)
    assert ((point >= lower) & (point <= upper)).all()
    (value, *values) = (
        log_ei(mean, deviation, known.best)[0]
        for mean, deviation in zip(*posterior(known, np.vstack([point[None], candidates])), strict=True)
    )
    assert value >= max(values)


def test_the_circle_is_periodic():
    process, points = filled(True)
    mean, deviation = posterior(process.posterior(), points)
    turned = posterior(process.posterior(), points + 1)
    np.testing.assert_allclose(mean, turned[0], atol=1e-10)
    np.testing.assert_allclose(deviation, turned[1], atol=1e-6)  # the root of a variance near 0


def test_a_process_that_forgets_is_as_new():
    process, points = filled(True)
    process.forget()
    process.add(points[:8], smooth(points[:8]))
    new = Process(DIMENSIONS, 29, True, 1e-4)
    new.add(points[:8], smooth(points[:8]))
    assert np.array_equal(process.posterior().weights[:8], new.posterior().weights[:8])
