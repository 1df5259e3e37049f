"""Trends of the gain of a bench: told with their size, and no reason to keep an old drive."""

import logging
from dataclasses import replace

import noisy_bench
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as some

import autdtorch as at
from autdtorch.methods.gain_trend import step_doubts, trend_of_fit
from autdtorch.objectives.perturbations import Noise, Perturbation


class Falling(Perturbation):
    """A bench whose gain becomes `ratio` times as large every 60 evaluations."""

    def __init__(self, objective, ratio):
        super().__init__(objective)
        self.ratio = ratio

    def _observe(self, drive):
        number = self.evaluations + torch.arange(len(drive))
        return self.inner(drive) * (self.ratio ** (number / 60))[:, None]


def noisy(objective, ratio, seed):
    return Noise(Falling(objective, ratio), snr=30, seed=seed)


def fitted_trend(change, noise, count, seed, shared=0.0):
    """Trend of a calibration to readings whose ln gain changes, with an error that all points share."""
    matrix = at.make_propagator(noisy_bench.scene(4), method="free_space").transfer_matrix()
    bench = noisy_bench.Bench(matrix, seed, noise=noise)
    drives = bench.drives(count)
    gain = change * torch.linspace(-0.5, 0.5, count, dtype=torch.float64)
    gain = (gain + shared * torch.randn(count, dtype=torch.float64, generator=bench.draws)).exp()
    readings = at.Readings(drives, (bench.pressure(drives) * gain[:, None]).abs())
    fit = at.calibrate(matrix, readings, folds=0).fit
    return trend_of_fit(fit.posterior, drives, fit.read)


@given(
    change=some.floats(-0.3, 0.3),
    noise=some.floats(0.01, 0.1),
    count=some.integers(30, 100),
    seed=some.integers(0, 2**20),
)
def test_the_trend_is_within_its_deviation(change, noise, count, seed):
    trend = fitted_trend(change, noise, count, seed)
    # Five deviations of Student's t are passed once in 20,000 fits. A second-order term of the trend, of
    # which the scale of the fit has a part, adds up to change^2.
    assert abs(trend.change - change) < 5 * trend.deviation + change**2
    assert trend.deviation < 0.06  # or no drift would be found: 0.1 * sqrt(12 / (2 * 30 * 4)) and the fit's


@pytest.mark.parametrize("seed", range(2))
def test_a_drift_of_15_percent_is_told_and_errors_of_single_drives_are_not(seed):
    drifting = fitted_trend(-0.15, 0.03, 60, seed)
    assert drifting.is_seen
    (text,) = drifting.doubts()
    assert "the readings fall by 1" in text
    assert not fitted_trend(0.0, 0.03, 60, seed, shared=0.1).is_seen


def test_identify_tells_of_a_drift(make_objective, random_matrix, caplog):
    objective = make_objective(random_matrix(3, 8, 0))
    for fall, told in ((0.7, True), (1.0, False)):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            at.identify(noisy(objective, fall, 1))
        assert ("the readings fall by" in caplog.text) is told


def test_gabs_loses_little_by_a_gain_that_falls(make_objective, random_matrix, caplog):
    # The first drives read highest then, though few transducers are on.
    objective = make_objective(random_matrix(3, 12, 0))

    def reached(fall):
        solutions = [at.gabs(noisy(objective, fall, seed), seed=seed) for seed in range(4)]
        return sum(float(objective(solution.drive).amin()) for solution in solutions) / len(solutions)

    steady = reached(1.0)
    assert "the readings" not in caplog.text
    # Noise of 3 % is 24 % at an eighth of the gain. Without the trend, solutions reach 46 %.
    assert reached(0.5) > 0.85 * steady
    assert "the readings fall by" in caplog.text


def test_a_drift_is_told_of_the_trial_that_shows_it(make_objective, random_matrix):
    state = at.GABS(passes=2).start(at.Problem.of(make_objective(random_matrix(3, 5, 0))), trials=3)
    sums = torch.tensor([[-0.02, 1.0, 1e-4, 11.0, 0.0]], dtype=torch.float64)  # ln gain: -0.02 +- 0.0032
    going_on = {"trials": torch.tensor([2]), "search": {"trend": sums, "drifting": torch.tensor([1])}}
    *others, (text,) = step_doubts(replace(state, **going_on))  # two trials have ended
    assert others == [(), ()]
    assert text.startswith("the readings fall by 70 +- 6 % in 60 readings")  # 0.30 of the gain, +- 19 % of it


class Spikes(Perturbation):
    """A sensor that reads 5 times too much once in 100 readings."""

    def _observe(self, drive):
        pressure = self.inner(drive)
        number = self.evaluations * pressure.shape[1] + torch.arange(pressure.numel()).reshape(pressure.shape)
        return pressure.where(number * 37 % 100 > 0, 5 * pressure)


@pytest.mark.parametrize("bench", [lambda steady: steady, Spikes])
@pytest.mark.parametrize("levels", [4, 16])
def test_steady_trials_keep_the_best_reading(make_objective, random_matrix, bench, levels):
    objective = bench(noisy(make_objective(random_matrix(4, 16, 0)), 1.0, 0))
    method, problem = at.GABS(levels, passes=2), at.Problem.of(objective)
    state = method.start(problem, trials=20)
    while not state.done:
        state = method.tell(state, objective(method.ask(state)))
        assert not state.search.get("drifting", torch.zeros(1)).any()
    assert torch.equal(method.best(state).score, state.best.history.amax(dim=1))
