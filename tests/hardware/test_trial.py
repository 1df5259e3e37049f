"""Trials on the emulated bench, against the simulation, and how they end."""

import json
from functools import partial

import pytest
import torch
from faulty_bus import Disturbed

from autdtorch import hardware as hw
from autdtorch.methods.functions import gabs, identify, lssg
from autdtorch.methods.gabs import GABS
from autdtorch.methods.run import run
from autdtorch.objectives.goals import MeanPressure, TargetPressures
from autdtorch.objectives.perturbations import (
    Drift,
    FailedTransducers,
    Noise,
    Perturbation,
    Quantised,
    random_rms,
)
from autdtorch.objectives.scenarios import Scenarios
from autdtorch.scene.drive import drive_from_phases

FULL = torch.ones(16, dtype=torch.complex128)


@pytest.mark.parametrize(
    ("device", "method", "amplitude"),
    [
        (hw.SONICSURFACE, partial(gabs, levels=8), 1.0),
        (hw.OPENMPD, partial(identify, evaluations=64), 0.7),
        (hw.ultraino_boards(3), lssg, 0.8),
    ],
    ids=["SonicSurface", "OpenMPD", "Ultraino"],
)
def test_without_noise_a_method_finds_the_same_drive_as_in_simulation(trial, device, method, amplitude):
    with trial.limited(device, amplitude=amplitude) as (bench, link):
        measured = trial.objective(link, hw.EmulatedSensor(bench))
        solution = method(measured)
        link.play(solution.drive[0])
        full = bench.drive().abs().max()
        torch.testing.assert_close(bench.drive(), full * solution.drive[0], rtol=0, atol=1e-12)
    played = trial.played(device, amplitude)
    expected = method(played)
    assert torch.equal(solution.drive, expected.drive)
    # The same products, summed in another order.
    torch.testing.assert_close(solution.pressure, full * expected.pressure, rtol=1e-12, atol=0)
    assert measured.evaluations == played.evaluations == int(solution.evaluations)

    lines = [json.loads(line) for line in trial.log.read_text().splitlines()[1:]]
    assert len(lines) == measured.evaluations
    asked = torch.view_as_complex(torch.tensor([line["drive"] for line in lines], dtype=torch.float64))
    pressure = torch.tensor([line["pressure"] for line in lines], dtype=torch.float64)
    torch.testing.assert_close(full * played(asked), pressure, rtol=1e-12, atol=1e-12)


