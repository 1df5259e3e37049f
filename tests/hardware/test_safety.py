"""Limits of a trial."""

import time
import weakref

import pytest
import torch

from autdtorch.hardware import (
    OPENMPD,
    SONICSURFACE,
    EmulatedSensor,
    HardwareObjective,
    LimitedLink,
    LimitError,
    Limits,
    LinkError,
    check_transducers,
    hears_silence,
    open_link,
)
from autdtorch.methods.driver import observed


def full_on(rows: int = 1) -> torch.Tensor:
    return torch.ones(rows, 16, dtype=torch.complex128)


@pytest.mark.parametrize("limit", [1.0, 0.9, 0.5, 0.03])
def test_no_transducer_is_driven_above_the_limit(trial, limit: float):
    bench = trial.bench(OPENMPD)
    with trial.link(bench, OPENMPD) as link:
        LimitedLink(link, Limits(amplitude=limit)).play(full_on()[0])
        amplitudes = bench.drive().abs()
        assert amplitudes.max() <= limit * (1 + 1e-9)
        # A step of the duty is at most pi / 128 of the amplitude, and one of the candidates 1 / 256.
        assert amplitudes.min() >= limit - 0.03


def test_a_device_without_amplitude_plays_in_full_or_not_at_all(trial):
    with trial.link(trial.bench()) as link:
        LimitedLink(link, Limits(amplitude=1.0))
        with pytest.raises(ValueError, match=r"amplitude: 0\.9; must be >= 1, .* SonicSurface"):
            LimitedLink(link, Limits(amplitude=0.9))


@pytest.mark.parametrize(
    ("name", "value"),
    [("amplitude", 0), ("amplitude", 1.1), ("evaluations", 0), ("seconds", 0), ("duty_cycle", float("nan"))],
)
def test_limits_that_are_none_are_refused(name: str, value: float):
    with pytest.raises(ValueError, match=name):
        Limits(**{"amplitude": 1.0, name: value})
    with pytest.raises(TypeError, match="amplitude"):
        Limits()


def test_the_number_of_evaluations_is_limited_over_all_of_a_trial(trial):
    def observe(rows: int, most: int) -> None:
        bench = trial.bench()
        with trial.link(bench) as link:
            limited = LimitedLink(link, Limits(1.0, evaluations=most))
            objective = HardwareObjective(trial.scene, limited, EmulatedSensor(bench), trial.log)
            observed(objective, full_on(rows), 0)

    observe(3, most=3)
    with pytest.raises(LimitError, match="4 evaluations are made, the limit"):
        observe(5, most=4)
    observe(5, most=5)


def test_the_outputs_rest_as_the_duty_cycle_asks(trial):
    bench = trial.bench()
    sensor = EmulatedSensor(bench)
    begin = time.monotonic()
    with trial.link(bench) as link:
        limited = LimitedLink(link, Limits(1.0, seconds_in_a_row=0.02, duty_cycle=0.25))
        while limited.seconds_on < 0.05:
            limited.play(full_on()[0])
            sensor.read()
            time.sleep(0.002)
            limited.require_on()
        # The last stretch has not rested yet; it is shorter than what is allowed in a row.
        assert time.monotonic() - begin >= (limited.seconds_on - 0.02) / 0.25


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Limits(1.0, seconds_in_a_row=0.02), r"longer than .* 0\.02 s in a row"),
        (Limits(1.0, seconds=0.02), r"the outputs were on for 0\.02 s, the limit"),
    ],
)
def test_while_a_sensor_takes_too_long_the_outputs_go_off(trial, limits: Limits, message: str):
    class Slow(EmulatedSensor):
        def read(self):
            time.sleep(0.2)
            heard.append(float(bench.drive().abs().max()))
            return super().read()

    heard: list[float] = []
    bench = trial.bench()
    with trial.link(bench) as link:
        objective = HardwareObjective(trial.scene, LimitedLink(link, limits), Slow(bench), trial.log)
        with pytest.raises(LimitError, match=message):
            objective(full_on())
        assert heard == [0.0]
        assert not objective.log.evaluations


