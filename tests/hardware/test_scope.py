"""The oscilloscope on the emulated bus: readings against the pressure at the microphones."""

import itertools
import logging
import math
import random
import re

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from autdtorch import hardware as hw
from autdtorch.hardware.emulator.bench import EmulatedBus, stall, time_out
from autdtorch.hardware.emulator.emulated_scope import EmulatedInstrument
from autdtorch.methods.functions import gabs
from autdtorch.objectives.perturbations import random_rms
from autdtorch.scene.drive import drive_from_phases

CHIP = (0x2A8D, 0x1770)
FREQUENCY = 40e3
SENSITIVITY = 0.01  # [V/Pa], with the amplifier
LOUDEST = 4.0  # [Pa]
RESOLUTION = LOUDEST / 3.5 / 32  # [Pa]: 3.5 divisions of 32 codes, on the coarsest scale


def sensor_at(scope, microphones: int, captures: int = 1) -> hw.ScopeSensor:
    inputs = range(1, 1 + microphones)
    placed = [hw.Microphone(number, SENSITIVITY / 10, LOUDEST, gain=10) for number in inputs]
    return hw.ScopeSensor(scope, FREQUENCY, placed, captures)


class FaultyInstrument(EmulatedInstrument):
    """An instrument with a fault in every transfer from it."""

    fault = None

    def read(self, most: int) -> bytes:
        if self.fault in ("stall", "time-out"):
            raise {"stall": stall, "time-out": time_out}[self.fault]()
        return random.Random(0).randbytes(64) if self.fault == "garbage" else super().read(most)

    def _transfer(self) -> bytes:
        transfer = super()._transfer()
        return transfer[: len(transfer) // 2] if self.fault == "short" else transfer


class Bench:
    """A field that does not change, and an oscilloscope in it."""

    def __init__(self, pressure, dialect: hw.Dialect = hw.KEYSIGHT, points=(0, 1), **properties):
        maker = dialect.name.partition(" ")[0]
        self.field = torch.tensor(pressure, dtype=torch.complex128)
        self.scope = hw.EmulatedScope(lambda: self.field, FREQUENCY, SENSITIVITY, points, maker, **properties)
        self.instrument = FaultyInstrument(*CHIP, "S1", self.scope)
        self.bus = EmulatedBus([self.instrument])
        self.open = hw.open_scope(CHIP, dialect, backend=self.bus)

    def record(self) -> list[str]:
        """The lines that the oscilloscope gets from now on."""
        lines: list[str] = []
        execute = self.scope.execute
        self.scope.execute = lambda line: lines.append(line) or execute(line)
        return lines

    def sensor(self, captures: int = 1) -> hw.ScopeSensor:
        return sensor_at(self.open, len(self.scope.points), captures)


@pytest.mark.parametrize("dialect", [hw.KEYSIGHT, hw.RIGOL], ids=lambda dialect: dialect.name)
def test_a_reading_is_the_pressure_within_the_quantisation(dialect):
    pressure = [3.2 - 1j, 0.3j]
    bench = Bench(pressure, dialect, dc_offset=0.003)
    reading = bench.sensor().read()
    # Rounding errs by at most half a code. All errors with the sign of the sine and of one phase make
    # sum(2 w |sin| / 2) / sum(w) = 2 / pi codes, the mean of |sin|.
    worst = 2 / math.pi * RESOLUTION * (1 if dialect is hw.KEYSIGHT else 32 / 25)
    assert (reading - torch.tensor(pressure).abs()).abs().max() < worst
    assert bench.scope.unknown == []
    assert "EMULATED" in bench.open.identity


def test_noise_puts_the_error_on_a_reading_that_is_the_least_times_the_windows_loss():
    # 30 dB: noise of 1/1000 of the power of the sine.
    true = torch.tensor([3.0, 1.5], dtype=torch.float64)
    noise = 3.0 / math.sqrt(2) * 10 ** (-30 / 20)
    bench = Bench(true.tolist(), noise=noise * SENSITIVITY, seed=1)
    sensor = bench.sensor()
    readings = torch.stack([sensor.read() for _ in range(200)])
    # Rounding adds the variance of a uniform error. Cramer and Rao: an amplitude's variance is 2 s^2 / N at
    # least, with the Hann window 3 s^2 / N.
    expected = math.sqrt(3 * (noise**2 + RESOLUTION**2 / 12) / 1000)
    # Standard errors of a standard deviation, 1 / sqrt(2 * 200), and of a mean; four and five of them.
    assert (readings.std(dim=0) / expected - 1).abs().max() < 4 / math.sqrt(400)
    assert (readings.mean(dim=0) - true).abs().max() < 5 * expected / math.sqrt(200)


def test_averaged_powers_less_the_noise_have_no_bias_where_the_noise_is_as_loud_as_the_sound():
    true, noise = 0.05, 0.5
    readings = Bench([true, 0], noise=noise * SENSITIVITY, seed=2).sensor(captures=200).read()
    # Power of the phasor's error: 6 s^2 / N. Powers of captures have variance floor^2 + 2 floor true^2.
    floor = 6 * noise**2 / 1000
    assert floor**0.5 == pytest.approx(0.04, rel=0.05)
    error = math.sqrt((floor**2 + 2 * floor * true**2) / 200)
    assert abs(float(readings[0] ** 2) - true**2) < 4 * error
    assert float(readings[1] ** 2) < 4 * floor / math.sqrt(200)


def test_a_microphone_drifts_by_what_was_asked_for():
    sensor = Bench([3.0], points=[0], drift=0.5, seed=3).sensor()
    steps = torch.cat([sensor.read() for _ in range(100)]).log().diff()
    # A walk of rms 0.5 after 1000 captures; 99 steps tell theirs to 1 / sqrt(198), four times which are 28 %.
    assert steps.std() == pytest.approx(0.5 / math.sqrt(1000), rel=0.28)


@pytest.mark.parametrize("dialect", [hw.KEYSIGHT, hw.RIGOL], ids=lambda dialect: dialect.name)
def test_each_input_has_a_scale_on_which_it_uses_a_quarter_of_the_screen_or_more(dialect):
    bench = Bench([0, 0], dialect)
    lines, sensor = bench.record(), bench.sensor()
    for quiet in (0.6, 0.4, 0.7, 0.15, 0.6):
        bench.field.copy_(torch.tensor([3.2 - 1j, 1j * quiet]))
        error = sensor.read() / bench.field.abs() - 1
        # 2 / pi codes of a quarter of 3.5 divisions, as in the test above.
        assert error.abs().max() < 2 / math.pi / (3.5 / 4 * (32 if dialect is hw.KEYSIGHT else 25))
    scales = [float(line.split()[1]) for line in lines if line.startswith(":CHANnel2:SCALe")]
    # For `loudest`; so that 6 mV fill half of 3.5 divisions, 1.5 mV on the finest; four times that for 6 mV.
    # The first capture has 17 codes: what it shows is one and a half more, at most.
    half = 6e-3 / 3.5 * 2
    assert scales == pytest.approx([LOUDEST * SENSITIVITY / 3.5, half, 1e-3, 4e-3], rel=0.1)
    assert sensor.recaptures == 3
    assert sum(line.startswith(":CHANnel1:SCALe") for line in lines) == 1
    assert bench.scope.unknown == []


def test_a_sound_that_is_loud_and_quiet_by_turns_is_read_on_some_scale():
    bench = Bench([3.9], points=[0])
    execute, turns = bench.scope.execute, itertools.cycle([0.1, 3.9])

    def turn(line: str) -> bytes | None:
        if line == ":DIGitize":
            bench.field.fill_(next(turns))
        return execute(line)

    bench.scope.execute = turn
    sensor = bench.sensor()
    for _ in range(5):
        assert sensor.read() == pytest.approx(float(bench.field.abs()), abs=RESOLUTION)


def test_overload_is_an_error_that_names_input_and_pressure():
    bench = Bench([1.0, 6.0])
    with pytest.raises(hw.SensorError, match=r"input 2: \d+ of 1000 samples are clipped.* more than 4 Pa"):
        bench.sensor().read()


def test_silence_is_a_warning_that_names_input_and_noise(caplog):
    bench = Bench([0.1, 0.0], noise=0.1 * SENSITIVITY, seed=0)
    with caplog.at_level(logging.WARNING):
        bench.sensor(captures=10).read()
    warnings = [
        record.getMessage() for record in caplog.records if record.name.endswith(".scope_microphones")
    ]
    assert [text[:8] for text in warnings] == ["input 2:"]
    assert "the noise of 0.0078 Pa" in warnings[0]  # sqrt(6 / N) of the noise of a sample


faults = pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("time-out", "answer :WAVeform|answer .OPC|timed out"),
        ("stall", "Pipe error"),
        ("short", r"\d+ bytes .* a header has 12|\d+ of \d+ bytes in a transfer"),
        ("garbage", r"header .* does not answer request \d+"),
    ],
)