def test_a_drive_in_any_guise_is_measured_and_comes_back_from_the_log(trial):
    phases = torch.linspace(-3, 3, 16)
    drive = torch.polar(torch.ones(16), phases)
    guises = [drive, drive.conj(), drive.cdouble().requires_grad_(), torch.stack([drive, drive]).T[:, 1]]
    with trial.limited() as (bench, link):
        objective = trial.objective(link, hw.EmulatedSensor(bench))
        measured = torch.stack([objective(one) for one in guises])
        again = trial.objective(link, hw.EmulatedSensor(bench))
        assert torch.equal(torch.stack([again(one) for one in guises]), measured)
    expected = trial.played()(torch.stack([drive, drive.conj(), drive, drive]))
    torch.testing.assert_close(measured, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("leading", [(), (1,), (2, 3)])
def test_drives_of_any_leading_dimensions_are_played_in_a_row(trial, leading):
    phases = 7 * torch.rand(*leading, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drives = drive_from_phases(phases)
    with trial.limited() as (bench, link):
        objective = trial.objective(link, hw.EmulatedSensor(bench))
        measured = objective(drives)
        asked = torch.stack([evaluation.drive for evaluation in objective.log.evaluations])
        assert torch.equal(asked, drives.reshape(-1, 16))
        assert objective.evaluations == len(asked)
    played = trial.played()
    torch.testing.assert_close(measured, played(drives), rtol=1e-12, atol=0)
    assert played.evaluations == len(asked)


@pytest.mark.parametrize(
    ("perturbed", "readings"),
    [
        (lambda objective: FailedTransducers(Quantised(objective, levels=8), [3]), 1),
        (lambda objective: Drift(objective, phase=0.1, sensor=0.1), 1),
        (lambda objective: Noise(objective, snr=20.0, reads=2, reference=10.0), 2),
    ],
    ids=["drive", "drift", "noise"],
)
def test_a_trial_of_a_perturbed_objective_goes_on_where_its_log_ends(trial, perturbed, readings):
    def stop(number: int) -> None:
        if number == 7:
            raise KeyboardInterrupt

    def measure(disturb=int):
        with trial.limited() as (bench, link):
            sensor = Disturbed(bench, disturb)
            return gabs(perturbed(trial.objective(link, sensor)), levels=2), sensor.readings

    with pytest.raises(KeyboardInterrupt):
        measure(stop)
    continued, made = measure()
    assert made == readings * (1 + 15 * 2) - 6
    trial.log = trial.log.with_name("uninterrupted.jsonl")
    assert torch.equal(continued.history, measure()[0].history)


def test_a_perturbation_of_another_kind_may_have_reads_of_its_own(trial):
    class Reading(Perturbation):
        reads = "a column of a file"

    with trial.limited() as (bench, link):
        objective = Reading(trial.objective(link, hw.EmulatedSensor(bench)))
        assert int(gabs(objective, levels=2).evaluations) == 1 + 15 * 2


def test_a_state_file_goes_on_in_a_block_that_continues_the_log(trial, tmp_path):
    def measure(stop=None):
        with trial.limited() as (bench, link):
            objective = trial.objective(link, hw.EmulatedSensor(bench))
            with objective.continued():
                run(GABS(levels=2), objective, stop=stop, state_file=tmp_path / "state.npz")
            return objective.evaluations

    assert measure(lambda state: state.evaluations > 4) < measure() == 1 + 15 * 2


def test_a_state_file_of_noisy_readings_goes_on_after_all_readings_of_a_drive(trial, tmp_path):
    def measure(stop=None):
        with trial.limited() as (bench, link):
            objective = trial.objective(link, hw.EmulatedSensor(bench))
            noisy = Noise(objective, snr=20.0, reads=2, reference=10.0)
            run(GABS(levels=2), noisy, stop=stop, state_file=tmp_path / "state.npz")
            return objective.evaluations

    assert measure(lambda state: state.evaluations > 4) == 2 * 5
    assert measure() == 2 * (1 + 15 * 2)


def test_scenarios_of_measured_scenes_go_on_where_their_logs_end(trial):
    def measure(stop=None):
        with trial.limited() as (bench, link):
            sensor = Disturbed(bench, int)
            objectives = []
            for name in ("near", "far"):
                trial.log = trial.log.with_name(f"{name}.jsonl")
                objectives.append(Noise(trial.objective(link, sensor), snr=20.0, reads=2, reference=10.0))
            solution = run(GABS(levels=2), Scenarios(objectives), stop=stop)
            return int(solution.evaluations), sensor.readings

    evaluations, before = measure(lambda state: state.evaluations > 4)
    assert (evaluations, before) == (5, 2 * 2 * 5)
    assert measure() == (1 + 15 * 2, 2 * 2 * (1 + 15 * 2) - before)


def test_an_evaluation_is_logged_before_the_next_is_played(trial):
    lines: list[int] = []
    with trial.limited() as (bench, link):
        sensor = Disturbed(bench, lambda _: lines.append(trial.log.read_bytes().count(b"\n")))
        trial.objective(link, sensor)(FULL.expand(3, -1))
    assert lines == [1, 2, 3]  # the first says what the trial is


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit])
def test_the_outputs_are_off_before_and_after_however_it_ends(trial, error: type[BaseException]):
    bench = trial.bench()
    assert bench.firmware.drive().abs().min() > 0.9  # the device starts with all transducers on
    with pytest.raises(error), trial.link(bench) as link:  # noqa: PT012
        assert bench.firmware.drive().abs().max() == 0
        link.play(FULL)
        assert bench.drive().abs().min() > 0.9
        raise error
    assert bench.firmware.drive().abs().max() == 0


@pytest.mark.parametrize(
    "device", [hw.SONICSURFACE, hw.OPENMPD, hw.ultraino_boards(3)], ids=lambda device: device.name
)
@pytest.mark.parametrize("sent", [1, 100, 257])
def test_the_outputs_are_off_after_a_frame_that_broke_off(trial, device: hw.Device, sent: int):
    bench = trial.bench(device)
    with trial.link(bench, device) as link:
        link.play(FULL)
        bench.chip.write(device.frame(torch.ones(device.transducers, dtype=torch.complex128))[:sent])
    assert bench.firmware.drive().abs().max() == 0
    if device is hw.SONICSURFACE:
        bench.chip.write(b"\xfd")  # swaps the two patterns
        assert bench.firmware.drive().abs().max() == 0


