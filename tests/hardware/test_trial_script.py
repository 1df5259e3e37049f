"""The script of a trial: what it leaves and shows, and how it ends."""

import io
import logging
import math
import re
from pathlib import Path

import hardware_trial
import pytest
import torch
import trial_bench

from autdtorch.array import TransducerArray
from autdtorch.drive_file import load_drive
from autdtorch.hardware_report import compare
from autdtorch.scene_file import load_scene

SCENE = """
name: two
frequency: 40e3
medium: {density: 1.2, sound_speed: 340.0}
array: {type: grid, shape: [3, 3], pitch: 10.5e-3, center: [0, 0, 0], normal: [1, 0, 0]}
control_points: {type: points, positions: [[80e-3, 10e-3, 0.0], [80e-3, -20e-3, 5e-3]]}
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    scene = tmp_path / "two.yaml"
    scene.write_text(SCENE)
    caplog.set_level(logging.INFO)

    def run_script(*words: str) -> int:
        given = ["hardware_trial.py", "--scene", str(scene), "--output", str(tmp_path / "out"), *words]
        monkeypatch.setattr("sys.argv", given)
        return hardware_trial.main()

    return run_script


EMULATED = ("--device", "emulated", "--method", "gabs", "--set", "levels=4", "--amplitude-limit", "1")


def test_a_trial_leaves_log_drive_and_report_and_is_not_repeated(run, tmp_path: Path, caplog):
    assert run(*EMULATED, "--dead", "4") == 0
    assert "the sensor hears 8 of 9" in caplog.text
    out = tmp_path / "out"
    log = (out / "trial.jsonl").read_text()
    assert log.count("\n") == 1 + 1 + 8 * 4
    assert run(*EMULATED, "--dead", "4") == 0
    assert (out / "trial.jsonl").read_text() == log
    report = (out / "report.md").read_text()
    assert "**Not heard**, counted from 0: 4." in report
    heard = re.search(r"with (\S+) to .* Pa, and the threshold (\S+) Pa", report, re.DOTALL)
    assert heard is not None
    assert float(heard[1]) > float(heard[2])  # the range is that of the transducers that are heard
    assert report.count("| 1.000 |") == 3  # the simulation is told
    assert (out / "convergence.png").exists()
    assert len(load_drive(out / "drive.npz")) == 9

    assert run(*EMULATED) == 2
    assert "of another trial, whose dead is [4], not []" in caplog.text


def test_without_noise_the_report_says_that_it_is_the_simulation(run, tmp_path: Path):
    assert run(*EMULATED) == 0
    report = (tmp_path / "out" / "report.md").read_text()
    assert "transducers driven as in the simulated trial: 9 of 9" in report
    assert report.count("| 1.000 |") == 3


def test_an_oscilloscope_on_the_emulated_bus_is_the_sensor(run, tmp_path: Path, caplog):
    assert run(*EMULATED, "--sensor", "scope", "--method", "lssg") == 0
    assert "the sensor hears 9 of 9" in caplog.text
    assert "cannot be told from the noise" not in caplog.text  # of silence, nothing else is expected
    misfit = re.search(r"differ by\s+(\S+) %", (tmp_path / "out" / "report.md").read_text())
    assert misfit is not None
    assert 0 < float(misfit[1]) < 5  # 8 bits for 20 Pa, where there is 1 Pa


def test_a_dry_run_shows_the_frames_and_leaves_nothing(run, tmp_path: Path, capsys):
    assert run(*EMULATED, "--dry-run", "--device", "sonicsurface", "--transducers", "0-2,16-18,32-34") == 0
    lines = capsys.readouterr().out.splitlines()
    frames, decoded = lines[::2], lines[1::2]
    assert all(re.fullmatch("fe( [0-9a-f]{2}){256} fd", frame) for frame in frames)
    assert decoded[0] == decoded[-1] == "  all off"
    assert "  16: 1 at 0" in decoded  # each transducer alone, in the pre-flight check
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (("--max-evaluations", "5"), 3, "5 evaluations are made, the limit: the outputs are off"),
        (("--amplitude-limit", "0.5"), 2, "amplitude: 0.5; must be >= 1"),
        (("--set", "level=4"), 2, "unknown key 'level'; gabs has first, levels, order, passes"),
        (("--device", "openmpd"), 2, "--sensor: None; must be scope, file or manual on a real device"),
        (("--dead", "0-8"), 2, "the sensor hears no transducer"),
        (("--scene", "nowhere"), 2, "--scene: nowhere: no such file; must be a YAML file, or one of homo"),
        (
            ("--device", "sonicsurface", "--sensor", "manual"),
            2,
            "must say which 9 of the 256 transducers of SonicSurface",
        ),
    ],
)
def test_a_trial_that_may_not_be_made_ends_with_one_line(run, caplog, words, status, message):
    assert run(*EMULATED, *words) == status
    assert message in caplog.messages[-1]


def test_no_trial_without_an_amplitude_limit(run, capsys):
    with pytest.raises(SystemExit):
        run("--device", "emulated", "--method", "gabs")
    assert "--amplitude-limit" in capsys.readouterr().err


def test_transducers_that_count_down_are_refused(run, capsys):
    with pytest.raises(SystemExit):
        run(*EMULATED, "--transducers", "5-3")
    assert "'5-3'; must be numbers and ranges that go up" in capsys.readouterr().err


def test_a_person_reads_each_transducer_and_the_silence_once(run, monkeypatch):
    points, evaluations = 2, 1 + 8 * 4
    answers = io.StringIO("0\n" * points + "1\n" * points * (9 + evaluations) + "0\n" * points)
    monkeypatch.setattr("sys.stdin", answers)
    assert run(*EMULATED, "--sensor", "manual") == 0
    assert not answers.read()


def test_the_factor_between_simulation_and_bench_is_found():
    simulated = torch.rand(20, 3, dtype=torch.float64) + 1
    fit = compare(2.5 * simulated, simulated)
    assert fit.scale == pytest.approx(2.5, rel=1e-12)
    assert fit.misfit < 1e-12


def test_the_documented_scene_lies_in_the_middle_of_a_sonicsurface(tmp_path: Path):
    """With the device turned as the documentation says, for the transducers of its command."""
    text = (Path(__file__).parents[2] / "docs" / "hardware.md").read_text("utf-8")
    block = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    chosen = re.search(r"--transducers (\S+)", text)
    assert block is not None
    assert chosen is not None
    path = tmp_path / "my_bench.yaml"
    path.write_text(block[1], "utf-8")
    device = TransducerArray.sonicsurface(center=(0, 0, 0), angle=math.pi / 2)
    places = device.positions[trial_bench.indices(chosen[1])]
    assert torch.allclose(
        load_scene(path).array.positions, places, rtol=0, atol=1e-9
    )  # rounding; pitch 1e-2 m
