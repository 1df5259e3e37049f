"""Limits of a trial, and outputs off in every case."""

import contextlib
import os
import signal
import sys
import threading
import time
import weakref

import pytest
import torch
from faulty_bus import Disturbed
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch import hardware as hw
from autdtorch.hardware.sensors.sensor import checked_reading

FULL = torch.ones(16, dtype=torch.complex128)


def test_an_invalid_drive_is_not_scaled_into_a_valid_one_and_starts_no_clock(trial):
    with trial.limited(hw.OPENMPD, amplitude=0.5) as (bench, link):
        for drive, message in ((FULL[None], r"shape \(1, 16\)"), (1.5 * FULL, r"drive: amplitude 1\.5")):
            with pytest.raises(ValueError, match=message):
                link.play(drive)
        assert link.seconds_on == 0
        assert link._timer is None
        assert hw.EmulatedSensor(bench).read().max() == 0


POWERS = st.floats(-330, 309).map(lambda power: 10.0**power if power < 308 else 1.7e308)  # 0 to the largest
NUMBERS = st.one_of(POWERS, st.floats(), st.sampled_from([0.0, 5e-324, 1.0, 1e-12]))
DAY = 86_400.0


@given(NUMBERS, NUMBERS, NUMBERS, NUMBERS)
def test_limits_are_refused_or_reached_by_a_timer_and_in_a_lifetime(amplitude, seconds, in_a_row, duty_cycle):
    try:
        limits = hw.Limits(amplitude, 10, seconds, in_a_row, duty_cycle)
    except ValueError as error:
        assert str(error).startswith(("amplitude", "seconds", "duty_cycle"))  # noqa: PT017
        return
    assert 0 < limits.amplitude <= 1
    longest = min(limits.seconds, limits.seconds_in_a_row)
    assert 0 < longest <= threading.TIMEOUT_MAX
    assert longest * (1 / limits.duty_cycle - 1) <= DAY * (1 + 1e-9)
    assert 0.1 * (1 / limits.duty_cycle - 1) <= DAY  # after a stretch that a busy machine has made longer


def test_usual_limits_are_accepted_and_an_amplitude_is_required():
    hw.Limits(0.01, 1, 1e-3, 1e-3, 1e-3)
    hw.Limits(1.0, 10**9, DAY, DAY, 0.5)
    with pytest.raises(ValueError, match="evaluations: 0"):
        hw.Limits(1.0, evaluations=0)
    with pytest.raises(TypeError, match="amplitude"):
        hw.Limits()


@settings(max_examples=30)
@given(NUMBERS)
def test_no_wait_is_longer_than_a_trial(value):
    bench = hw.EmulatedBench(hw.OPENMPD, torch.ones(2, 16).cdouble(), range(16))
    waits = {
        "settle": lambda: hw.open_link(hw.OPENMPD, range(16), backend=bench.bus, settle=value).close(),
        "timeout": lambda: hw.FileSensor("readings", 2, timeout=value),
        "settle ": lambda: hw.FileSensor("readings", 2, settle=value),
    }
    for name, make in waits.items():
        if 0 <= value <= 60 and (value > 0 or name != "timeout"):
            make()
        elif not value <= DAY:
            with pytest.raises(ValueError, match=name.strip()):
                make()


def test_the_outputs_rest_as_the_duty_cycle_asks(trial, clock):
    with trial.limited(seconds_in_a_row=100, duty_cycle=0.25) as (_, link):
        while link.seconds_on < 125:
            link.play(FULL)
            clock.sleep(1)
            link.require_on()
        # The last stretch has not rested yet; it is shorter than what is allowed in a row.
        assert clock.now >= (link.seconds_on - 100) / 0.25


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"seconds_in_a_row": 0.02}, r"longer than .* 0\.02 s in a row"),
        ({"seconds": 0.02}, r"the outputs were on for 0\.02 s, the limit"),
    ],
)
@pytest.mark.parametrize("in_main_thread", [True, False])
def test_while_a_sensor_takes_too_long_the_outputs_go_off(trial, limits, message: str, in_main_thread: bool):
    def wait(_: int) -> None:
        while bench.drive().any():
            time.sleep(200 if in_main_thread else 1e-3)  # in the main thread, the reading is interrupted

    def measure() -> None:
        with pytest.raises(hw.LimitError, match=message):
            objective(FULL[None])
        are_off.append(not bench.drive().any())

    are_off: list[bool] = []
    with trial.limited(**limits) as (bench, link):
        objective = trial.objective(link, Disturbed(bench, wait))
        if in_main_thread:
            measure()
        else:
            other = threading.Thread(target=measure)
            other.start()
            other.join()
        assert are_off == [True]
        assert not objective.log.evaluations
        with pytest.raises(hw.LimitError, match=message):
            hw.check_transducers(link, Disturbed(bench, wait), points=2, readings=1, background=1)


