"""Hardware trials from the command line: what they leave and show, and how they end."""

import errno
import io
import json
import math
import re
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from filelock import FileLock

import autdtorch.cli.hardware_command
from autdtorch.cli.configured_bench import indices_of
from autdtorch.hardware import LinkError, OffError, Picture
from autdtorch.io.drive_file import load_drive
from autdtorch.io.picture_file import PICTURES, load_picture, save_picture
from autdtorch.io.readings_file import load_readings
from autdtorch.io.scene_file import load_scene
from autdtorch.objectives.goals import TargetPressures, WeakestFocus
from autdtorch.objectives.quiet import QuietPoints
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import Plane
from autdtorch.study.report.hardware_report import compare

EMULATED = ("hardware=emulated", "hardware.limits.amplitude=1")
GABS = (*EMULATED, "method.levels=4")


def test_a_trial_leaves_log_drive_and_report_and_is_not_repeated(trial, drawn, tmp_path):
    status, printed, log = trial(*GABS, "hardware.failed=[4]")
    assert (status, "8 of 9 transducers work" in log) == (0, True)
    out = tmp_path / "out"
    assert str(Path("out") / "report.md") in printed
    _, *evaluations, _ = lines = (out / "trial.jsonl").read_text().splitlines()
    assert len(evaluations) == 1 + 8 * 4
    assert trial(*GABS, "hardware.failed=[4]")[0] == 0
    assert (out / "trial.jsonl").read_text().splitlines()[:-1] == lines  # and the second run's end
    report = (out / "report.md").read_text()
    assert "**Failed transducers**, counted from 0: 4." in report
    working = re.search(r"with (\S+) to .* Pa, and the threshold (\S+) Pa", report, re.DOTALL)
    assert working is not None
    assert float(working[1]) > float(working[2])
    assert report.count("| 1.000 |\n") == 3  # without noise the readings are the simulation's
    assert (out / "convergence.png").exists()
    # The emulated bench is the simulation, but for the failed transducer, which plays nothing.
    held = re.search(r"held back from the fit: (\S+) % off with fitted .* phases, (\S+) % with one", report)
    assert held is not None
    assert max(map(float, held.groups())) < 0.5
    assert (out / "calibration.png").exists()
    assert len(load_drive(out / "drive.npz")) == 9

    status, _, log = trial(*GABS)
    assert status == 2
    assert "of another trial, whose failed is [4], not []" in log


def test_the_pictures_of_a_trial_are_in_its_report(trial, tmp_path):
    plane = Plane((80e-3, 0, 0), (1, 0, 0), (0.06, 0.06))
    pressure = torch.full((12, 12), 1.0, dtype=torch.float64)
    picture = Picture(plane, pressure, 0.02 * pressure, relative=True, doubts=("3 frames are missing",))
    save_picture(tmp_path / "out" / PICTURES / "again_0.npz", picture)
    assert trial(*GABS)[0] == 0
    report = (tmp_path / "out" / "report.md").read_text()
    assert re.search(r"## The plane\n\n!\[.*\]\(plane\.png\)\n\nThe mean of 1 picture of", report)
    assert "a deviation of 2 %.\nThe screen is not calibrated" in report
    assert "\n\n- 3 frames are missing\n\n" in report
    assert (tmp_path / "out" / "plane.png").exists()


