import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.gradient import random_drives
from autdtorch.methods.matrix_fit import posteriors
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior
from autdtorch.objectives.perturbations import Noise

FOCI = {"model": "foci", "kernel": "phasor", "noise": "inferred"}


def generator(seed):
    return torch.Generator().manual_seed(seed)


def deviating(matrix, seed, gain=0.1, phase=0.5):
    """The matrix (P, M) of transducers whose gains and phases deviate."""
    draws = torch.randn(2, matrix.shape[1], dtype=torch.float64, generator=generator(seed))
    return matrix * torch.polar((gain * draws[0]).exp(), phase * draws[1])


def exact(magnitudes):
    """Readings (N, P) none of which is a lower limit."""
    return Magnitudes(magnitudes, torch.zeros_like(magnitudes, dtype=torch.bool))


@pytest.fixture
def prior(random_matrix):
    rows = random_matrix(2, 4, 0)
    widths = torch.tensor([0.1] * 4 + [0.5] * 4 + [1.0, 0.8, 1.0], dtype=torch.float64)
    changes = 0.1 * random_matrix(2, 4, 1)[None]
    return MatrixPrior(rows, torch.tensor([0.1, 0.2], dtype=torch.float64), widths, changes)


def somewhere(prior, seed):
    """A posterior whose factors and entries are not 0."""
    factors = 0.3 * torch.randn(len(prior.widths), dtype=torch.float64, generator=generator(seed))
    entries = torch.randn(prior.rows.shape, dtype=torch.complex128, generator=generator(seed + 1))
    return MatrixPosterior(prior, factors, entries, torch.full((2,), 1e-4, dtype=torch.float64))


@pytest.mark.parametrize("with_factors", [False, True])
def test_derivatives_are_those_of_the_magnitudes(prior, with_factors):
    if not with_factors:
        prior = MatrixPrior(prior.rows, prior.spread, prior.widths[:0], prior.changes[:0])
    here, drives = somewhere(prior, 1), random_drives(6, 4, generator(3))
    factors = here.factors.clone().requires_grad_(True)
    entries = here.entries.clone().requires_grad_(True)
    there = MatrixPosterior(prior, factors, entries, here.variance)
    magnitudes = (drives @ there.matrix.T).abs()
    line = here.linearised(drives, exact(magnitudes.detach()))
    for index in range(magnitudes.numel()):
        by = torch.autograd.grad(
            magnitudes.flatten()[index], (factors, entries), retain_graph=True, allow_unused=True
        )
        place = tuple(divmod(index, 2))
        if with_factors:
            torch.testing.assert_close(line.by_factors()[place[::-1]], by[0] * prior.widths)
        by_parts = torch.view_as_real(by[1][place[1]]).T.flatten()
        torch.testing.assert_close(2**0.5 * line.by_entries[place[::-1]], by_parts)


def slopes(posterior, drives):
    """Derivatives (N P, K) of magnitudes by factors, and by real and imaginary parts of all entries."""
    line = posterior.linearised(drives, exact((drives @ posterior.matrix.T).abs()))
    by_parts = torch.zeros(*line.left.shape, *posterior.entries.shape, 2, dtype=torch.float64)
    for focus, entries in enumerate(2**0.5 * line.by_entries):
        by_parts[:, focus, focus] = entries.reshape(len(drives), 2, -1).mT
    by_factors = line.by_factors().transpose(0, 1) / posterior.prior.widths
    return torch.cat([by_factors, by_parts.flatten(2)], dim=-1).flatten(0, 1)