@faults
def test_a_fault_that_stays_on_the_wire_ends_the_trial_silently_and_another_goes_on(trial, fault, message):
    def measure(count: int, last: str | None) -> torch.Tensor:
        instrument.fault = None
        with trial.link(bench) as link, hw.open_scope(CHIP, backend=bench.bus) as oscilloscope:
            microphones = [hw.Microphone(number, SENSITIVITY, loudest) for number in (1, 2)]
            objective = trial.objective(link, hw.ScopeSensor(oscilloscope, FREQUENCY, microphones))
            objective(torch.stack(drives[: count - 1]))
            instrument.fault = last
            return objective(drives[count - 1][None])

    bench = trial.bench()
    instrument = FaultyInstrument(
        *CHIP, "S1", hw.EmulatedScope(bench.pressure, FREQUENCY, SENSITIVITY, [0, 1])
    )
    bench.bus.chips.append(instrument)
    drives = [drive_from_phases(torch.arange(16) * step * 2 * math.pi / 32) for step in range(3)]
    loudest = float(trial.simulated(torch.stack(drives)).max())
    with pytest.raises(hw.LinkError, match=message):
        measure(2, fault)
    assert bench.firmware.drive().abs().max() == 0
    assert len(trial.log.read_text().splitlines()) == 2  # what the trial is, and one evaluation
    expected = trial.simulated(drives[2][None])
    torch.testing.assert_close(measure(3, None), expected, rtol=0, atol=2 / math.pi * loudest / 3.5 / 32)


