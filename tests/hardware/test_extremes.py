"""Settings far from any bench, such as a duty cycle of 1e-12: refused, or right."""

from __future__ import annotations

import math
import threading

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from autdtorch import hardware as hw

POWERS = st.floats(-330, 309).map(lambda power: 10.0**power if power < 308 else 1.7e308)  # 0 to the largest
NEAR = st.one_of(POWERS, *[st.floats(-10, 6).map(lambda power: 10.0**power)] * 3)
NUMBERS = st.one_of(POWERS, st.floats(), st.sampled_from([0.0, 5e-324, 1.0, 1e-12]))
DAY = 86_400.0
MATRIX = torch.polar(
    torch.ones(2, 16, dtype=torch.float64), torch.arange(32.0, dtype=torch.float64).view(2, 16)
)
FULL = torch.ones(16, dtype=torch.complex128)
CHIP = (0x2A8D, 0x1770)


@given(NUMBERS, NUMBERS, NUMBERS, NUMBERS)
def test_no_limit_is_one_that_a_timer_or_a_lifetime_does_not_reach(amplitude, seconds, in_a_row, duty_cycle):
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


def test_usual_limits_are_accepted():
    hw.Limits(0.01, 1, 1e-3, 1e-3, 1e-3)
    hw.Limits(1.0, 10**9, DAY, DAY, 0.5)


@settings(max_examples=30)
@given(NUMBERS)
def test_no_wait_is_longer_than_a_trial(value):
    bench = hw.EmulatedBench(hw.OPENMPD, MATRIX, range(16))
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


@settings(max_examples=60)
@given(NEAR, NEAR, NEAR)
@example(1.0, 10.0, 1.75)  # at the coarsest scale
def test_an_oscilloscope_reads_what_it_can_resolve_or_says_why_not(sensitivity, gain, loudest):
    bench = hw.EmulatedBench(hw.SONICSURFACE, MATRIX, range(16))
    try:
        microphones = [hw.Microphone(number, sensitivity, loudest, gain) for number in (1, 2)]
    except ValueError as error:
        assert str(error).startswith(("sensitivity", "gain", "loudest"))  # noqa: PT017
        return
    hw.EmulatedScope(bench.pressure, 40e3, sensitivity * gain, (0, 1)).plug_into(bench, CHIP)
    truth = MATRIX.sum(dim=1).abs()
    with (
        hw.open_scope(CHIP, backend=bench.bus) as scope,
        hw.open_link(hw.SONICSURFACE, range(16), backend=bench.bus) as link,
    ):
        sensor = hw.ScopeSensor(scope, 40e3, microphones)
        link.play(FULL)
        try:
            read = sensor.read()
        except hw.SensorError as error:
            assert "clipped" in str(error)  # noqa: PT017
            assert truth.max() > 0.9 * loudest
            return
    step = 8 * 1e-3 / 256 / (sensitivity * gain)  # of the converter on its finest scale [Pa]
    assert read.isfinite().all()
    torch.testing.assert_close(read, truth, rtol=0.05, atol=2 * step)


@pytest.mark.parametrize("count", [2**62, 10_001, 0])
def test_numbers_of_readings_are_such_as_end(count):
    bench = hw.EmulatedBench(hw.OPENMPD, MATRIX, range(16))
    with hw.open_link(hw.OPENMPD, range(16), backend=bench.bus) as link:
        limited = hw.LimitedLink(link, hw.Limits(1.0))
        for name in ("readings", "background"):
            with pytest.raises(ValueError, match=name):
                hw.check_transducers(limited, hw.EmulatedSensor(bench), 2, **{name: count})
    assert math.isclose(limited.seconds_on, 0)