@pytest.mark.parametrize("snr", [None, 30.0])
def test_the_check_finds_the_failed_transducers(trial, snr):
    read: list[str] = []
    with trial.limited(failed=[3, 9]) as (bench, link):
        sensor = hw.EmulatedSensor(bench, snr)
        check = hw.check_transducers(link, sensor, points=2, watch=read.append)
        assert check.failed == [3, 9]
        with pytest.warns(DeprecationWarning, match="now Preflight.failed"):
            assert check.dead == [3, 9]
        assert read == ["silence, outputs off", *(f"transducer {n} of 16" for n in range(1, 17))]
        assert bench.firmware.drive().abs().max() == 0
        assert hw.hears_silence(sensor, check, points=2)
        link.play(FULL)
        assert not hw.hears_silence(sensor, check, points=2)


@pytest.mark.parametrize("count", [2**62, 10_001, 0])
def test_numbers_of_readings_are_such_as_end(trial, count):
    with trial.limited() as (bench, link):
        for name in ("readings", "background"):
            with pytest.raises(ValueError, match=name):
                hw.check_transducers(link, hw.EmulatedSensor(bench), 2, **{name: count})
        assert link.seconds_on == 0


def test_a_transducer_20_db_below_the_others_has_failed_where_silence_is_read_as_0(trial):
    class Leaking(hw.EmulatedSensor):
        leak = 0.0

        def read(self):
            return super().read() + self.leak * float(bench.firmware.drive().abs().max())

    typical = float(trial.simulated.transfer_matrix.abs().median())
    with trial.limited(failed=[3]) as (bench, link):
        sensor = Leaking(bench)
        for share, failed in ((0.05, [3]), (0.2, [])):  # of the amplitude; 20 dB are 0.1
            sensor.leak = share * typical
            check = hw.check_transducers(link, sensor, points=2)
            assert (check.silence, check.failed) == (0, failed)


def test_the_sensor_reads_with_the_noise_of_its_snr(trial):
    with trial.limited() as (bench, link):
        sensor = hw.EmulatedSensor(bench, snr=10.0)
        variance = random_rms(bench.transfer_matrix) ** 2 / 10
        for drive in (FULL, 0 * FULL):
            link.play(drive)
            power = torch.stack([sensor.read() for _ in range(1000)]).square()
            expected = bench.pressure().abs().square() + variance  # E|p + n|^2
            # Five standard errors of the mean.
            assert ((power.mean(dim=0) - expected).abs() < 5 * power.std(dim=0) / 1000**0.5).all()


def test_links_matrices_and_settings_of_another_trial_are_refused(trial):
    bench = trial.bench()
    sensor, link_of = hw.EmulatedSensor(bench), partial(hw.open_link, hw.SONICSURFACE, backend=bench.bus)
    with link_of(torch.tensor([5, 3])) as link:
        assert link.transducers.tolist() == [5, 3]
    with link_of() as link, pytest.raises(ValueError, match="must be 16"):
        trial.objective(link, sensor)
    with trial.link(bench) as link:
        with pytest.raises(ValueError, match="no trial without an amplitude limit"):
            hw.HardwareObjective(trial.scene, link, sensor, trial.log)
        objective = partial(
            hw.HardwareObjective, trial.scene, hw.LimitedLink(link, hw.Limits(1.0)), sensor, trial.log
        )
        with pytest.raises(ValueError, match=r"transfer_matrix: shape \(16, 2\); must be \(2, 16\)"):
            objective(transfer_matrix=trial.simulated.transfer_matrix.T)
        sensor.quantity = hw.Quantity("force", "mN")
        with pytest.raises(ValueError, match=r"transfer_matrix: .* None with a sensor of force"):
            objective(transfer_matrix=trial.simulated.transfer_matrix)
        assert objective().transfer_matrix is None
        del sensor.quantity
        for settings in ({1}, {"gain": torch.ones(1)}):
            with pytest.raises(ValueError, match=r"settings: .* what JSON can hold"):
                objective(settings)
    with pytest.raises(ValueError, match="from 0 to 255, each once"):
        link_of([3, 3])
    assert bench.firmware.drive().abs().max() == 0


def test_a_goal_of_pressures_is_refused_where_the_sensor_reads_forces(trial):
    class Balance(hw.EmulatedSensor):
        quantity = hw.Quantity("force", "mN")

    with trial.limited() as (bench, link):
        objective = trial.objective(link, Balance(bench))
        for goal in (TargetPressures((100.0, 200.0)), MeanPressure()):
            with pytest.raises(ValueError, match=f"goal: '{goal.name}'; must not be of pressures"):
                gabs(objective, levels=2, goal=goal)
        assert objective.evaluations == 0
        gabs(objective, levels=2, goal=lambda force: force.amax(dim=-1))