def test_samples_have_the_covariance_that_readings_leave(prior):
    # A thousandth of the widths, so that magnitudes are linear.
    small = MatrixPrior(prior.rows, 1e-3 * prior.spread, 1e-3 * prior.widths, prior.changes)
    here = MatrixPosterior(
        small, 0 * small.widths, 0 * small.rows, torch.full((2,), 1e-6, dtype=torch.float64)
    )
    read, others = random_drives(3, 4, generator(3)), random_drives(2, 4, generator(4))
    variance = torch.cat([small.widths.square(), torch.full((16,), 0.5, dtype=torch.float64)])
    known, wanted = slopes(here, read), slopes(here, others)
    explained = wanted * variance @ known.T
    of_readings = known * variance @ known.T + 1e-6 * torch.eye(6, dtype=torch.float64)
    expected = wanted * variance @ wanted.T - explained @ torch.linalg.solve(of_readings, explained.T)
    draws = generator(5)
    readings = exact((read @ here.matrix.T).abs())
    samples = here.samples(read, readings, draws, 3000)
    sampled = (others @ samples.mT).abs().flatten(1).T.cov()
    # Of 3000 samples, the standard error of an entry is at most 0.03 of the largest variance.
    assert (sampled - expected).abs().max() < 0.13 * expected.diagonal().max()
    # Readings leave little of some directions, and most of others.
    assert expected.diagonal().max() < 0.9 * (wanted * variance @ wanted.T).diagonal().max()


def test_samples_have_the_magnitudes_of_readings_that_determine_a_row(random_matrix):
    """Also where the common phase of a row, which no reading shows, is drawn at random."""
    matrix, drives = random_matrix(2, 5, 0), random_drives(60, 5, generator(1))
    observed = (drives @ matrix.T).abs()
    (fit,) = posteriors(None, {}, drives[None], observed[None], [generator(2)])
    (sample,) = fit.posterior.samples(drives, fit.read, generator(3), 1)
    # The noise, assumed from few readings, is half a per cent.
    torch.testing.assert_close((drives @ sample.T).abs(), observed, rtol=0.02, atol=0.03)


@settings(deadline=None, max_examples=4)
@given(st.integers(0, 10**6), st.booleans(), st.floats(0.002, 0.01))
def test_errors_of_entries_are_found_in_noise_below_them(seed, with_phase, level):
    draws = generator(seed)

    def noise(*shape):
        return torch.randn(*shape, dtype=torch.complex128, generator=draws)

    simulated = noise(2, 8)
    matrix = torch.polar(1 + 0.1 * noise(8).real, 0.5 * noise(8).real) * simulated + 0.01 * noise(2, 8)
    level *= float(matrix.norm()) / 2**0.5  # relative to the rms pressure
    drives, others = random_drives(120, 8, draws), random_drives(200, 8, draws)
    pressure = drives @ matrix.T + level * noise(120, 2)
    phase = pressure.angle() if with_phase else None
    readings = at.Readings(drives, pressure.abs(), phase=phase)
    prediction = at.calibrate(simulated, readings, at.Prior(rest=0.01), folds=0).predict(others)
    off = prediction.pressure - (others @ matrix.T).abs()
    # 240 readings of at most 50 unknowns leave sqrt(50 / 240) = 0.46 of a magnitude's noise, level / sqrt(2).
    assert off.square().mean().sqrt() < 1.5 * 0.46 * level / 2**0.5
    # Predictions share few unknowns: over 800 draws, the mean square varies as the mean of 13 would around
    # 0.7. It exceeds 4 in less than one draw of a million; 1.5^2 was exceeded in one of the 800.
    assert (off / prediction.deviation).square().mean() < 4


@pytest.mark.parametrize("count", [1, 2, 8])
def test_few_readings_leave_the_noise_as_unsure_as_it_is(count):
    """A matrix that is known, and noise as the prior has it: the usual variance as if by four readings."""
    row, empty = torch.ones(1, 1).cdouble(), torch.empty(0).double()
    known = MatrixPrior(row, torch.tensor([1e-9]).double(), empty, torch.empty(0, 1, 1).cdouble())
    draws = generator(count)
    normal = partial(torch.randn, 300, dtype=torch.float64, generator=draws)
    level = (known.usual_variance / torch.stack([normal() for _ in range(4)]).square().mean(dim=0)).sqrt()
    drives, inside = torch.ones(count, 1).cdouble(), []
    for noise in level:
        read = 1 + noise * torch.randn(count + 50, 1, dtype=torch.float64, generator=draws)
        fit = MatrixPosterior.start(known, exact(read[:count])).fitted(drives, exact(read[:count]))
        inside.append(((read[count:] - 1).abs() < 1.96 * fit.variance.sqrt()).double().mean())
    # Student's distribution gives 0.945 to 0.950, and 300 levels of noise leave 0.006. The likeliest noise
    # would hold 0.89 of the readings, or 0.93 after eight.
    assert torch.stack(inside).mean() == pytest.approx(0.95, abs=0.02)