def test_a_calibration_that_fails_does_not_spoil_a_trial(trial, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("the factorisation failed")

    monkeypatch.setattr(autdtorch.cli.hardware_command, "calibrate", fail)
    status, _, log = trial(*GABS, "hardware.sensor.snr=30")
    assert (status, "no calibration: the factorisation failed" in log) == (0, True)
    report = (tmp_path / "out" / "report.md").read_text()
    assert "## Calibration\n\nNone: the factorisation failed.\n" in report
    assert "held back" not in report


def test_the_log_of_a_running_trial_is_refused_before_a_device_is_touched(trial, tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    monkeypatch.setattr("autdtorch.hardware.Link", None)
    with FileLock(tmp_path / "out" / ".trial.jsonl.lock"):  # as another process has it
        status, _, log = trial(*GABS)
    assert (status, "another process has it open for a trial" in log) == (2, True)
    assert not (tmp_path / "out" / "trial.jsonl").exists()


def test_an_oscilloscope_on_the_emulated_bus_is_the_sensor(trial, tmp_path):
    status, _, log = trial(*EMULATED, "hardware/sensor=scope", "method=lssg")
    assert (status, "9 of 9 transducers work" in log) == (0, True)
    misfit = re.search(r"differ by\s+(\S+) %", (tmp_path / "out" / "report.md").read_text())
    assert misfit is not None
    assert 0 < float(misfit[1]) < 5  # 8 bits for 20 Pa, at pressures of 1 Pa


def test_a_dry_run_shows_the_frames_and_leaves_nothing(trial, tmp_path):
    words = ("hardware=sonicsurface", "hardware.dry_run=true", "hardware.transducers='0-2,16-18,32-34'")
    status, printed, _ = trial(*GABS[1:], *words)
    assert status == 0
    lines = printed.splitlines()
    assert all(re.fullmatch("fe( [0-9a-f]{2}){256} fd", frame) for frame in lines[::2])
    assert lines[1] == lines[-1] == "  all off"
    assert "  16: 1 at 0" in lines  # each transducer alone, in the pre-flight check
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "goal"),
    [
        (("goal=target_pressures", "goal.targets=[2,1]"), TargetPressures([2, 1])),
        (("goal=quiet_points", "goal.points=[1]", "goal.ratio=0.1"), QuietPoints(WeakestFocus(), [1], 0.1)),
    ],
)
def test_a_trial_maximises_its_goal(trial, tmp_path, words, goal):
    status, printed, _ = trial(*GABS, *words)
    assert status == 0
    lines = (tmp_path / "out" / "trial.jsonl").read_text().splitlines()[1:-1]
    pressure = torch.tensor([json.loads(line)["pressure"] for line in lines], dtype=torch.float64)
    score = f"{float(goal(pressure).max()):#.4g} {goal.unit}".rstrip()
    report = (tmp_path / "out" / "report.md").read_text()
    assert f"{score}** when the drive was played again, {score} in the search" in report
    assert f"{float(goal(pressure).max()):.4g}" in printed
    status, _, log = trial(*GABS, "goal=mean_pressure")
    assert (status, "of another trial, whose goal is" in log) == (2, True)


def test_a_trial_goes_on_from_the_readings_of_another(trial, tmp_path):
    words = (*EMULATED, "method=identify")
    few = (*words, "method.evaluations=3", "readings=out")
    assert trial(*words, "method.evaluations=26")[0] == 0
    assert trial(*few, folder="output=next")[0] == 0
    lines = (tmp_path / "next" / "trial.jsonl").read_text().splitlines()
    assert len(lines) == 1 + 3 + 1  # settings, evaluations and end
    first, then = (
        json.loads((tmp_path / f / "trial.jsonl").read_text().splitlines()[-2]) for f in ("out", "next")
    )
    assert min(then["pressure"]) > 0.99 * min(first["pressure"])  # without noise: the optimum, to the levels
    assert trial(*few, folder="output=next")[0] == 0
    assert len((tmp_path / "next" / "trial.jsonl").read_text().splitlines()) == len(lines) + 1
    status, _, log = trial(*words, "method.evaluations=3", folder="output=alone")
    assert (status, "evaluations: 3; must be an integer >= 22" in log) == (2, True)
    status, _, log = trial("method=gabs", "readings=out")
    assert (status, "must be null: only a hardware trial" in log) == (2, True)


