"""The script of a trial: what it leaves and shows, and how it ends."""

import errno
import io
import logging
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import hardware_trial
import pytest
import torch
import trial_run
import trial_values
from filelock import FileLock

from autdtorch.hardware import LinkError, OffError
from autdtorch.io.drive_file import load_drive
from autdtorch.io.scene_file import load_scene
from autdtorch.methods.gabs import gabs
from autdtorch.scene.arrays import TransducerArray
from autdtorch.study.report.hardware_report import compare

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
    _, *evaluations, _ = log = (out / "trial.jsonl").read_text().splitlines()
    assert len(evaluations) == 1 + 8 * 4
    assert run(*EMULATED, "--dead", "4") == 0
    assert (out / "trial.jsonl").read_text().splitlines()[:-1] == log  # and the second run's end
    report = (out / "report.md").read_text()
    assert "**Failed transducers**, counted from 0: 4." in report
    heard = re.search(r"with (\S+) to .* Pa, and the threshold (\S+) Pa", report, re.DOTALL)
    assert heard is not None
    assert float(heard[1]) > float(heard[2])  # the range is that of the transducers that are heard
    assert report.count("| 1.000 |\n") == 3  # the simulation is told
    assert (out / "convergence.png").exists()
    assert len(load_drive(out / "drive.npz")) == 9

    assert run(*EMULATED) == 2
    assert "of another trial, whose dead is [4], not []" in caplog.text
    assert caplog.messages[-1].endswith("or another log (--output)")


def test_the_log_of_a_trial_that_runs_is_refused_before_a_device_is_touched(
    run, tmp_path: Path, monkeypatch, caplog
):
    (tmp_path / "out").mkdir()
    monkeypatch.setattr("autdtorch.hardware.open_link", None)
    with FileLock(tmp_path / "out" / ".trial.jsonl.lock"):  # as another process has it
        assert run(*EMULATED) == 2
    assert "another process has it open for a trial" in caplog.messages[-1]
    assert not (tmp_path / "out" / "trial.jsonl").exists()


def test_without_noise_the_report_says_that_it_is_the_simulation(run, tmp_path: Path):
    assert run(*EMULATED) == 0
    report = (tmp_path / "out" / "report.md").read_text()
    assert "transducers driven as in the simulated trial: 9 of 9" in report
    assert report.count("| 1.000 |\n") == 3
    assert report.startswith("# Hardware trial: gabs on SonicSurface, emulated\n")
    assert "| transducers | `0 to 8` |" in report
    assert report.count(") | 1.000 | ") == 2  # the factor at each point


def test_an_oscilloscope_on_the_emulated_bus_is_the_sensor(run, tmp_path: Path, caplog):
    assert run(*EMULATED, "--sensor", "scope", "--method", "lssg") == 0
    assert "the sensor hears 9 of 9" in caplog.text
    assert "within the noise" not in caplog.text  # of silence, nothing else is expected
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
        (("--device", "openmpd"), 2, "--sensor: none; must be scope, file or manual on a real device"),
        (
            ("--device", "openmpd", "--transducers", "0-8", "--sensor", "file"),
            2,
            "--readings-file: none; must be the file of the readings",
        ),
        (
            ("--device", "openmpd", "--transducers", "0-8", "--sensor", "scope"),
            2,
            "--scope-chip: none; must be the VID:PID of the oscilloscope",
        ),
        (("--dead", "0-9"), 2, "--dead: 9; must be 0 to 8, as the scene has them"),
        (("--transducers", "0-7"), 2, "--transducers: 8; must be 9, as many as the scene has"),
        (("--device", "emulated:openmpd", "--boards", "left.pat"), 2, "--boards: left.pat: no such file"),
        (("--device", "emulated:autd3", "--boards", "two"), 2, "--boards: two; must be the number of boards"),
        (
            ("--dead", "0-8"),
            2,
            "hears no transducer: 0 Pa is the most, and must be above 0 Pa; check",
        ),
        (("--dead", "0-8", "--sensor", "scope"), 2, "and the sensor, and try a lower --loudest"),
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--transducers", "5-3"), "--transducers: '5-3'; must be at most 100000 numbers"),
        (("--dead", "0-99999999999999"), "must be at most 100000 numbers, and ranges that go up"),
        (("--amplitude-limit", "0"), "--amplitude-limit: '0'; must be a number > 0 and <= 1"),
        (("--sensor", "scope", "--captures", "0"), "--captures: '0'; must be an integer >= 1"),
        (("--sensor", "scope", "--loudest", "-1"), "--loudest: '-1'; must be a number > 0"),
        (("--snr", "nan"), "--snr: 'nan'; must be a finite number"),
        (("--captures", "1"), "--captures: only for --sensor scope"),  # its default, but given
        (("--scope-chip", "1:2"), "--scope-chip: only for --sensor scope"),
        (("--sensor", "scope", "--moved"), "--moved: only for --sensor scope beside a real device"),
        (("--sensor", "manual", "--snr", "30"), "--snr: only for emulated microphones"),
        (("--device", "openmpd", "--sensor", "manual", "--dead", "1"), "--dead: only for an emulated device"),
        (("--device", "sonicsurface", "--boards", "2"), "--boards: only for openmpd, ultraino and autd3"),
        (("--device", "ultraino", "--network", "eth0"), "--network: only for --device autd3"),
        (("@nowhere.txt",), "@nowhere.txt: No such file or directory; must be a text file of options"),
    ],
)
def test_what_means_nothing_is_one_line_that_names_the_option(run, capsys, words, message):
    with pytest.raises(SystemExit):
        run(*EMULATED, *words)
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line.replace("argument ", "")


