"""The lock-in, and the sensors that people and other programs are."""

import math
import os
import select
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.hardware import FileSensor, ManualSensor, MovedMicrophone, Quantity, SensorError
from autdtorch.hardware.safety import Signalled, ended_by_signals
from autdtorch.hardware.sensors import file_sensor
from autdtorch.hardware.sensors.by_hand import typed
from autdtorch.hardware.sensors.scope_microphones import LockIn

POINTS = [(0.08, 0.01, 0.0), (0.08, -0.02, 5e-3)]


@settings(max_examples=30, deadline=None)
@given(periods=st.floats(2, 60), phase=st.floats(-4, 4), offset=st.floats(-10, 10))
def test_a_sine_with_an_offset_is_found_exactly_in_any_number_of_periods(periods, phase, offset):
    step = periods / 1000 / 40e3
    angle = 2 * math.pi * 40e3 * step * torch.arange(1000, dtype=torch.float64)
    fit = LockIn(40e3, step, 1000)(offset + 0.3 * torch.stack([(angle + phase).cos(), (angle - phase).cos()]))
    # Re(p e^{-i w t}) = cos(w t + phase) for p = e^{-i phase}; rounding of the offset and the angle.
    expected = 0.3 * torch.tensor([phase, -phase], dtype=torch.float64).mul(-1j).exp()
    torch.testing.assert_close(fit.phasor, expected, rtol=0, atol=1e-12)
    assert fit.residual.max() < 1e-12


@pytest.mark.parametrize("periods", [10.25, 12.3, 40.5])
def test_a_ramp_of_slow_drift_is_kept_out_by_the_window(periods):
    ramp = torch.linspace(-0.5, 0.5, 4000, dtype=torch.float64)
    fit = LockIn(40e3, periods / 4000 / 40e3, 4000)(ramp)
    # The window ends with a second derivative of 2 (pi / T)^2, so that the ramp's integral against e^{iwt} is
    # at most 2 (pi / T)^2 / w^3, and the phasor 4 / T of that; without a window it were 1 / (pi periods).
    # A tenth more for the fit of the offset and for terms beyond the leading one.
    assert fit.phasor.abs() < 1.1 / (math.pi * periods**3)


@pytest.mark.parametrize(
    ("step", "samples", "message"),
    [(1.25e-5, 1000, "step: .* must be < 1.25e-05"), (1e-6, 49, "samples: 49; must be >= 50, two periods")],
)
def test_too_few_samples_a_period_or_periods_are_refused(step, samples, message):
    with pytest.raises(ValueError, match=message):
        LockIn(40e3, step, samples)


def test_a_manual_sensor_asks_for_each_point_until_the_answer_is_a_pressure():
    answers = iter(["12.5", "1,5", "-1", "nan", "3e2"])
    questions: list[str] = []

    def ask(question: str) -> str:
        questions.append(question)
        return next(answers)

    assert ManualSensor(POINTS, ask).read().tolist() == [12.5, 300.0]
    assert questions[0] == "Pressure at control point 1 of 2 at (80.0, 10.0, 0.0) mm [Pa]: "
    balance = ManualSensor(
        POINTS[:1], lambda question: questions.append(question) or "2", Quantity("force", "mN")
    )
    assert balance.read().tolist() == [2.0]
    assert questions.pop().startswith("Force at control point 1 of 1 at (80.0, 10.0, 0.0) mm [mN]: ")
    for question, answer in zip(questions[2:], ("1,5", "-1", "nan"), strict=True):
        assert question.startswith(f"'{answer}': must be a number >= 0")


def test_the_instrument_of_a_person_may_read_another_quantity():
    questions: list[str] = []

    def ask(question: str) -> str:
        questions.append(question)
        return "2"

    balance = ManualSensor(POINTS[:1], ask, Quantity("force", "mN"))
    assert MovedMicrophone(balance, POINTS[:1], lambda question: "").read().tolist() == [2.0]
    assert questions == ["Force at control point 1 of 1 at (80.0, 10.0, 0.0) mm [mN]: "]


def test_the_end_of_the_input_and_a_sensor_of_several_points_that_moves_are_errors():
    def ask(question: str) -> str:
        raise EOFError

    for silent in (ManualSensor(POINTS, ask), MovedMicrophone(ManualSensor(POINTS[:1], ask), POINTS, ask)):
        with pytest.raises(SensorError, match="nobody answers"):
            silent.read()
    with pytest.raises(ValueError, match=r"of the sensor: .*must be 1 numbers"):
        MovedMicrophone(ManualSensor(POINTS, lambda question: "1"), POINTS, lambda question: "").read()


def running(monkeypatch, path: Path, *contents: str | None) -> None:
    """Let another program write `contents` one by one, each while the sensor sleeps, for 1 s of its time."""

    def sleep(seconds: float) -> None:
        nonlocal now
        now += 1.0
        content = next(waiting, None)
        if content is not None:
            written = path.with_suffix(".new")
            written.write_text(content)
            written.replace(path)

    now, waiting = 0.0, iter(contents)
    monkeypatch.setattr(file_sensor, "time", SimpleNamespace(sleep=sleep, monotonic=lambda: now))


def test_a_file_is_read_once_it_has_changed_and_is_whole(tmp_path, monkeypatch):
    path = tmp_path / "reading.txt"
    path.write_text("9 9\n")
    # What comes while the field settles is of the drive before.
    running(monkeypatch, path, "8 8\n", None, "1.5, 2", "1.5, 2.5\n", "7 7\n")
    assert FileSensor(path, 2, settle=0.1).read().tolist() == [1.5, 2.5]


def test_a_tared_balance_may_read_below_zero_in_silence_where_a_pressure_may_not(tmp_path, monkeypatch):
    path, force = tmp_path / "reading.txt", Quantity("force", "mN")
    running(monkeypatch, path, None, "-0.01 0.3\n")
    assert FileSensor(path, 2, quantity=force).read().tolist() == [0.0, 0.3]
    assert ManualSensor(POINTS[:1], lambda _: "-0.02", force).read().tolist() == [0.0]


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ([], "reading.txt did not change, within 5 s"),
        ([None, "1 2 3\n"], "holds no reading: pressure: .*must be 2 numbers >= 0, within 5 s"),
        ([None, "1 -2\n"], r"holds no reading: pressure: \(1\.0, -2\.0\) Pa"),
    ],
)
def test_a_file_that_does_not_change_or_holds_something_else_is_an_error_in_time(
    tmp_path, monkeypatch, contents, message
):
    path = tmp_path / "reading.txt"
    running(monkeypatch, path, *contents)
    with pytest.raises(SensorError, match=message):
        FileSensor(path, 2, timeout=5).read()


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
def test_a_signal_just_before_the_wait_for_an_answer_is_not_missed(monkeypatch):
    def interrupted(*_: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    terminal, behind = os.openpty()
    with os.fdopen(terminal, "w") as keyboard, os.fdopen(behind) as answers:
        monkeypatch.setattr("sys.stdin", answers)
        keyboard.write("1.5\n")
        keyboard.flush()
        assert typed("how much? ") == "1.5"
        monkeypatch.setattr(select, "select", interrupted)
        with ended_by_signals(), pytest.raises(Signalled):
            typed("how much? ")


@pytest.mark.parametrize("stream", [None, "closed"])
def test_without_an_input_nobody_answers(monkeypatch, tmp_path, stream):
    if stream == "closed":
        stream = (tmp_path / "input").open("w+")
        stream.close()
    monkeypatch.setattr("sys.stdin", stream)
    with pytest.raises(SensorError, match="nobody answers"):
        ManualSensor(POINTS).read()