@faults
def test_a_fault_that_a_clear_mends_costs_a_warning_and_no_reading(fault, message, caplog):
    bench = Bench([3.2, 0.3])
    sensor = bench.sensor()
    before = sensor.read()
    answer, lines = bench.instrument.answer, bench.record()

    def mended(kind: int, request: int) -> bytes | None:
        bench.instrument.fault = None
        return answer(kind, request)

    bench.instrument.answer, bench.instrument.fault = mended, fault
    # Each errs by 2 / pi codes of 28 at most, a quarter of the screen.
    torch.testing.assert_close(sensor.read(), before, rtol=2 * 2 / math.pi / 28, atol=0)
    (warning,) = [record.getMessage() for record in caplog.records if record.name.endswith(".scpi_scope")]
    assert re.search(f"{message}.*; it is cleared, and captures once more", warning)
    # The scales are sent again, as they may have been lost.
    assert sum("SCALe" in line for line in lines) == 2


def test_an_unplugged_oscilloscope_and_one_of_another_maker_are_errors():
    bench = Bench([1.0, 2.0])
    with pytest.raises(hw.LinkError, match="TRIGger:STATus"):  # a Keysight does not know it
        sensor_at(hw.open_scope(CHIP, hw.RIGOL, backend=bench.bus), 2).read()
    sensor = bench.sensor()
    bench.instrument.present = False
    with pytest.raises(hw.LinkError, match="disconnected"):
        sensor.read()


def test_a_capture_that_does_not_come_is_not_taken_for_the_last():
    bench = Bench([1.0, 2.0], hw.RIGOL)
    sensor = bench.sensor()
    sensor.read()
    execute = bench.scope.execute
    bench.scope.execute = lambda line: None if line == ":TFORce" else execute(line)
    with pytest.raises(hw.LinkError, match=r"answer :WAVeform:PREamble\?.*time-out"):
        sensor.read()


