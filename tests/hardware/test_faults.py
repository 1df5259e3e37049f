"""Faults during a trial: outputs off, an error of one line, a log that loads, and a trial that continues."""

import signal
import sys
import time
import weakref
from collections.abc import Callable
from functools import partial

import pytest
import torch
from faulty_bus import FAULTS, Disturbed, FaultyBus

from autdtorch import hardware as hw
from autdtorch.hardware.emulator.bench import EmulatedBus
from autdtorch.methods.functions import gabs
from autdtorch.methods.solution import Solution

METHOD = partial(gabs, levels=2, order="given")
EVALUATIONS = 1 + 15 * 2
SURVIVED = 10  # evaluations before the fault


def measure(
    trial, bench: hw.EmulatedBench, sensor: hw.Sensor, device: hw.Device = hw.SONICSURFACE
) -> Solution:
    with hw.ended_by_signals(), trial.link(bench, device) as link:
        return METHOD(trial.objective(link, sensor))


def play(
    trial,
    bench: hw.EmulatedBench,
    device: hw.Device = hw.SONICSURFACE,
    arm: Callable[[hw.Link], object] = bool,
):
    """Play a full drive, then end; `arm` takes the link before."""
    with hw.ended_by_signals(), trial.link(bench, device) as link:
        arm(link)
        link.play(torch.ones(16, dtype=torch.complex128))


def is_off(bench: hw.EmulatedBench) -> bool:
    return not bench.firmware.drive().any()


devices = pytest.mark.parametrize("device", [hw.SONICSURFACE, hw.OPENMPD], ids=lambda device: device.name)


def bytes_before(device: hw.Device, evaluations: int) -> int:
    """The number of bytes before a fault in mid-frame of an evaluation; off frames are sent in pairs."""
    frame = len(device.frame(torch.zeros(256, dtype=torch.complex128)))
    calls = 1 + (evaluations - 1) // 2
    return frame * (2 + evaluations + 2 * calls) + 3 * frame // 4


def require_that_it_goes_on(trial, device: hw.Device = hw.SONICSURFACE) -> None:
    """The log has what was measured, and the rest leads to what an undisturbed trial finds."""
    bench = trial.bench(device)
    sensor = Disturbed(bench)
    solution = measure(trial, bench, sensor, device)
    assert sensor.readings == EVALUATIONS - SURVIVED
    expected = METHOD(trial.played(device))
    assert torch.equal(solution.drive, expected.drive)
    torch.testing.assert_close(solution.history, expected.history, rtol=1e-12, atol=0)  # sums reordered


@devices
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_bus_ends_the_trial_with_the_outputs_off(trial, fault, device):
    bench = trial.bench(device)
    bench.bus = FaultyBus([bench.chip], fault, bytes_before(device, SURVIVED))
    with pytest.raises(hw.LinkError) as raised:
        measure(trial, bench, hw.EmulatedSensor(bench), device)
    assert "\n" not in str(raised.value)
    assert bench.bus.struck
    if fault == "unplug":
        assert "outputs may still be on" in str(raised.value)
    else:
        assert is_off(bench)
    require_that_it_goes_on(trial, device)


@pytest.mark.parametrize("fault", ["time-out", "stall", "short write"])
def test_a_fault_in_the_last_off_frame_is_mended(trial, fault):
    bench = trial.bench()
    bench.bus = FaultyBus([bench.chip], fault, 258 * (2 + 1) + 100)
    play(trial, bench)
    assert bench.bus.struck
    assert is_off(bench)


def nobody(question: str) -> str:
    raise EOFError


@pytest.mark.parametrize(
    ("reading", "message"),
    [
        (lambda: [1.0, float("nan")], "pressure of the sensor"),
        (lambda: ["noise", 1.0], "pressure of the sensor"),
        (lambda: [1.0], "pressure of the sensor"),
        (hw.ManualSensor([(0, 0, 0), (1, 0, 0)], nobody).read, "nobody answers"),
        (hw.FileSensor("no/such/file", 2, timeout=0.01).read, "did not change"),
    ],
)
def test_garbage_from_the_sensor_ends_the_trial_with_the_outputs_off(trial, reading, message):
    class Garbled(Disturbed):
        def read(self):
            return super().read() if self.readings < SURVIVED else reading()

    bench = trial.bench()
    with pytest.raises((ValueError, OSError), match=message):
        measure(trial, bench, Garbled(bench))
    assert is_off(bench)
    require_that_it_goes_on(trial)


@pytest.fixture
def not_ignored(number):
    """A signal as a terminal's processes get it: those that a shell starts in the background ignore two."""
    before = signal.signal(number, signal.SIG_DFL)
    yield
    signal.signal(number, before)


@pytest.mark.usefixtures("not_ignored")
@pytest.mark.parametrize(
    "number", [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGTSTP, signal.SIGTTIN]
)
def test_a_signal_ends_the_trial_with_the_outputs_off(trial, number):
    def disturb(readings: int) -> None:
        if readings > SURVIVED:
            signal.raise_signal(number)

    before = signal.getsignal(number)
    bench = trial.bench()
    with pytest.raises(hw.Signalled, match=number.name):
        measure(trial, bench, Disturbed(bench, disturb))
    assert is_off(bench)
    assert signal.getsignal(number) is before
    require_that_it_goes_on(trial)