def wait_for_pipe(folder):
    os.mkfifo(folder / "readings")
    (folder / "readings").read_text()


WAITS = {
    "sleep": lambda _: time.sleep(200),
    "event": lambda _: threading.Event().wait(200),
    "pipe": wait_for_pipe,
}


@pytest.mark.skipif(sys.platform == "win32", reason="pipes and signals of POSIX")
@pytest.mark.parametrize("kind", WAITS)
def test_a_sensor_that_never_returns_ends_the_trial(trial, tmp_path, kind: str):
    begin, before = time.monotonic(), [signal.getsignal(one) for one in signal.valid_signals()]
    with trial.limited(seconds_in_a_row=0.5) as (bench, link):
        objective = trial.objective(
            link, Disturbed(bench, lambda reading: reading == 3 and WAITS[kind](tmp_path))
        )
        with pytest.raises(hw.LimitError, match="longer than the outputs may stay on"):
            objective(FULL.expand(5, -1))
        assert bench.drive().abs().max() == 0
        assert objective.evaluations == 2  # what was read is in the log
    assert time.monotonic() - begin < 100
    assert [signal.getsignal(one) for one in signal.valid_signals()] == before


def test_a_sensor_that_never_returns_in_silence_ends_the_check(trial, monkeypatch):
    monkeypatch.setattr(checked_reading, "__defaults__", (0.1,))
    with trial.limited() as (bench, link):
        with pytest.raises(hw.SensorError, match="no reading within"):
            hw.check_transducers(link, Disturbed(bench, lambda reading: reading == 2 and time.sleep(200)), 2)
        assert link.seconds_on == 0


def test_a_signal_that_comes_while_a_sensor_hangs_ends_the_trial_at_once(trial):
    def hang(_: int) -> None:
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        time.sleep(200)

    with trial.limited() as (bench, link), hw.ended_by_signals():
        objective = trial.objective(link, Disturbed(bench, hang))
        with pytest.raises(hw.Signalled):
            objective(FULL[None])
        assert bench.drive().abs().max() == 0


def test_while_the_sound_settles_the_timer_may_switch_off(trial):
    def sleep(seconds: float) -> None:
        while seconds == 0.2 and bench.emitted().any():
            time.sleep(1e-3)

    bench = trial.bench()
    bench.bus.sleep = sleep
    with hw.open_link(hw.SONICSURFACE, range(16), backend=bench.bus, settle=0.2) as link:
        limits = hw.LimitedLink(link, hw.Limits(1.0, seconds_in_a_row=0.02))
        limits.play(FULL)
        with pytest.raises(hw.LimitError, match="playing and reading took longer"):
            limits.require_on()


def test_a_timer_that_comes_late_reaches_neither_the_next_stretch_nor_the_next_link(trial):
    with trial.limited() as (bench, link):
        link.play(FULL)
        late = link._timer
        assert late.daemon  # for another Python would wait before it exits and switches off
        link.off()
        link.play(FULL)
        late.function()  # it had waited for the lock
        link.require_on()
        assert bench.drive().abs().min() > 0.9
    with trial.link(bench) as later:
        later.play(FULL)
        link._timer.function()
        assert bench.drive().abs().min() > 0.9
    with pytest.raises(hw.LinkError, match="SonicSurface is closed"):
        later.play(FULL)
    assert bench.firmware.drive().abs().max() == 0


@pytest.mark.parametrize("error", [hw.LinkError("stuck"), RuntimeError("stuck")])
def test_a_timer_that_cannot_switch_off_says_so_at_once_and_ends_the_trial(trial, error, monkeypatch, caplog):
    def wait(_: int) -> None:
        time.sleep(200)

    def fail() -> None:
        raise error

    with trial.limited(seconds_in_a_row=0.5) as (bench, link):
        objective = trial.objective(link, Disturbed(bench, wait))
        monkeypatch.setattr(link.link, "off", fail)
        with pytest.raises(type(error), match="stuck"):
            objective(FULL[None])
        monkeypatch.undo()
        assert "the time is up, but: stuck" in caplog.text
    assert not objective.log.evaluations
    assert bench.firmware.drive().abs().max() == 0


def test_an_error_of_the_sensor_leaves_the_outputs_off_on_an_open_link(trial):
    def fail(_: int) -> None:
        if bench.drive().any():
            raise OSError("gone")

    with trial.limited() as (bench, link):
        with pytest.raises(OSError, match="gone"):
            trial.objective(link, Disturbed(bench, fail))(FULL[None])
        assert bench.firmware.drive().abs().max() == 0
        with pytest.raises(OSError, match="gone"):
            hw.check_transducers(link, Disturbed(bench, fail), points=2)
        assert bench.firmware.drive().abs().max() == 0