OPENMPD = ("hardware=openmpd", "hardware.limits.amplitude=1", "hardware.transducers='0-8'")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("hardware=emulated",), "hardware.limits.amplitude: none; must be given"),
        ((*GABS, "hardware.limits.amplitude=0.5"), "hardware.limits: amplitude: 0.5; must be >= 1"),
        ((*GABS, "+hardware.limits.loudness=3"), "loudness"),
        ((*GABS, "+hardware.colour=red"), "hardware: unknown key 'colour'"),
        (
            (*OPENMPD, "hardware/sensor=emulated"),
            "hardware.sensor: 'emulated'; must be scope, file, manual or",
        ),
        ((*OPENMPD, "hardware/sensor=file"), "hardware.sensor.path: none; must be given"),
        ((*OPENMPD, "hardware/sensor=camera"), "hardware.sensor.corners: None; must be the pixels"),
        (
            (*OPENMPD, "hardware/sensor=camera", "hardware.sensor.corners=[[0,0],[0,9],[9,0],[9,9]]"),
            "hardware.sensor.path: None; must be the folder",
        ),
        (
            (*EMULATED, "hardware/sensor=camera", "hardware.sensor.path=frames"),
            "hardware.sensor.path: 'frames'; must be null, as of an emulated camera",
        ),
        (
            (*EMULATED, "hardware/sensor=camera", "hardware.sensor.scale=0.1"),
            "hardware.sensor.scale: 0.1; must be 0.01, as",
        ),
        ((*EMULATED, "hardware/sensor=camera", "hardware.sensor.screen.heating=-1"), "Screen.heating: -1"),
        (
            (*EMULATED, "hardware/sensor=camera"),
            "scene.observation_plane: None; must be the plane of the screen",
        ),
        (OPENMPD, "hardware.sensor.chip: None; must be the oscilloscope's VID:PID"),
        ((*OPENMPD, "hardware.sensor.chip=1:2:3"), "hardware.sensor.chip: '1:2:3'; must be VID:PID"),
        ((*OPENMPD, "hardware/sensor=manual", "hardware.failed=[1]"), "hardware.failed: (1,); must be null"),
        ((*GABS, "hardware.failed='0-9'"), "must be numbers of the scene's transducers from 0 to 8"),
        ((*GABS, "hardware.transducers='0-7'"), "hardware.transducers: '8 transducers'; must be 9"),
        (
            (*GABS, "hardware.transducers='5-3'"),
            "hardware.transducers: '5-3'; must be numbers of the device's",
        ),
        (
            (*GABS, "hardware.transducers='0-99999999999'"),
            "must be numbers of the device's transducers from 0 to 255, each once, and ranges",
        ),
        ((*GABS, "hardware.boards=2"), "hardware.boards: 2; must be null: it is for autd3, openmpd and"),
        ((*GABS, "hardware.network=eth0"), "hardware.network: 'eth0'; must be null: it is for autd3"),
        ((*GABS, "hardware.sensor.snr=nan"), "hardware.sensor.snr: nan; must be"),
        ((*GABS, "hardware.device=openmpd", "hardware.boards=[a.pat]"), "hardware.boards: 'a.pat'; no such"),
        ((*GABS, "hardware.device=autd3", "hardware.boards=two"), "hardware.boards: 'two'; must be an int"),
        ((*GABS, "hardware.failed='0-8'"), "hardware.sensor: 0 Pa from the strongest transducer; must be"),
        (("hardware=sonicsurface", "hardware/sensor=manual", GABS[1]), "transducers: None; must say which 9"),
        (
            (*GABS, "goal=target_pressures", "goal.targets=[1,2,3]"),
            "goal: targets: (1.0, 2.0, 3.0); must be 2",
        ),
        ((*GABS, "hardware=nowhere"), "hardware: 'nowhere'; must be one of autd3, emulated"),
    ],
)
def test_a_trial_that_may_not_be_made_ends_with_one_line(trial, words, message):
    status, _, log = trial(*words)
    assert (status, message in log) == (2, True)


def test_a_sweep_of_trials_is_refused(trial):
    status, _, log = trial(*GABS, "-m", folder="hydra.sweep.dir=out")
    assert (status, "hardware: a sweep; must be one trial at a time" in log) == (2, True)


def test_with_a_prior_few_evaluations_find_how_the_transducers_deviate(trial, monkeypatch):
    methods = [("method=identify",), ("method=bo_foci", "method.initial=2", "method.fixed_transducer=0")]
    generator = torch.Generator().manual_seed(0)
    gain, phase = torch.randn(2, 9, dtype=torch.float64, generator=generator)
    deviation = torch.polar((0.1 * gain).exp(), 0.7 * phase)
    emulate = autdtorch.hardware.EmulatedBench

    def deviating(device, matrix, *rest, **named):
        return emulate(device, matrix * deviation, *rest, **named)

    def measured(*words):
        status, printed, _ = trial(*EMULATED, *words)
        assert status == 0
        return float(re.search(r"weakest focus (\S+) Pa", printed)[1])

    monkeypatch.setattr("autdtorch.hardware.EmulatedBench", deviating)
    simulated = measured("method=gradient", "output=simulated")
    few = 9  # of the 3 M - 1 = 26 that a trial without a prior needs
    for number, method in enumerate(methods):
        words = (f"method.evaluations={few}", "method.prior={gain: 0.1, phase: 0.7}", f"output=out{number}")
        assert measured(*method, *words) > 1.2 * simulated