def test_while_the_sound_settles_the_timer_may_switch_off(trial):
    def sleep(seconds: float) -> None:
        if seconds == 0.2:
            time.sleep(seconds)
            heard.append(float(bench.drive().abs().max()))

    heard: list[float] = []
    bench = trial.bench()
    bench.bus.sleep = sleep
    with open_link(SONICSURFACE, range(16), backend=bench.bus, settle=0.2) as link:
        limited = LimitedLink(link, Limits(1.0, seconds_in_a_row=0.02))
        limited.play(full_on()[0])
        assert heard == [0.0]
        with pytest.raises(LimitError, match="settling and reading took longer"):
            limited.require_on()


def test_a_timer_of_an_earlier_link_does_not_reach_the_next(trial):
    bench = trial.bench()
    with trial.link(bench) as link:
        limited = LimitedLink(link, Limits(1.0, seconds_in_a_row=0.05))
        limited.play(full_on()[0])
    with trial.link(bench) as link:
        link.play(full_on()[0])
        limited._timer.join()
        assert bench.drive().abs().min() > 0.9
    with pytest.raises(LinkError, match="SonicSurface is closed"):
        link.play(full_on()[0])
    assert bench.firmware.drive().abs().max() == 0


@pytest.mark.parametrize("error", [LinkError("stuck"), RuntimeError("stuck")])
def test_a_timer_that_cannot_switch_off_says_so_at_once_and_ends_the_trial(trial, error, monkeypatch, caplog):
    class Asleep(EmulatedSensor):
        def read(self):
            limited._timer.join()
            told.append("the time is up, but: stuck" in caplog.text)
            return super().read()

    def fail() -> None:
        raise error

    told: list[bool] = []
    bench = trial.bench()
    with trial.link(bench) as link:
        limited = LimitedLink(link, Limits(1.0, seconds_in_a_row=0.02))
        objective = HardwareObjective(trial.scene, limited, Asleep(bench), trial.log)
        monkeypatch.setattr(link, "off", fail)
        with pytest.raises(type(error), match="stuck"):
            objective(full_on())
        monkeypatch.undo()
    assert told == [True]
    assert not objective.log.evaluations
    assert bench.firmware.drive().abs().max() == 0


def test_a_timer_that_comes_too_late_leaves_the_next_stretch_alone(trial):
    bench = trial.bench()
    with trial.link(bench) as link:
        limited = LimitedLink(link, Limits(1.0))
        limited.play(full_on()[0])
        late = limited._timer
        assert late.daemon  # for another Python would wait before it exits and switches off
        limited.off()
        limited.play(full_on()[0])
        late.function()  # it had waited for the lock
        limited.require_on()
        assert bench.drive().abs().min() > 0.9


def test_an_error_of_the_sensor_leaves_the_outputs_off_on_an_open_link(trial):
    class Broken(EmulatedSensor):
        def read(self):
            if bench.drive().abs().max() > 0:
                raise OSError("gone")
            return super().read()

    bench = trial.bench()
    with trial.link(bench) as link:
        with pytest.raises(OSError, match="gone"):
            trial.objective(link, Broken(bench))(full_on())
        assert bench.firmware.drive().abs().max() == 0
        with pytest.raises(OSError, match="gone"):
            check_transducers(LimitedLink(link, Limits(1.0)), Broken(bench), points=2)
        assert bench.firmware.drive().abs().max() == 0


def test_a_link_left_open_is_switched_off_when_python_exits(trial, monkeypatch):
    at_exit: list[object] = []
    monkeypatch.setattr("atexit.register", at_exit.append)
    bench = trial.bench()
    link = trial.link(bench)
    link.play(full_on()[0])
    (close,) = at_exit
    close()
    assert bench.firmware.drive().abs().max() == 0


def test_a_closed_link_is_not_kept_until_python_exits(trial):
    link = trial.link(trial.bench())
    kept = weakref.ref(link)
    link.close()
    del link
    assert kept() is None