def test_a_simulation_is_corrected_by_few_readings(make_objective, random_matrix):
    """Fewer readings than unknowns of one row, which without a prior would determine nothing."""
    simulated = random_matrix(3, 12, 2)
    objective = make_objective(deviating(simulated, 2))
    best = at.gradient_ascent(objective).score
    uncorrected = at.gradient_ascent(make_objective(simulated))
    options = {"evaluations": 14, "prior": at.Prior(simulated), "seed": 2}
    fitted = at.identify(Noise(objective, 30, seed=2), **options)
    foci = at.bayes_opt(Noise(objective, 30, seed=2), **options, **FOCI)
    shares = [float(objective(one.drive).amin() / best) for one in (uncorrected, fitted, foci)]
    # Measured: 0.84, 0.990 and 0.995.
    assert shares[0] < 0.88
    assert min(shares[1:]) > 0.95


def test_the_amount_of_a_variant_is_identified(make_objective, random_matrix):
    """One unknown, the amount of the change, explains what would be errors of all entries."""
    simulated, variant = random_matrix(2, 10, 2), random_matrix(2, 10, 3)
    objective = make_objective(simulated - 0.7 * (variant - simulated))
    best = at.gradient_ascent(objective).score
    plain, knowing = (
        at.identify(objective, 8, prior=at.Prior(simulated, variants, gain=1e-3, phase=1e-3, rest=0.01)).score
        for variants in (None, variant[None])
    )
    assert plain < 0.9 * best
    assert knowing > 0.99 * best


@pytest.mark.parametrize(
    ("method", "factor"), [(at.identify, 1e-4), (partial(at.bayes_opt, fixed_transducer=0, **FOCI), 1e4)]
)
def test_a_sensor_in_other_units_costs_nothing(make_objective, random_matrix, method, factor):
    simulated = random_matrix(3, 8, 2)
    objective = make_objective(factor * deviating(simulated, 1))
    best = at.gradient_ascent(objective).score
    assert method(objective, evaluations=12, prior=at.Prior(simulated)).score > 0.97 * best


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gain": 0}, "gain: 0; must be"),
        ({"gain": 1e6}, "gain: 1e\\+06|gain: 1000000"),
        ({"phase": math.nan}, "phase: nan"),
        ({"rest": -1}, "rest: -1; must be"),
        ({"variants": torch.ones(3, dtype=torch.complex128)}, r"variants: shape \(3,\)"),
        ({"transfer_matrix": torch.ones(3, dtype=torch.complex128)}, r"transfer_matrix: shape \(3,\)"),
    ],
)
def test_a_prior_out_of_range_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        at.Prior(**settings)


@pytest.mark.parametrize("method", [at.identify, partial(at.bayes_opt, fixed_transducer=0, **FOCI)])
def test_a_prior_of_another_problem_is_refused(make_objective, random_matrix, method):
    objective = make_objective(random_matrix(3, 5, 0))
    with pytest.raises(ValueError, match=r"prior.transfer_matrix: shape \(3, 4\); must be \(3, 5\)"):
        method(objective, prior=at.Prior(random_matrix(3, 4, 0)))
    with pytest.raises(ValueError, match=r"prior.variants: shape \(1, 3, 4\); must be \(K, 3, 5\)"):
        method(objective, prior=at.Prior(random_matrix(3, 5, 0), random_matrix(3, 4, 1)[None]))
    named = at.Prior(random_matrix(3, 5, 0), {"temperature": 5.0})
    with pytest.raises(ValueError, match=r"prior.variants: .*calibrate takes names"):  # before any reading
        at.Identify(prior=named).start(at.Problem.of(objective))
    with pytest.raises(ValueError, match=r"prior\.transfer_matrix: 0; must not be 0 throughout"):
        method(objective, prior=at.Prior(0 * random_matrix(3, 5, 0)))
    with pytest.raises(ValueError, match="prior: 'simulated'; must be a Prior"):
        method(objective, prior="simulated")
