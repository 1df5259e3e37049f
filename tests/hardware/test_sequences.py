"""Sequences on devices: every frame, in order and in time; refused where a device cannot play them."""

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from faulty_bus import FAULTS, FaultyBus
from hypothesis import given, settings
from hypothesis import strategies as st
from public_values import board_file
from small_scenes import random_frames

from autdtorch import hardware as hw
from autdtorch.hardware import streaming
from autdtorch.hardware.devices.openmpd import OpenMPDBoard
from autdtorch.scene.sequence import Sequence

COUNT = 16  # transducers of the bench


def played(bench: hw.EmulatedBench) -> list[torch.Tensor]:
    """A list that grows by the drive that the firmware emits after each transfer."""

    def receive(data: bytes) -> None:
        real(data)
        drives.append(bench.emitted())

    drives: list[torch.Tensor] = []
    real = bench.firmware.receive
    bench.firmware.receive = receive
    return drives


def wait_until_it_plays(bench: hw.EmulatedBench) -> None:
    while not bench.emitted().any():
        time.sleep(1e-3)


def once_it_plays(bench: hw.EmulatedBench, act: Callable[[], object]) -> threading.Thread:
    """Return a thread that acts as soon as the bench emits."""
    thread = threading.Thread(target=lambda: (wait_until_it_plays(bench), act()), daemon=True)
    thread.start()
    return thread


