"""Sensors that switch the sound on and off themselves, within the limits of a trial."""

import time

import pytest
import torch

import autdtorch as at
from autdtorch import hardware as hw

FULL = torch.ones(16, dtype=torch.complex128)


class Heat:
    """A sensor of pulses, with the outputs off before and after each."""

    def __init__(self, bench: hw.EmulatedBench, during=lambda: None):
        self._bench, self._during, self.pulses = bench, during, 0

    def read_pulse(self, on, off):
        assert not self._bench.drive().any()
        on()
        pressure = self._bench.pressure().abs()
        self._during()
        off()
        assert not self._bench.drive().any()
        self.pulses += 1
        return pressure


def wait_until_off(bench: hw.EmulatedBench) -> None:
    while bench.drive().any():
        time.sleep(1e-3)


def test_a_pulse_is_read_for_each_evaluation_as_a_steady_sound_is(trial):
    drives = torch.stack([FULL, 1j * FULL, 0.5 * FULL])
    with trial.limited() as (bench, link):
        sensor = Heat(bench)
        measured = trial.objective(link, sensor)(drives)
        assert sensor.pulses == 3
        assert torch.equal(link.measure(FULL, sensor, 2, readings=2), measured[[0, 0]])
    with trial.limited() as (bench, link):
        trial.log.unlink()
        assert torch.equal(trial.objective(link, hw.EmulatedSensor(bench))(drives), measured)
        assert torch.equal(link.measure(FULL, hw.EmulatedSensor(bench), 2)[0], measured[0])
        assert bench.drive().any()  # and plays on


def test_pulses_count_against_the_limits_and_rest_for_the_duty_cycle(trial, clock):
    with trial.limited(seconds_in_a_row=10, duty_cycle=0.2, seconds=3) as (bench, link):
        sensor = Heat(bench, lambda: clock.sleep(0.5))
        ends = []
        for _ in range(6):
            link.measure(FULL, sensor, 2)
            ends.append(clock.now)
        with pytest.raises(hw.LimitError, match="on for 3 s, the limit"):
            link.measure(FULL, sensor, 2)
        assert link.seconds_on == pytest.approx(3)
        assert sensor.pulses == 6
        # The rest comes before the frames of the background, not between these and the pulse.
        assert ends == pytest.approx([0.5 + 2.5 * n for n in range(6)])


def test_a_pulse_that_lasts_too_long_is_void(trial):
    with trial.limited(seconds_in_a_row=0.05) as (bench, link):
        sensor = Heat(bench, lambda: wait_until_off(bench))
        with pytest.raises(hw.LimitError, match=r"longer than .* 0\.05 s in a row"):
            trial.objective(link, sensor)(FULL)
        assert not bench.drive().any()
        assert not sensor.pulses


@pytest.mark.parametrize("error", [hw.SensorError, KeyboardInterrupt])
def test_the_outputs_are_off_after_a_pulse_that_failed(trial, error):
    def fail():
        raise error

    with trial.limited() as (bench, link):
        with pytest.raises(error):
            link.measure(FULL, Heat(bench, fail), 2)
        assert not bench.firmware.drive().any()
        with pytest.raises(ValueError, match="amplitude 2"):
            link.measure(2 * FULL, Heat(bench), 2)
        with pytest.raises(ValueError, match="sensor"):
            link.measure(FULL, object(), 2)


def test_a_first_picture_takes_the_place_of_the_check_by_single_transducers(trial):
    class Noisy(Heat):
        noise = 1.0

        def read_pulse(self, on, off):
            return super().read_pulse(on, off) + self.noise

    with trial.limited() as (bench, link):
        sensor = Noisy(bench)
        strongest = float(trial.simulated(FULL).max())
        sensor.noise = 0.01 * strongest
        check = hw.check_picture(link, sensor, 2, FULL)
        assert check.failed == []
        assert check.silence == pytest.approx(sensor.noise)
        assert hw.hears_silence(sensor, check, 2)
        sensor.noise = 0.2 * strongest  # of outputs that are on, or of a leak
        assert not hw.hears_silence(sensor, check, 2)
        sensor.noise = 2 * strongest
        with pytest.raises(hw.SensorError, match="the largest reading of a drive is"):
            hw.check_picture(link, sensor, 2, FULL)


def test_a_trial_goes_on_with_the_deviations_of_its_log(trial):
    prior = at.Prior(trial.simulated.transfer_matrix, gain=0.3, phase=1.0)
    drives = []
    for share in (0.01, 3.0):  # as a camera that is less sure after an interruption
        with trial.limited(failed=[3]) as (bench, link):
            sensor = Heat(bench)
            sensor.deviation = lambda pressure, share=share: share * (pressure + pressure.mean())
            objective = trial.objective(link, sensor)
            drives.append(at.identify(objective, evaluations=6, prior=prior).drive)
    assert torch.equal(*drives)


def test_a_first_picture_must_be_above_the_deviation_that_a_sensor_states(trial):
    with trial.limited() as (bench, link):
        sensor = Heat(bench)  # without noise: it reads silence as 0
        peak = float(link.measure(FULL, sensor, 2).max())
        sensor.deviation = lambda pressure: torch.full_like(pressure, 0.3 * peak)
        assert hw.check_picture(link, sensor, 2, FULL).threshold > 0.3 * peak
        sensor.deviation = lambda pressure: torch.full_like(pressure, peak)
        with pytest.raises(hw.SensorError, match="largest reading of a drive"):
            hw.check_picture(link, sensor, 2, FULL)


def test_a_pulse_that_its_sensor_does_not_end_is_void_if_the_time_was_up(trial):
    class Endless(Heat):
        def read_pulse(self, on, off):
            return super().read_pulse(on, self._bench.drive)

    def sensor(bench, during):
        sensor = Endless(bench, during)
        sensor._bench = type("Bench", (), {"drive": lambda: torch.zeros(1), "pressure": bench.pressure})
        return sensor

    with trial.limited() as (bench, link):
        assert link.measure(FULL, sensor(bench, lambda: None), 2).shape == (1, 2)
        assert not bench.drive().any()
    with trial.limited(seconds_in_a_row=0.05) as (bench, link), pytest.raises(hw.LimitError):
        link.measure(FULL, sensor(bench, lambda: wait_until_off(bench)), 2)
