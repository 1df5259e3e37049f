"""Perturbations: quantisation, failed transducers, drift and noise around an objective."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest, rice
from small_scenes import small_scene

import autdtorch as at
from autdtorch.objectives.perturbations import Perturbation, quantised
from autdtorch.propagators import FreeSpacePropagator

SCENE = small_scene()  # 4 transducers, 3 control points

phases = st.lists(st.floats(-10, 10), min_size=4, max_size=4)
amplitudes = st.lists(st.just(0.0) | st.floats(1e-9, 1), min_size=4, max_size=4)


class Recorder:
    """An objective of 1 Pa everywhere that records the drives."""

    def __init__(self):
        self.scene = SCENE
        self.evaluations = 0
        self.drives = []

    def __call__(self, drive):
        self.evaluations += len(drive)
        self.drives.append(drive)
        return torch.ones(len(drive), 3, dtype=torch.float64)

    def played(self):
        return torch.cat(self.drives)


@pytest.fixture
def simulated():
    return at.SimulatedObjective(SCENE, FreeSpacePropagator(SCENE))


def random_drive(rows, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return at.drive_from_phases(6.28 * torch.rand(rows, 4, dtype=torch.float64, generator=generator))


def fully_on(rows):
    return torch.ones(rows, 4, dtype=torch.complex128)


@pytest.mark.parametrize("snr", [20.0, 6.0, 0.0, -10.0])
def test_readings_are_rice_distributed(snr):
    count = 20000
    noise = at.Noise(Recorder(), snr, seed=3, reference=1.0)
    readings = noise(fully_on(count))[:, 1].numpy()
    part = 10 ** (-snr / 20) / math.sqrt(2)  # deviation of the real and of the imaginary part
    expected = rice(1 / part, scale=part)
    # The seed is fixed. 4 standard errors, and the 0.1 % point of the Kolmogorov-Smirnov statistic.
    assert abs(readings.mean() - expected.mean()) < 4 * expected.std() / math.sqrt(count)
    assert kstest(readings, expected.cdf).statistic < 1.95 / math.sqrt(count)


def test_noise_at_control_points_and_rows_and_drift_are_independent():
    readings = at.Noise(Recorder(), 20, reference=1.0)(fully_on(20000))
    # Deviation of an estimated correlation: 1 / sqrt(samples); 4 of them.
    points = torch.corrcoef(readings.T) - torch.eye(3)
    rows = torch.corrcoef(torch.stack([readings[:-1, 0], readings[1:, 0]]))[0, 1]
    assert points.abs().max() < 4 / math.sqrt(20000)
    assert abs(rows) < 4 / math.sqrt(20000)
    recorder = Recorder()
    at.Drift(recorder, phase=1.0, seed=4)(fully_on(3000))
    steps = torch.diff(recorder.played()[:, 0].angle())
    readings = at.Noise(Recorder(), 40, seed=4, reference=1.0)(fully_on(3000))[1:, 0]
    # 4 / sqrt(samples), as above.
    assert abs(torch.corrcoef(torch.stack([steps, readings]))[0, 1]) < 4 / math.sqrt(3000)


def test_default_reference_is_the_rms_pressure_under_random_phases(simulated):
    sigma = at.Noise(at.Quantised(at.FailedTransducers(simulated, [0]), 4), snr=20).sigma
    squares = simulated(random_drive(20000)).square().mean(dim=1)
    # 4 standard errors of the mean square, halved by the root.
    error = 2 * (squares.std() / squares.mean()).item() / math.sqrt(20000)
    assert 10 * sigma == pytest.approx(squares.mean().sqrt().item(), rel=error)


def test_reference_must_be_given_where_nothing_tells_it(simulated):
    replayed = at.SimulatedObjective(SCENE, FreeSpacePropagator(SCENE), mode="replay")
    for objective in (replayed, Recorder(), at.FailedTransducers(replayed, [1])):
        with pytest.raises(ValueError, match="reference: None Pa; must be given where the objective has no"):
            at.Noise(objective, 20)
        assert at.Noise(objective, 20, reference=2.0).sigma == pytest.approx(0.2)


def test_reads_are_averaged_and_counted():
    recorder = Recorder()
    noise = at.Noise(recorder, 20, reads=25, reference=1.0)
    assert noise(fully_on(2000)).shape == (2000, 3)
    assert noise.evaluations == recorder.evaluations == 50000
    one, many = at.Noise(Recorder(), 20, reference=1.0)(fully_on(2000)), noise(fully_on(2000))
    # A deviation of n samples is known to 1 / sqrt(2 n): 4 of that, for each of the two.
    assert (one.std() / many.std()).item() == pytest.approx(5, rel=8 / math.sqrt(2 * 6000))


@pytest.mark.parametrize(
    "make",
    [
        lambda inner, seed: at.Noise(inner, 20, seed=seed, reference=1.0),
        lambda inner, seed: at.Noise(inner, 20, reads=3, seed=seed, reference=1.0),
        lambda inner, seed: at.Drift(inner, phase=0.3, loss=0.2, sensor=0.1, seed=seed),
    ],
    ids=["noise", "reads", "drift"],
)
def test_randomness_follows_from_the_seed_however_the_rows_are_divided(make, simulated):
    drive = random_drive(40)
    torch.manual_seed(1)
    state = torch.get_rng_state()
    together = make(simulated, 5)(drive)
    assert torch.equal(torch.get_rng_state(), state)
    objective = make(simulated, 5)
    divided = torch.cat([objective(part) for part in drive.split([1, 7, 32])])
    # A walk is summed up in other groups.
    torch.testing.assert_close(divided, together, rtol=1e-12, atol=0)
    assert not torch.allclose(make(simulated, 6)(drive), together)


NESTED = {
    "noise": lambda inner: at.Noise(inner, 20, reads=2, seed=5, reference=1.0),
    "drift": lambda inner: at.Drift(inner, phase=0.3, loss=0.2, sensor=0.1, seed=5),
    "quantised": lambda inner: at.Quantised(inner, 8),
    "failed": lambda inner: at.FailedTransducers(inner, [2]),
    "all": lambda inner: at.Noise(
        at.Quantised(at.Drift(at.FailedTransducers(inner, [2]), phase=0.3, seed=5), 8), 20, reference=1.0
    ),
}


@pytest.mark.parametrize("make", NESTED.values(), ids=NESTED)
@given(leading=st.lists(st.integers(1, 3), max_size=3))
def test_drives_of_any_leading_dimensions_are_those_in_a_row(make, leading):
    simulated = at.SimulatedObjective(SCENE, FreeSpacePropagator(SCENE))
    flat, shaped = make(simulated), make(simulated)
    drives = random_drive(math.prod(leading))
    for observe in (lambda one, drive: one(drive), at.true_pressure, lambda one, drive: one(drive)):
        expected = observe(flat, drives).reshape(*leading, 3)
        assert torch.equal(observe(shaped, drives.reshape(*leading, 4)), expected)
    assert shaped.evaluations == flat.evaluations


@pytest.mark.parametrize("make", NESTED.values(), ids=NESTED)
def test_a_problem_has_the_matrix_of_the_simulation_inside(make, simulated):
    assert torch.equal(at.Problem.of(make(simulated)).transfer_matrix, simulated.transfer_matrix)
    assert at.Problem.of(make(Recorder())).transfer_matrix is None


def test_an_objective_of_a_user_gets_batches():
    recorder = Recorder()
    wrapped = at.Noise(at.FailedTransducers(recorder, [2]), 20, reference=1.0)
    assert wrapped(random_drive(1)[0]).shape == at.true_pressure(wrapped, random_drive(1)[0]).shape == (3,)
    assert wrapped(random_drive(6).reshape(2, 3, 4)).shape == (2, 3, 3)
    assert [tuple(drives.shape) for drives in recorder.drives] == [(1, 4), (1, 4), (6, 4)]


@given(phases=phases, amplitudes=amplitudes, levels=st.integers(2, 256), on_off=st.booleans())
def test_quantised_is_the_nearest_and_stays(phases, amplitudes, levels, on_off):
    device = at.Quantised(Recorder(), levels, on_off)
    drive = at.drive_from_phases([phases], [amplitudes])
    played = device.emitted(drive)
    steps = at.phases_of(played) * levels / (2 * math.pi)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-9)
    sounding = (played != 0) & (drive != 0)
    assert ((played / drive)[sounding].angle().abs() <= math.pi / levels + 1e-12).all()
    expected = (drive.abs() >= 0.5).double() if on_off else drive.abs()
    torch.testing.assert_close(played.abs(), expected, rtol=1e-14, atol=0)
    torch.testing.assert_close(device.emitted(played), played, rtol=1e-12, atol=0)


def test_levels_that_are_the_devices_are_played_as_they_are(simulated):
    plain = at.gabs(simulated, levels=16, trials=3)
    device = at.gabs(at.Quantised(simulated, 32, on_off=True), levels=16, trials=3)
    # Phases that differ in their last digit only.
    torch.testing.assert_close(device.drive, plain.drive, rtol=0, atol=1e-14)
    torch.testing.assert_close(device.history, plain.history, rtol=1e-13, atol=0)


def test_failed_transducers_are_silent_and_nobody_is_told():
    recorder = Recorder()
    broken = at.FailedTransducers(recorder, [0, 2])
    drive = random_drive(3)
    broken(drive)
    assert torch.equal(recorder.played()[:, [0, 2]], torch.zeros(3, 2, dtype=torch.complex128))
    assert torch.equal(recorder.played()[:, [1, 3]], drive[:, [1, 3]])
    assert torch.equal(quantised(broken, drive), drive)


def test_drift_has_the_stated_rms_after_1000_evaluations():
    ends = []
    for seed in range(100):
        recorder = Recorder()
        readings = at.Drift(recorder, phase=0.2, loss=0.1, sensor=0.05, seed=seed)(fully_on(1000))
        ends.append((recorder.played()[-1], readings[-1]))
    drives, readings = (torch.stack(part) for part in zip(*ends, strict=True))
    # Deviations of 400 and of 100 samples, each known to 1 / sqrt(2 n); 4 of that.
    few, many = 4 / math.sqrt(200), 4 / math.sqrt(800)
    assert drives.angle().square().mean().sqrt().item() == pytest.approx(0.2, rel=many)
    assert drives.abs().log().square().mean().sqrt().item() == pytest.approx(0.1, rel=many)
    assert readings[:, 0].log().square().mean().sqrt().item() == pytest.approx(0.05, rel=few)
    assert torch.equal(readings[:, 0], readings[:, 1])
    assert (drives.abs() <= 1).all()


def test_true_pressure_keeps_the_device_and_drops_the_sensor(simulated):
    drift = at.Drift(at.FailedTransducers(simulated, [1]), phase=0.5, loss=0.2, sensor=0.5, seed=1)
    objective = at.Noise(at.Quantised(drift, 8), 10, reads=2, seed=1)
    drive = random_drive(50)
    objective(drive)
    counts = [objective.evaluations, drift.evaluations]
    emitted = drift.emitted(at.Quantised(Recorder(), 8).emitted(drive)) * torch.tensor([1.0, 0, 1, 1])
    true = at.true_pressure(objective, drive)
    # Other roundings of the same factors.
    torch.testing.assert_close(true, simulated(emitted), rtol=1e-12, atol=0)
    assert [objective.evaluations, drift.evaluations] == counts == [100, 100]
    assert torch.equal(at.true_pressure(simulated, drive), simulated(drive))
    assert not torch.allclose(true, simulated(drive), rtol=1e-2)


@pytest.mark.parametrize(
    "make",
    [
        lambda inner: inner,
        Perturbation,
        lambda inner: at.Noise(inner, 20, reads=2),
        lambda inner: at.Quantised(inner, 4),
        lambda inner: at.FailedTransducers(inner, [0]),
        lambda inner: at.Drift(inner, phase=0.1),
    ],
    ids=["objective", "none", "noise", "quantised", "failed", "drift"],
)
def test_a_drive_that_no_array_can_play_is_refused_and_not_counted(make, simulated):
    objective = make(simulated)
    good = random_drive(2)
    for wrong in (good[:, :3], good[:0], 2 * good, good.real, torch.nan * good):
        with pytest.raises(ValueError, match="drive"):
            objective(wrong)
        with pytest.raises(ValueError, match="drive"):
            at.true_pressure(objective, wrong)
    assert objective.evaluations == simulated.evaluations == 0
    assert objective.scene is SCENE


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda o: at.Noise(o, 20, reads=0), "reads: 0; must be an integer >= 1"),
        (lambda o: at.Noise(o, 20, seed=-1), "seed: -1; must be an integer >= 0"),
        (lambda o: at.Noise(o, 20, reference=0.0), r"reference: 0\.0 Pa; must be finite and > 0"),
        (lambda o: at.Quantised(o, 1), "levels: 1; must be an integer >= 2"),
        (lambda o: at.FailedTransducers(o, []), r"transducers: \(\); must be indices from 0 to 3, each once"),
        (lambda o: at.FailedTransducers(o, [4]), r"transducers: \(4,\); must be indices from 0 to 3"),
        (lambda o: at.FailedTransducers(o, [-1]), r"transducers\[0\]: -1; must be an integer >= 0"),
        (lambda o: at.FailedTransducers(o, 2), "transducers: 2; must be indices"),
        (lambda o: at.Drift(o, phase=-0.1), r"phase: -0\.1 rad; must be finite and >= 0"),
    ],
)
def test_bad_arguments_are_named(make, message, simulated):
    with pytest.raises(ValueError, match=message):
        make(simulated)