def test_a_bench_is_described_in_a_file(run, tmp_path: Path, caplog):
    bench = tmp_path / "my bench.txt"
    bench.write_text("# ours\n--device emulated:openmpd --dead 4  # it fell\n\n--amplitude-limit 0.5\n")
    assert run(f"@{bench}", "--method", "lssg") == 0
    assert "not heard, counted from 0: 4" in caplog.text
    assert (
        "--device emulated:openmpd --dead 4 --amplitude-limit 0.5" in (tmp_path / "out/report.md").read_text()
    )


@pytest.mark.parametrize("device", ["autd3", "openmpd"])
def test_devices_of_boards_find_the_drive_of_the_simulation(run, tmp_path: Path, caplog, device: str):
    if device == "autd3":
        pytest.importorskip("autd3", reason="the kit of AUTD3: install autdtorch[autd3]")
    boards = ["2"] if device == "autd3" else [write_board(tmp_path, name) for name in ("left", "right")]
    words = ("--device", f"emulated:{device}", "--boards", *boards, "--transducers", "251-259")
    assert run(*EMULATED, *words) == 0
    report = (tmp_path / "out" / "report.md").read_text()
    assert "transducers driven as in the simulated trial: 9 of 9" in report
    assert report.count("| 1.000 |\n") == 3
    if device == "openmpd":  # another file of the same name is another board
        write_board(tmp_path, "left", gain=0.5)
        assert run(*EMULATED, *words) == 2
        assert "of another trial, whose boards is ['left " in caplog.text


def write_board(folder: Path, name: str, gain: float = 1.0) -> str:
    path = folder / f"{name}.pat"
    positions = "\n".join(f"({0.0105 * (n % 16)}, {0.0105 * (n // 16)}, 0)" for n in range(256))
    rest = "\n".join(" ".join(map(str, column)) for column in (range(255, -1, -1), [0] * 256, [gain] * 256))
    path.write_text(f"{name}\n256\n128\n{positions}\n{rest}\n")
    return str(path)


INTERRUPTED_IMPORT = """
import runpy, signal, sys
class Finder:
    def find_spec(self, name, path, target=None):
        if name == "torch":
            signal.raise_signal(signal.SIGINT)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background processes ignore it
sys.meta_path.insert(0, Finder())
runpy.run_path(sys.argv[1], run_name="__main__")
"""


def test_ctrl_c_during_the_imports_is_one_line():
    path = [str(Path(hardware_trial.__file__).parent), *sys.path]
    ended = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_IMPORT, hardware_trial.__file__],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path)},
        capture_output=True,
        check=False,
        text=True,
    )
    assert (ended.returncode, ended.stderr) == (130, "hardware_trial: SIGINT\n")


@pytest.mark.parametrize(
    ("calls", "message"),
    [(0, ""), (1, ": the outputs are off, and the same command goes on where the log ends")],
)
def test_a_signal_speaks_of_the_device_only_once_it_was_opened(run, monkeypatch, caplog, calls, message):
    def interrupted(objective, **_: object):
        if not left:
            signal.raise_signal(signal.SIGTERM)
        left.pop()
        return gabs(objective)

    left = [None] * calls  # the first is in the simulation
    monkeypatch.setitem(trial_run.METHODS, "gabs", interrupted)
    assert run("--device", "emulated", "--method", "gabs", "--amplitude-limit", "1") == 143
    assert caplog.messages[-1] == f"hardware_trial: SIGTERM{message}"


@pytest.mark.parametrize("words", [(), ("--dry-run",)])
def test_without_pyusb_an_emulated_trial_ends_with_the_hint(run, monkeypatch, caplog, words):
    emulated = "autdtorch.hardware.emulat", "autdtorch.hardware.emulator.dry_run", "trial_"
    for name in [name for name in sys.modules if name.startswith(emulated)]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("usb", "usb.core", "usb.backend"):
        monkeypatch.setitem(sys.modules, name, None)
    assert run(*EMULATED, *words) == 2
    assert "pip install 'autdtorch[hardware]'" in caplog.messages[-1]


@pytest.mark.parametrize("left_on", [False, True])
def test_an_error_in_mid_trial_says_whether_the_outputs_are_off(run, monkeypatch, caplog, left_on):
    def failing(objective, **_: object):
        if simulated:
            error = OSError(errno.ENOSPC, "No space left on device", "there.jsonl")
            error.__context__ = OffError("they may still be on") if left_on else LinkError("stall")
            raise error
        simulated.append(True)
        return gabs(objective)

    simulated: list[bool] = []
    monkeypatch.setitem(trial_run.METHODS, "gabs", failing)
    assert run("--device", "emulated", "--method", "gabs", "--amplitude-limit", "1") == 2
    off = ": the outputs are off, and the same command goes on where the log ends"
    then = "; they may still be on" if left_on else off
    assert caplog.messages[-1] == f"hardware_trial: [Errno 28] No space left on device: 'there.jsonl'{then}"


def test_a_person_reads_each_transducer_and_the_silence_once(run, monkeypatch, capsys, caplog):
    points, evaluations = 2, 1 + 8 * 4
    answers = io.StringIO("0\n" * points + "1\n" * points * (9 + evaluations + 1) + "0\n" * points)
    monkeypatch.setattr("sys.stdin", answers)
    assert run(*EMULATED, "--sensor", "manual") == 0
    assert not answers.read()
    assert capsys.readouterr().out.count("Pressure at control point 1 of 2") == 1 + 9 + evaluations + 2
    assert "pre-flight check: transducer 3 of 9" in caplog.messages


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
    places = device.positions[trial_values.indices(chosen[1])]
    assert torch.allclose(
        load_scene(path).array.positions, places, rtol=0, atol=1e-9
    )  # rounding; pitch 1e-2 m