class Clock(SimpleNamespace):
    """A clock that goes on in sleeps alone, and each sleep by a little too much."""

    def __init__(self) -> None:
        super().__init__(now=100.0)

    def perf_counter(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds + 50e-6


class Sink:
    """Takes bytes, and notes when each frame came; the delays [s] of some transfers are by their number."""

    def __init__(self, clock: Clock, frame: int, delays: dict[int, float]) -> None:
        self.clock, self.frame, self.delays = clock, frame, delays
        self.data, self.times, self.transfers = b"", [], 0

    def __call__(self, data: bytes) -> bool:
        self.clock.now += 20e-6 + self.delays.get(self.transfers, 0.0)
        self.transfers += 1
        self.data += data
        self.times += [self.clock.now] * (len(data) // self.frame)
        return True


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(streaming, "time", clock)
    return clock


@pytest.mark.parametrize("rate", [0.9, 89.0, 1000.0, 9000.0, 40_000.0])
def test_frames_are_sent_in_order_when_they_are_due_and_without_drift(clock, rate):
    frames = np.arange(7 * 2, dtype=np.uint8).reshape(7, 1, 2)
    sink = Sink(clock, 2, {})
    count = 10_000
    playback = streaming.stream(sink, frames, rate, count, bool)
    assert sink.data == (frames.tobytes() * (count // 7 + 1))[: 2 * count]
    delay = np.array(sink.times) - 100.0 - np.arange(count) / rate
    # Early by the frames that share a transfer; late by a sleep and a transfer.
    assert -0.5e-3 - 1e-9 <= delay.min() <= delay.max() <= 75e-6
    assert (playback.frames, playback.late) == (count, 0)
    assert playback.latest == pytest.approx(delay.max(), abs=1e-9)
    assert playback.seconds == pytest.approx(count / rate, abs=75e-6)


@settings(max_examples=30)
@given(
    rate=st.floats(500, 40_000), delays=st.dictionaries(st.integers(0, 100), st.floats(0, 20e-3), max_size=5)
)
def test_late_frames_are_sent_all_the_same_and_counted(rate, delays):
    with pytest.MonkeyPatch.context() as patch:
        clock = Clock()
        patch.setattr(streaming, "time", clock)
        sink = Sink(clock, 2, delays)
        frames = np.arange(50, dtype=np.uint8).reshape(25, 1, 2)
        playback = streaming.stream(sink, frames, rate, 1000, bool)
    assert sink.data == frames.tobytes() * 40
    delay = np.array(sink.times) - 100.0 - np.arange(1000) / rate
    certain = np.abs(delay - streaming.LATE) > 1e-9  # rounding of times around 100 s
    assert (delay[certain] > streaming.LATE).sum() <= playback.late <= (delay > streaming.LATE - 1e-9).sum()
    assert playback.latest == pytest.approx(delay.max(), abs=1e-9)


def test_a_sequence_that_falls_behind_by_a_second_ends(clock):
    sink = Sink(clock, 2, {3: 1.2})
    with pytest.raises(hw.LinkError, match=r"frame 3 was 1.2 s late; must be sent at 100 frames/s"):
        streaming.stream(sink, np.zeros((5, 1, 2), np.uint8), 100.0, 50, bool)


@pytest.mark.parametrize("name", hw.DEVICES)
def test_frames_together_are_those_of_drives_one_by_one(name):
    device = hw.DEVICES[name]
    device = device.with_boards(2) if device.most_boards != 1 else device
    drives = random_frames(9, device.transducers)
    assert [frame.tobytes() for frame in device.frames(drives)] == [device.frame(drive) for drive in drives]


@pytest.mark.parametrize(
    ("device", "rate"), [(hw.OPENMPD, 500.0), (hw.SONICSURFACE, 80.0), (hw.ULTRAINO, 50.0)]
)
def test_every_frame_is_sent_in_order_and_the_outputs_are_off_in_the_end(trial, device, rate):
    def receive(data: bytes) -> None:
        real(data)
        received.extend(data)

    sequence, received = Sequence(random_frames(3, COUNT), rate), bytearray()
    bench = hw.EmulatedBench(device, trial.simulated.transfer_matrix, range(COUNT))
    with hw.open_link(device, range(COUNT), backend=bench.bus) as link:
        real, bench.firmware.receive = bench.firmware.receive, receive
        assert link.play_sequence(sequence, seconds=8 / rate).frames == 8
        assert not bench.emitted().any()
        frames = [link.wiring.frame(sequence.drives[number % 3]) for number in range(8)]
        off = device.frame(torch.zeros(device.transducers).cdouble())
        assert bytes(received) == b"".join([*frames, off, off])
        link.play(sequence.drives[0])
        expected = device.quantised(link.wiring.of_device(sequence.drives[0]))
        torch.testing.assert_close(bench.emitted(), expected, rtol=0, atol=1e-14)


def test_boards_of_openmpd_share_every_transfer(tmp_path):
    board = OpenMPDBoard.load(board_file(tmp_path))
    device = hw.openmpd_boards([replace(board, name=name) for name in ("left", "right")])
    bench = hw.EmulatedBench(device, torch.ones(1, 512).cdouble())
    sequence = Sequence(random_frames(40, 512), 9000.0, loop=False)
    with hw.open_link(device, backend=bench.bus) as link:
        received = [bytearray(), bytearray()]
        for number, firmware in enumerate(bench._firmwares):
            firmware.receive = received[number].extend
        link.play_sequence(sequence)
        frames = device.frames(sequence.drives).reshape(40, 2, 512)
    for number, data in enumerate(received):
        assert bytes(data[: 40 * 512]) == frames[:, number].tobytes()


@pytest.mark.parametrize("how", ["off", "another drive", "another sequence", "close"])
def test_another_thread_ends_a_loop(trial, how):
    bench = trial.bench(hw.OPENMPD)
    with trial.link(bench, hw.OPENMPD) as link:
        loop, full = Sequence(random_frames(5, COUNT), 1000.0), torch.ones(COUNT).cdouble()
        ends = {
            "off": link.off,
            "another drive": lambda: link.play(full),
            "another sequence": lambda: link.play_sequence(Sequence(full[None], 1000.0), 0.05),
            "close": link.close,
        }
        other = once_it_plays(bench, ends[how])
        assert link.play_sequence(loop).frames > 0
        other.join()
        assert bench.drive().any() == (how == "another drive")


@pytest.mark.parametrize("how", ["off", "off of the link", "limit"])
def test_a_sequence_ends_though_its_end_comes_while_it_is_prepared(trial, how, monkeypatch):
    def slow(device, drives):
        ends[how]()
        return real(device, drives)

    real = type(hw.OPENMPD).frames
    monkeypatch.setattr(type(hw.OPENMPD), "frames", slow)
    limits = {"seconds_in_a_row": 0.05} if how == "limit" else {}
    with trial.limited(hw.OPENMPD, **limits) as (bench, link):
        ends = {"off": link.off, "off of the link": link.link.off, "limit": lambda: time.sleep(0.1)}
        watchdog = threading.Timer(100, link.link.off)
        watchdog.start()
        with pytest.raises(hw.LimitError) if how == "limit" else contextlib.nullcontext():
            link.play_sequence(Sequence(random_frames(5, COUNT), 1000.0))
        assert watchdog.is_alive()
        watchdog.cancel()
        assert not bench.emitted().any()


def test_a_mistake_ends_the_sequence_of_another_thread_with_the_outputs_off(trial):
    bench = trial.bench(hw.OPENMPD)
    with trial.link(bench, hw.OPENMPD) as link:
        thread = threading.Thread(target=link.play_sequence, args=(Sequence(SMALL, 1000.0),))
        thread.start()
        wait_until_it_plays(bench)
        with pytest.raises(ValueError, match="rate"):
            link.play_sequence(Sequence(SMALL, 20e3))
        thread.join()
        assert not bench.emitted().any()


def test_off_of_a_limited_link_ends_a_sequence_that_another_thread_plays_without_limits(trial):
    with trial.limited(hw.OPENMPD) as (bench, link):
        thread = threading.Thread(target=link.link.play_sequence, args=(Sequence(SMALL, 1000.0),))
        thread.start()
        wait_until_it_plays(bench)
        link.off()
        assert not bench.emitted().any()
        thread.join()


def test_seconds_at_the_limit_are_played_at_any_rate(trial):
    with trial.limited(hw.OPENMPD, seconds_in_a_row=0.05) as (_, link):
        assert link.play_sequence(Sequence(SMALL, 1150.0), 0.05).frames <= 57  # 57.5 frames
        assert link.play_sequence(Sequence(SMALL, 100.0), 0.03).frames == 3  # 100 * 0.03 rounds down


def test_a_port_that_shows_frames_shows_each(trial):
    shown, sequence = [], Sequence(random_frames(40, COUNT), 9000.0, loop=False)
    for device in (hw.AUTD3, hw.OPENMPD):
        bench = trial.bench(device)
        with hw.Link(device, bench.port(shown.append), range(COUNT), 0, bench.bus.sleep) as link:
            rate = 8000.0 if device == hw.AUTD3 else 9000.0
            shown.clear()
            link.play_sequence(Sequence(sequence.drives, rate, loop=False))
        assert len(shown) == 40 + 2 + 2  # off at the end of the sequence, and of the link


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_loop_with_the_outputs_off(trial, number):
    before = signal.signal(number, signal.default_int_handler)
    bench = trial.bench(hw.OPENMPD)
    main = threading.main_thread().ident

    def play() -> None:
        with hw.ended_by_signals(), trial.link(bench, hw.OPENMPD) as link:
            once_it_plays(bench, lambda: signal.pthread_kill(main, number))
            link.play_sequence(Sequence(random_frames(5, COUNT), 1000.0))

    try:
        with pytest.raises(hw.Signalled):
            play()
    finally:
        signal.signal(number, before)
    assert not bench.emitted().any()


@pytest.mark.timeout(120)
def test_signals_at_any_moment_leave_the_outputs_off(trial, signalled_all_the_time):
    loop, bench = Sequence(random_frames(5, COUNT), 5000.0), trial.bench(hw.OPENMPD)
    emitted = []
    with trial.link(bench, hw.OPENMPD) as link, signalled_all_the_time():
        for _ in range(100):
            with contextlib.suppress(hw.Signalled), hw.ended_by_signals():
                link.play_sequence(loop)
            emitted.append(bool(bench.emitted().any()))
    assert emitted == [False] * 100


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_bus_ends_a_loop_with_the_outputs_off(trial, fault):
    bench = trial.bench(hw.OPENMPD)
    bench.bus = FaultyBus([bench.chip], fault, 512 * 20 + 300)
    with pytest.raises(hw.LinkError) as raised, trial.link(bench, hw.OPENMPD) as link:
        link.play_sequence(Sequence(random_frames(5, COUNT), 1000.0))
    assert bench.bus.struck
    assert "\n" not in str(raised.value)
    if fault == "unplug":
        assert "outputs may still be on" in str(raised.value)
    else:
        assert not bench.emitted().any()


def test_a_limited_link_scales_a_sequence_and_counts_its_time(trial):
    sequence = Sequence(random_frames(4, COUNT), 100.0)
    with trial.limited(hw.OPENMPD, amplitude=0.5, seconds=50) as (bench, link):
        drives = played(bench)
        link.play_sequence(sequence, 0.08)
        assert 0.08 <= link.seconds_on < 50
        assert max(float(drive.abs().max()) for drive in drives) <= 0.5 + 1e-9
        assert drives[0].abs().max() > 0.3
        assert not bench.emitted().any()
        with pytest.raises(hw.LimitError, match=r"the sequence takes 50 s, and the limit leaves 4\d\.\d s"):
            link.play_sequence(sequence, 50)
        link.go_on(50)
        with pytest.raises(hw.LimitError, match=r"the outputs were on for 50 s, the limit"):
            link.play_sequence(sequence)
        assert not bench.emitted().any()


def test_the_timer_of_a_limited_link_ends_a_loop_and_its_off_is_no_error(trial):
    loop = Sequence(random_frames(4, COUNT), 100.0)
    with trial.limited(hw.OPENMPD, seconds_in_a_row=0.06) as (bench, link):
        with pytest.raises(hw.LimitError, match=r"longer than the outputs may stay on, 0.06 s in a row"):
            link.play_sequence(loop)
        assert not bench.emitted().any()
    with trial.limited(hw.OPENMPD) as (bench, link):
        once_it_plays(bench, link.off)
        link.play_sequence(loop)


CLOSED, LIMITED = "closed", "limited"
SMALL = random_frames(4, COUNT)
SHORT, OTHERS = Sequence(SMALL, 10.0), Sequence(SMALL[:, :10], 10.0)
MISTAKES = [
    (hw.OPENMPD, SMALL, {}, "sequence: .*must be a Sequence"),
    (hw.OPENMPD, None, {}, "sequence: None; must be a Sequence"),
    (hw.OPENMPD, OTHERS, {}, "sequence: 10 transducers; must be 16"),
    (hw.OPENMPD, SHORT, {"seconds": 0}, "seconds: 0 s; must be finite and > 0"),
    (hw.OPENMPD, SHORT, {"seconds": -1.0}, "seconds: -1.0 s; must be finite and > 0"),
    (hw.OPENMPD, SHORT, {"seconds": math.nan}, "seconds: nan s"),
    (hw.OPENMPD, SHORT, {"seconds": "5"}, "seconds: '5'"),
    (hw.OPENMPD, Sequence(SMALL, 0.1), {"seconds": 1.0}, "seconds: 1.0 s; must be at least 10, one frame"),
    (hw.OPENMPD, Sequence(SMALL, 10.0, False), {"seconds": 0.5}, "seconds: 0.5 s; must be at most 0.4"),
    (hw.OPENMPD, Sequence(SMALL, 12e3), {}, "rate: 12000.0 Hz; must be at most 1e.04 for OpenMPD"),
    (hw.SONICSURFACE, Sequence(SMALL, 100.0), {}, "rate: 100.0 Hz; must be at most 89.3 for SonicSurface"),
    (hw.ULTRAINO, Sequence(SMALL, 60.0), {}, "rate: 60.0 Hz; must be at most 54.86 for Ultraino"),
    (hw.ultraino_boards(2), Sequence(SMALL, 50.0), {}, "rate: 50.0 Hz; must be at most 28.1 for Ultraino"),
    (hw.AUTD3, Sequence(SMALL, 50e3), {}, "rate: 50000.0 Hz; must be at most 4e.04 for AUTD3"),
    (hw.AUTD3, Sequence(SMALL, 3e3), {}, "rate: 3000.0 Hz; .* such as 2857.143 or 3076.923"),
    (hw.AUTD3, Sequence(SMALL, 0.5), {}, "rate: 0.5 Hz; must be at least 0.61 for AUTD3"),
    (hw.AUTD3, Sequence(random_frames(1025, COUNT), 1e3), {}, "sequence: 1025 frames; must be at most 1024"),
    (LIMITED, SMALL, {}, "sequence: .*must be a Sequence"),
    (LIMITED, OTHERS, {}, "sequence: 10 transducers; must be 16"),
    (CLOSED, SHORT, {}, "OpenMPD is closed; open it again"),
]


@pytest.mark.parametrize(("device", "sequence", "arguments", "message"), MISTAKES)
def test_a_mistake_is_refused_in_one_line_and_nothing_plays(trial, device, sequence, arguments, message):
    kind = hw.OPENMPD if isinstance(device, str) else device
    bench = hw.EmulatedBench(kind, trial.simulated.transfer_matrix, range(COUNT))
    port = kind.emulated_port(bench) if kind.adapters else bench.port()
    with hw.Link(kind, port, range(COUNT), 0, bench.bus.sleep) as link:
        if device == CLOSED:
            link.close()
        player = hw.LimitedLink(link, hw.Limits(1.0)) if device == LIMITED else link
        drives = played(bench)
        with pytest.raises((ValueError, hw.LinkError), match=message) as raised:
            player.play_sequence(sequence, **arguments)
        assert "\n" not in str(raised.value)
        assert not any(drive.any() for drive in drives)


def test_a_loop_lasts_as_long_as_asked(trial):
    bench = trial.bench(hw.OPENMPD)
    with trial.link(bench, hw.OPENMPD) as link:
        begin = time.perf_counter()
        link.play_sequence(Sequence(SMALL, 1000.0), seconds=0.1)
        assert time.perf_counter() - begin >= 0.1
