"""Readings of many points by a camera: deviations, points that are only seen, and methods that use them."""

from dataclasses import replace

import pytest
import torch

import autdtorch as at
from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.gradient import random_drives
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior

FOCI, PLACES, TRANSDUCERS = 3, 24, 12
SEEN = at.SeenPoints(at.WeakestFocus(), range(FOCI, FOCI + PLACES))
CLOSE = at.Prior(gain=0.1, phase=0.5, rest=0.01)


def generator(seed):
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def bench(make_objective, random_matrix):
    """A simulated matrix of foci and places, and a camera before the measured one; a focus has 0.5 Pa."""
    simulated = random_matrix(FOCI + PLACES, TRANSDUCERS, 0) / TRANSDUCERS
    draws = torch.randn(2, TRANSDUCERS, dtype=torch.float64, generator=generator(1))
    measured = simulated * torch.polar((0.1 * draws[0]).exp(), 0.5 * draws[1])
    return simulated, measured, at.CameraNoise(make_objective(measured), floor=0.1, seed=2)


def readings_of(camera, count, seed=3):
    drives = random_drives(count, TRANSDUCERS, generator(seed))
    pressure = camera(drives)
    return at.Readings(drives, pressure, deviation=camera.deviation(pressure))


def test_noise_is_that_of_squares(make_objective, random_matrix):
    objective = make_objective(random_matrix(2, 4, 0))
    drive = torch.ones(4, dtype=torch.complex128)
    exact = objective(drive).square()
    for relative, floor in ((0.01, 0.0), (1e-6, 0.1)):
        camera = at.CameraNoise(objective, relative, floor)
        square = camera(drive.expand(5_000, 4)).square()
        expected = torch.hypot(2 * relative * exact, torch.full_like(exact, floor**2))
        torch.testing.assert_close(square.mean(dim=0), exact, rtol=0, atol=5 * float(expected.max()) / 70)
        torch.testing.assert_close(square.std(dim=0), expected, rtol=0.03, atol=0)  # 3 sigma of 5000
        root = exact.sqrt()
        torch.testing.assert_close((root + camera.deviation(root)).square() - exact, expected)


def test_derivatives_are_those_of_weighted_squares(random_matrix):
    rows, drives = random_matrix(2, 4, 0), random_drives(6, 4, generator(3))
    widths = torch.tensor([0.1] * 4 + [0.5] * 4 + [1.0, 0.8, 1.0], dtype=torch.float64)
    prior = MatrixPrior(rows, torch.tensor([0.1, 0.2], dtype=torch.float64), widths, 0.1 * rows[None])
    value = (drives @ rows.T).abs() * 1.1
    deviation = 0.1 + 0.2 * value
    phase = torch.full_like(value, torch.nan)
    phase[:3] = (drives @ rows.T).angle()[:3]
    plain = torch.zeros_like(value, dtype=torch.bool)
    for read in (
        Magnitudes(value, plain, deviation=deviation),
        Magnitudes(value / 1.1, plain, phase=phase, deviation=deviation),  # linear at the phasor alone
    ):
        here = MatrixPosterior.start(prior, read)
        line = here.linearised(drives, read)
        factors = torch.randn(len(widths), dtype=torch.float64, generator=generator(4))
        entries = torch.randn(2, 4, dtype=torch.complex128, generator=generator(5))
        step = 1e-6
        there = replace(here, factors=step * widths * factors, entries=step * entries)
        change = -(there.linearised(drives, read).left - line.left) / step
        torch.testing.assert_close(line.change(factors, entries), change, rtol=1e-4, atol=1e-4)
        products = line.by_factors() @ factors
        torch.testing.assert_close(line.change(factors, 0 * entries), products.mT)
    # a reading off by its deviation, upwards, counts as much as any other
    upwards = Magnitudes(value + 0.0, plain, deviation=deviation)
    exact = MatrixPosterior.start(replace(prior, rows=torch.zeros_like(rows)), upwards)
    left = exact.linearised(drives, upwards).left / upwards.stated
    torch.testing.assert_close(left, value.square() / ((value + deviation).square() - value.square()))


def test_calibration_weighs_pictures_by_their_deviations(bench):
    simulated, measured, camera = bench
    error = {"weighed": [], "alike": []}
    for seed in range(2):
        readings = readings_of(camera, 24, seed)
        for name, each in (("weighed", readings), ("alike", replace(readings, deviation=None))):
            fit = at.calibrate(simulated, each, CLOSE, folds=0)
            factor = (fit.transfer_matrix / measured).mean(dim=0)
            error[name].append((factor / factor.mean() - 1).abs().square().mean().sqrt())
    weighed, alike = (float(torch.stack(each).mean()) for each in error.values())
    assert weighed < 0.9 * alike
    assert weighed < 0.03


def test_stated_intervals_hold_at_pictures_held_back(bench):
    simulated, _, camera = bench
    fit = at.calibrate(simulated, readings_of(camera, 20), CLOSE)
    assert fit.held_back.coverage > 0.9
    assert fit.held_back.error < fit.held_back.before
    assert fit.noise == pytest.approx(float(fit.fit.read.stated), rel=0.15)


def test_files_keep_deviations(bench, tmp_path):
    readings = readings_of(bench[2], 3)
    at.save_readings(tmp_path / "pictures.npz", readings)
    torch.testing.assert_close(at.load_readings(tmp_path / "pictures.npz").deviation, readings.deviation)
    with pytest.raises(ValueError, match=r"must be \.npz"):
        at.save_readings(tmp_path / "pictures.csv", readings)


METHODS = [
    at.Identify(6, CLOSE),
    at.BayesOpt(6, model="foci", kernel="phasor", noise="inferred", prior=CLOSE),
]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_methods_learn_from_points_that_are_only_seen(bench, make_objective, method):
    simulated, measured, _ = bench
    best = float(at.gradient_ascent(measured[:FOCI]).score[0])

    def share(matrix, points):
        observed = at.CameraNoise(make_objective(matrix[:points]), floor=0.1, seed=2)
        prior = replace(CLOSE, transfer_matrix=simulated[:points])
        goal = SEEN if points > FOCI else at.WeakestFocus()
        solution = at.run(replace(method, prior=prior), observed, goal=goal, seed=0)
        return float((solution.drive[0] @ measured[:FOCI].T).abs().min()) / best

    by_picture = share(measured, FOCI + PLACES)
    assert by_picture > 0.95
    assert by_picture > share(measured, FOCI)


def test_deviations_of_next_to_nothing_count_as_rounding(bench):
    simulated, measured, _ = bench
    drives = random_drives(40, TRANSDUCERS, generator(5))
    exact = (drives @ measured.T).abs()
    readings = at.Readings(drives, exact, deviation=torch.full_like(exact, 1e-12))
    predicted = at.calibrate(simulated, readings, CLOSE, folds=0).predict(drives).pressure
    torch.testing.assert_close(predicted, exact, rtol=1e-4, atol=1e-4)