def test_one_microphone_is_moved_from_point_to_point():
    def move(question: str) -> str:
        asked.append(question)
        bench.scope.points[0] = len(asked) - 1
        return ""

    asked: list[str] = []
    bench = Bench([1.0, 2.0], points=[0])
    sensor = hw.MovedMicrophone(bench.sensor(), [(0.08, 0.01, 0), (0.08, -0.02, 5e-3)], move)
    assert sensor.read() == pytest.approx([1.0, 2.0], abs=RESOLUTION)
    assert asked[1] == (
        "Move the microphone to control point 2 of 2 at (80.0, -20.0, 5.0) mm, then press Enter. "
    )


def test_a_method_finds_the_simulations_focus_through_a_noisy_oscilloscope(trial):
    bench = trial.bench()
    matrix = trial.simulated.transfer_matrix
    # 30 dB below the rms pressure over control points and random phases, in every sample.
    noise = SENSITIVITY * random_rms(matrix) * 10 ** (-30 / 20)
    scope = hw.EmulatedScope(bench.pressure, FREQUENCY, SENSITIVITY, [0, 1], noise=noise, drift=0.01)
    scope.plug_into(bench, CHIP)
    loudest = float(matrix.abs().sum(dim=1).max())
    with trial.link(bench) as link, hw.open_scope(CHIP, backend=bench.bus) as oscilloscope:
        microphones = [hw.Microphone(number, SENSITIVITY, loudest) for number in (1, 2)]
        sensor = hw.ScopeSensor(oscilloscope, FREQUENCY, microphones)
        solution = gabs(trial.objective(link, sensor), levels=4)
    expected = gabs(trial.played(), levels=4).score
    assert float(trial.simulated(solution.drive).min()) == pytest.approx(float(expected), rel=0.05)


@pytest.mark.parametrize("microphones", [[], [hw.Microphone(1, 0.01, 1.0), hw.Microphone(1, 0.01, 1.0)]])
def test_microphones_at_one_input_are_refused(microphones):
    with pytest.raises(ValueError, match=r"microphones: .*at different inputs"):
        hw.ScopeSensor(Bench([1.0, 2.0]).open, FREQUENCY, microphones)


SIZES = st.one_of(
    st.floats(-330, 308).map(lambda power: 10.0**power),
    *[st.floats(-10, 6).map(lambda power: 10.0**power)] * 3,
)
MATRIX = torch.polar(torch.ones(2, 16).double(), torch.arange(32.0).double().view(2, 16))


@given(SIZES, SIZES, SIZES)
@example(1.0, 10.0, 1.75)  # at the coarsest scale
def test_an_oscilloscope_reads_what_it_can_resolve_or_says_why_not(sensitivity, gain, loudest):
    bench = hw.EmulatedBench(hw.SONICSURFACE, MATRIX, range(16))
    try:
        microphones = [hw.Microphone(number, sensitivity, loudest, gain) for number in (1, 2)]
    except ValueError as error:
        assert str(error).startswith(("sensitivity", "gain", "loudest"))  # noqa: PT017
        return
    hw.EmulatedScope(bench.pressure, FREQUENCY, sensitivity * gain, (0, 1)).plug_into(bench, CHIP)
    truth = MATRIX.sum(dim=1).abs()
    with (
        hw.open_scope(CHIP, backend=bench.bus) as scope,
        hw.open_link(hw.SONICSURFACE, range(16), backend=bench.bus) as link,
    ):
        sensor = hw.ScopeSensor(scope, FREQUENCY, microphones)
        link.play(torch.ones(16).cdouble())
        try:
            read = sensor.read()
        except hw.SensorError as error:
            assert "clipped" in str(error)  # noqa: PT017
            assert truth.max() > 0.9 * loudest
            return
    step = 8 * 1e-3 / 256 / (sensitivity * gain)  # of the converter on its finest scale [Pa]
    assert read.isfinite().all()
    torch.testing.assert_close(read, truth, rtol=0.05, atol=2 * step)