def test_a_drive_that_reads_less_than_the_first_one_is_told(trial, monkeypatch, tmp_path):
    words = (*EMULATED, "method.levels=2")
    assert "first drive" not in trial(*words)[2]
    solve = autdtorch.cli.hardware_command.solve

    def fainter(*arguments, **named):
        solution = solve(*arguments, **named)
        return replace(solution, drive=0.01 * solution.drive)

    monkeypatch.setattr(autdtorch.cli.hardware_command, "solve", fainter)
    status, _, log = trial(*words, "output=fainter")
    assert (status, "the first drive of the search read more: weakest focus" in log) == (0, True)
    assert "**the first drive of the search read more**" in (tmp_path / "fainter/report.md").read_text()


def test_a_limit_ends_a_trial_with_a_status_of_its_own(trial):
    status, _, log = trial(*GABS, "hardware.limits.evaluations=5")
    assert (status, "5 evaluations are made, the limit; the outputs are off" in log) == (3, True)


@pytest.fixture
def fail_at(monkeypatch):
    """Has the method fail in the simulation (0) or on the bench (1)."""

    def arrange(call, fail):
        real, calls = autdtorch.cli.hardware_command.solve, []

        def solve(*arguments, **keywords):
            calls.append(None)
            if len(calls) == call + 1:
                fail()
            return real(*arguments, **keywords)

        monkeypatch.setattr(autdtorch.cli.hardware_command, "solve", solve)

    return arrange


OFF = "; the outputs are off, and the same command goes on where the log ends"


@pytest.mark.parametrize(("call", "message"), [(0, ""), (1, OFF)])
def test_a_signal_speaks_of_the_device_only_once_it_was_opened(trial, fail_at, call, message):
    fail_at(call, lambda: signal.raise_signal(signal.SIGTERM))
    status, _, log = trial(*GABS)
    assert (status, log.splitlines()[-1]) == (143, f"autdtorch: SIGTERM{message}")


@pytest.mark.parametrize("left_on", [False, True])
def test_an_error_in_mid_trial_says_whether_the_outputs_are_off(trial, fail_at, left_on):
    def fail():
        error = OSError(errno.ENOSPC, "No space left on device", "there.jsonl")
        error.__context__ = OffError("they may still be on") if left_on else LinkError("stall")
        raise error

    fail_at(1, fail)
    status, _, log = trial(*GABS)
    then = "; they may still be on" if left_on else OFF
    assert (status, log.splitlines()[-1]) == (2, f"autdtorch: there.jsonl: No space left on device{then}")


def test_readings_of_a_trial_with_other_amplitudes_are_refused(trial):
    words = "hardware=emulated", "hardware.device=openmpd", "method=random", "method.evaluations=3"
    assert trial(*words, "hardware.limits.amplitude=1")[0] == 0
    for source, other, message in (
        ("out", "hardware.limits.amplitude=0.6", "largest amplitude 1.0'; .* the largest amplitude 0.5"),
        ("out/trial.jsonl", "hardware.device=autd3", "device OpenMPD'; .* the device AUTD3"),
        ("out", "hardware.transducers='1-9'", "transducers .*; .* the transducers .1, 2,"),
    ):
        again = "hardware.limits.amplitude=1", other, f"readings={source}"
        status, _, log = trial(*words, *again, folder="output=next")
        assert (status, bool(re.search(message, log))) == (2, True), log