def test_a_link_left_open_is_switched_off_when_python_exits_and_a_closed_one_is_released(trial, monkeypatch):
    bench = trial.bench()
    with monkeypatch.context() as context:
        at_exit: list[object] = []
        context.setattr("atexit.register", at_exit.append)
        trial.link(bench).play(FULL)
        (close,) = at_exit
        close()
        assert bench.firmware.drive().abs().max() == 0
    link = trial.link(bench)
    closed = weakref.ref(link)
    link.close()
    del link
    assert closed() is None


def test_the_number_of_evaluations_is_limited_over_all_of_a_trial(trial):
    def observe(rows: int, most: int) -> None:
        with trial.limited(evaluations=most) as (bench, link):
            objective = trial.objective(link, hw.EmulatedSensor(bench))
            with objective.continued():
                objective(FULL.expand(rows, -1))

    observe(3, most=3)
    with pytest.raises(hw.LimitError, match="4 evaluations are made, the limit"):
        observe(5, most=4)
    observe(5, most=5)


def test_the_time_on_goes_on_with_the_trial(trial):
    with trial.limited(seconds=60.0) as (bench, link):  # a test does not take that long
        trial.objective(link.link, hw.EmulatedSensor(bench)).log.append(FULL, torch.ones(2), 60.0)
        objective = trial.objective(link, hw.EmulatedSensor(bench))
        with pytest.raises(hw.LimitError, match="on for 60 s, the limit"), objective.continued():
            objective(FULL.expand(2, -1))  # one is in the log
        assert link.seconds_on == 60.0


def test_a_trial_that_goes_on_rests_no_longer_than_its_limits_promise(trial, clock):
    with trial.limited(seconds=100, seconds_in_a_row=1e6, duty_cycle=0.5) as (_, link):
        link.go_on(0.0)
        link.play(FULL)
        assert clock.now == 100  # 12 days by the other limit


def test_the_time_of_an_earlier_check_counts_and_is_rested_from(trial, clock):
    with trial.limited() as (bench, link):
        sensor = Disturbed(bench, lambda _: clock.sleep(0.1))
        log = trial.objective(link, sensor).log
        hw.check_transducers(link, sensor, points=2)
        log.end(link.seconds_on)
        before, end = link.seconds_on, clock.now
        again = hw.LimitedLink(link.link, hw.Limits(1.0, seconds_in_a_row=50, duty_cycle=0.25))
        objective = trial.objective(again, sensor)
        assert again.seconds_on == before > 0
        objective(FULL[None])
        assert clock.now - end == pytest.approx(50 * (1 / 0.25 - 1) + 0.1)
        assert objective.log.seconds_on > before
        # Nor does a second objective on the same link count anything twice.
        once = again.seconds_on
        trial.objective(again, sensor)
        assert again.seconds_on == once


@pytest.mark.parametrize(
    ("status", "message"),
    [(b"\x01\x20", "outputs may still be on"), (b"", "no line status; is it an FT232R")],
)
def test_a_chip_that_does_not_confirm_the_off_frame_is_an_error(trial, monkeypatch, status, message):
    monkeypatch.setattr("autdtorch.hardware.transport.serial_chips._FLUSH_SECONDS", 0.0)
    bench = trial.bench()
    link = trial.link(bench)
    bench.chip.answer = lambda kind, request: status  # 0x20: room for more, but not all is sent
    with pytest.raises(hw.LinkError, match=message):
        link.close()


class Slow:
    """Something whose removal takes long: what a signal raises there is dropped."""

    def __del__(self):
        time.sleep(0.4)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("dropped", ["in a __del__", "by a handler"])
def test_a_late_reading_ends_although_the_first_signal_is_lost(dropped):
    class Sensor:
        def read(self):
            if dropped == "by a handler":
                with contextlib.suppress(BaseException):
                    time.sleep(1)
            else:
                one = Slow()
                del one
            time.sleep(200)

    begin = time.monotonic()
    with pytest.raises(hw.SensorError, match=r"no reading within 0\.2 s"):
        checked_reading(Sensor(), 1, 0.2)
    assert time.monotonic() - begin < 100


def test_a_reading_that_ends_late_is_none():
    class Sensor:
        def read(self):
            with contextlib.suppress(BaseException):
                time.sleep(1)
            return torch.ones(1)

    with pytest.raises(hw.SensorError, match=r"no reading within 0\.1 s"):
        checked_reading(Sensor(), 1, 0.1)