@devices
def test_signals_in_mid_frame_and_while_switching_off_leave_the_outputs_off(trial, device):
    class Interrupting(EmulatedBus):
        armed = False

        def arm(self, _: hw.Link) -> None:
            self.armed = True

        def bulk_write(self, dev_handle, ep, intf, data, timeout):
            written = super().bulk_write(dev_handle, ep, intf, data[:300], timeout)
            if self.armed:
                signal.raise_signal(signal.SIGTERM)
            return written

    bench = trial.bench(device)
    bench.bus = Interrupting([bench.chip])
    with pytest.raises(hw.Signalled):
        play(trial, bench, device, bench.bus.arm)
    assert is_off(bench)


@pytest.mark.parametrize("interrupted", ["recovery", "off"])
def test_a_signal_amid_or_just_before_the_last_off_frame_leaves_the_outputs_off(
    trial, monkeypatch, interrupted
):
    def interrupt(*_: object) -> None:
        monkeypatch.undo()
        signal.raise_signal(signal.SIGTERM)

    def arm(link: hw.Link) -> None:
        where = (bench.bus, "clear_halt") if interrupted == "recovery" else (link, "off")
        monkeypatch.setattr(*where, interrupt)

    bench = trial.bench()
    bench.bus = FaultyBus([bench.chip], "time-out", 258 * (2 + 1) + 100)
    with pytest.raises(hw.Signalled):
        play(trial, bench, arm=arm)
    assert is_off(bench)


@pytest.mark.usefixtures("not_ignored")
@pytest.mark.parametrize("number", [signal.SIGINT])
def test_two_signals_at_once_end_the_trial_by_the_first(monkeypatch, number):
    lost: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lost.append)
    with pytest.raises(hw.Signalled, match="SIGINT"), hw.ended_by_signals():  # noqa: PT012
        signal.pthread_sigmask(signal.SIG_BLOCK, {number, signal.SIGTERM})
        signal.raise_signal(number)  # to this thread, as other threads do not block it
        signal.raise_signal(signal.SIGTERM)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {number, signal.SIGTERM})
    assert not lost


def test_after_a_signal_that_python_drops_the_next_ends_the_trial(monkeypatch):
    class Thing: ...

    def trial() -> None:
        thing = Thing()
        _ = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGTERM))
        with hw.ended_by_signals():
            del thing
            signal.raise_signal(signal.SIGTERM)

    dropped: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda event: dropped.append(event.exc_type))
    with pytest.raises(hw.Signalled) as first:
        trial()
    assert dropped == [hw.Signalled]
    try:
        raise first.value
    except hw.Signalled:  # what is handled around a trial does not count
        with pytest.raises(hw.Signalled):
            trial()


def test_a_signal_during_a_finaliser_ends_the_trial_after_it(monkeypatch):
    class Finalised:
        def __del__(self):
            self.signal()
            ended.append(True)

        def signal(self):
            signal.raise_signal(signal.SIGTERM)

    ended: list[bool] = []
    dropped: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", dropped.append)

    begin = time.monotonic()
    with pytest.raises(hw.Signalled, match="SIGTERM"), hw.ended_by_signals():  # noqa: PT012
        Finalised()
        time.sleep(200)
    assert time.monotonic() - begin < 100  # the wait is interrupted
    assert ended == [True]
    assert not dropped


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_link_that_cannot_be_switched_off_is_closed_and_ends(trial, monkeypatch, error):
    def fail(*_: object) -> None:
        attempts.append(error)
        raise error("stuck")

    attempts: list[type[BaseException]] = []
    bench = trial.bench()
    link = trial.link(bench)
    monkeypatch.setattr(link._port, "write", fail)
    with pytest.raises(hw.OffError if error is RuntimeError else error, match="stuck"):
        link.close()
    assert 2 <= len(attempts) <= 40
    monkeypatch.undo()
    link.close()  # nothing is left to do
    with trial.link(bench):  # the chip is free again
        assert is_off(bench)


@pytest.mark.parametrize("handlers_set", [2, 7], ids=["begins", "ends"])  # of 6, and 6 as they were
def test_a_signal_as_the_handling_begins_or_ends_leaves_the_handlers_as_they_were(monkeypatch, handlers_set):
    def set_and_interrupt(number, handler):
        before = set_handler(number, handler)
        changes.append(number)
        if len(changes) == handlers_set:
            signal.raise_signal(signal.SIGTERM)
        return before

    def harmless(*_) -> None: ...

    changes: list[int] = []
    set_handler = signal.signal
    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGTTIN")
    before = {number: set_handler(number, harmless) for number in map(signal.Signals.__getitem__, names)}
    monkeypatch.setattr(signal, "signal", set_and_interrupt)
    try:
        with pytest.raises(hw.Signalled), hw.ended_by_signals():
            pass
        assert all(signal.getsignal(number) is harmless for number in before)
    finally:
        for number, handler in before.items():
            set_handler(number, handler)


def test_a_signal_that_is_ignored_as_by_nohup_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with hw.ended_by_signals():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