def test_a_person_reads_each_transducer_and_the_silence_once(trial, monkeypatch):
    points, evaluations = 2, 1 + 8 * 4
    answers = io.StringIO("0\n" * points + "1\n" * points * (9 + evaluations + 1) + "0\n" * points)
    monkeypatch.setattr("sys.stdin", answers)
    status, printed, log = trial(*GABS, "hardware/sensor=manual")
    assert status == 0
    assert not answers.read()
    assert printed.count("Pressure at control point 1 of 2") == 1 + 9 + evaluations + 2
    assert "pre-flight check: transducer 3 of 9" in log


def test_the_script_takes_the_same_settings(trial, monkeypatch, tmp_path):
    import hardware_trial

    monkeypatch.setattr("sys.argv", ["hardware_trial.py", "method=lssg"])
    with pytest.raises(SystemExit) as end:
        hardware_trial.main()
    assert end.value.code == 2  # no amplitude limit: the emulator is the default


def test_the_factor_between_simulation_and_bench_is_found():
    simulated = torch.rand(20, 3, dtype=torch.float64) + 1
    fit = compare(2.5 * simulated, simulated)
    assert fit.scale == pytest.approx(2.5, rel=1e-12)
    assert fit.misfit < 1e-12


def test_the_documented_scene_lies_in_the_middle_of_a_sonicsurface(tmp_path):
    """With the device turned as the documentation says, for the transducers of its command."""
    text = (Path(__file__).parents[2] / "docs" / "hardware.md").read_text("utf-8")
    block = re.search(r"```yaml\n# .*\n(name.*?)```", text, re.DOTALL)
    chosen = re.search(r"transducers[=:] *[\"']*([0-9][0-9,-]+)", text)
    assert block is not None
    assert chosen is not None
    path = tmp_path / "my_bench.yaml"
    path.write_text(block[1], "utf-8")
    device = TransducerArray.sonicsurface(center=(0, 0, 0), angle=math.pi / 2)
    places = device.positions[indices_of("transducers", chosen[1], 256, "the device's")]
    # Rounding, of a pitch of 1e-2 m.
    assert torch.allclose(load_scene(path).array.positions, places, rtol=0, atol=1e-9)


CAMERA = """
name: bright
frequency: 40e3
medium: {density: 1.2, sound_speed: 340.0}
array:
  {type: grid, shape: [2, 2], pitch: 10.5e-3, center: [0, 0, 0], normal: [1, 0, 0], source_strength: 30}
control_points: {type: points, positions: [[40e-3, 6e-3, 0.0], [40e-3, -6e-3, 3e-3]]}
observation_plane: {center: [40e-3, 0, 0], normal: [1, 0, 0], size: [30e-3, 30e-3]}
"""


def test_a_trial_by_camera_keeps_its_pictures(run, write, tmp_path):
    write("ours/scene/bright.yaml", CAMERA)
    folder = tmp_path / "out"
    words = (*EMULATED, "hardware/sensor=camera", "method=gs", "scene=bright", f"output={folder}")
    assert run(*words, f"--config-dir={tmp_path / 'ours'}") == 0
    report = (folder / "report.md").read_text()
    assert "does not see a transducer alone" in report
    factor = re.search(r"fitted by one factor, differ by ([0-9.]+) %", report)
    assert float(factor[1]) < 1.5  # of 50 mK and foci above 1 kPa
    evaluations = (folder / "trial.jsonl").read_text().count("pressure")
    pictures = {path.stem: path for path in (folder / PICTURES).iterdir()}
    names = [f"evaluation_{number:05d}" for number in range(evaluations)]
    assert set(pictures) == {*names, *(f"again_{number}" for number in range(2))}
    last = load_drive(pictures["again_0"])
    assert torch.equal(last, load_drive(folder / "drive.npz"))
    points = load_scene(tmp_path / "ours/scene/bright.yaml").control_points
    pressure, deviation = load_picture(pictures[names[0]]).at(points)
    noise = ((pressure + deviation).square() - pressure.square()).median()
    logged = load_readings(folder).deviation[0]
    # Single precision of the picture's file.
    torch.testing.assert_close(logged, (pressure.square() + noise).sqrt() - pressure, rtol=1e-3, atol=0)
    again = torch.stack([load_picture(pictures[f"again_{n}"]).at(points)[0] for n in range(2)])
    assert f"**{float(again.mean(dim=0).min()):#.4g} Pa**" in report