def test_the_time_on_goes_on_with_the_trial(trial):
    bench = trial.bench()
    with trial.link(bench) as link:
        trial.objective(link, EmulatedSensor(bench)).log.append(full_on()[0], torch.ones(2), 60.0)
        limited = LimitedLink(link, Limits(1.0, seconds=60.0))  # a test does not take that long
        objective = HardwareObjective(trial.scene, limited, EmulatedSensor(bench), trial.log)
        with pytest.raises(LimitError, match="on for 60 s, the limit"):
            observed(objective, full_on(2), 0)  # one is in the log
        assert limited.seconds_on == 60.0


def test_what_an_earlier_process_played_besides_counts_and_is_rested_from(trial):
    bench = trial.bench()
    sensor = EmulatedSensor(bench)
    with trial.link(bench) as link:
        limited = LimitedLink(link, Limits(1.0))
        log = HardwareObjective(trial.scene, limited, sensor, trial.log).log
        check_transducers(limited, sensor, points=2)
        log.end(limited.seconds_on)
        before = limited.seconds_on
        again = LimitedLink(link, Limits(1.0, seconds_in_a_row=0.05, duty_cycle=0.25))
        begin = time.monotonic()
        objective = HardwareObjective(trial.scene, again, sensor, trial.log)
        assert again.seconds_on == before > 0
        objective(full_on())
        assert time.monotonic() - begin >= 0.05 * (1 / 0.25 - 1)
        assert objective.log.seconds_on > before
        # Nor does a second objective on the same link count anything twice.
        once = again.seconds_on
        HardwareObjective(trial.scene, again, sensor, trial.log)
        assert again.seconds_on == once


def test_a_chip_that_keeps_the_off_frame_is_told_of(trial, monkeypatch):
    monkeypatch.setattr("autdtorch.hardware.transport.serial_chips._FLUSH_SECONDS", 0.0)
    bench = trial.bench()
    link = trial.link(bench)
    bench.chip.answer = lambda kind, request: b"\x01\x20"  # room for more, but not all is sent
    with pytest.raises(LinkError, match="outputs may still be on"):
        link.close()


def test_a_chip_without_line_status_is_told_of(trial):
    bench = trial.bench()
    link = trial.link(bench)
    bench.chip.answer = lambda kind, request: b""
    with pytest.raises(LinkError, match="no line status; is it an FT232R"):
        link.close()


@pytest.mark.parametrize("snr", [None, 30.0])
def test_the_check_finds_the_dead_transducers(trial, snr):
    bench = trial.bench(dead=[3, 9])
    sensor = EmulatedSensor(bench, snr)
    read: list[str] = []
    with trial.link(bench) as link:
        check = check_transducers(LimitedLink(link, Limits(1.0)), sensor, points=2, watch=read.append)
        assert check.dead == [3, 9]
        assert read == ["silence, outputs off", *(f"transducer {n} of 16" for n in range(1, 17))]
        assert bench.firmware.drive().abs().max() == 0
        assert hears_silence(sensor, check, points=2)
        link.play(full_on()[0])
        assert not hears_silence(sensor, check, points=2)


def test_what_is_20_db_below_the_others_is_dead_where_silence_is_read_as_0(trial):
    class Leaking(EmulatedSensor):
        leak = 0.0

        def read(self):
            return super().read() + self.leak * float(bench.firmware.drive().abs().max())

    bench = trial.bench(dead=[3])
    sensor = Leaking(bench)
    typical = float(trial.simulated.transfer_matrix.abs().median())
    with trial.link(bench) as link:
        limited = LimitedLink(link, Limits(1.0))
        for share, dead in ((0.05, [3]), (0.2, [])):  # of the amplitude; 20 dB are 0.1
            sensor.leak = share * typical
            check = check_transducers(limited, sensor, points=2)
            assert check.silence == 0
            assert check.dead == dead


def test_a_check_during_which_the_outputs_went_off_is_none(trial):
    class Slow(EmulatedSensor):
        def read(self):
            time.sleep(0.05)
            return super().read()

    bench = trial.bench()
    with trial.link(bench) as link:
        limited = LimitedLink(link, Limits(1.0, seconds_in_a_row=0.02))
        with pytest.raises(LimitError, match=r"longer than .* 0\.02 s in a row"):
            check_transducers(limited, Slow(bench), points=2, readings=1, background=1)
