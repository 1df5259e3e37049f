"""`autdtorch play`: a focus on a path, or a file, on an emulated device; what it leaves, and how it ends."""

import json
import signal

import pytest
import torch

import autdtorch as at
from autdtorch.cli.play_command import path_points
from autdtorch.hardware import link
from autdtorch.utils.array_types import REAL

SCENE = """
name: two
frequency: 40e3
medium: {density: 1.2, sound_speed: 340.0}
array: {type: grid, shape: [3, 3], pitch: 10.5e-3, center: [0, 0, 0], normal: [1, 0, 0]}
control_points: {type: points, positions: [[80e-3, 10e-3, 0.0], [80e-3, -10e-3, 0.0]]}
"""
BENCH = ("hardware=emulated", "hardware.device=openmpd", "hardware.limits.amplitude=0.5", "output=out")


@pytest.fixture
def command(write, tmp_path):
    """The words of the command in the scene above, beside which is a file of frames."""
    write("ours/scene/two.yaml", SCENE)
    scene = at.load_scene(tmp_path / "ours/scene/two.yaml")
    at.save_drive(tmp_path / "ours/frames.npz", torch.ones(5, 9).cdouble(), scene.array)
    return ("play", "--config-dir", "ours", "scene=two", *BENCH, "play.seconds=0.05")


def entries(folder):
    return [json.loads(line) for line in (folder / "out/play.jsonl").read_text().splitlines()]


def test_a_focus_on_a_circle_is_played_and_noted(command, run, tmp_path, capsys):
    assert run(*command, "path.frequency=50", "path.radius=4e-3") == 0
    assert capsys.readouterr().out.startswith("50 frames in ")
    sequence = at.load_sequence(tmp_path / "out/sequence.npz")
    drives = sequence.drives
    assert (drives.shape, sequence.rate, sequence.loop) == ((20, 9), 1000.0, True)
    scene = at.load_scene(tmp_path / "ours/scene/two.yaml")
    points = at.circle_points((80e-3, 0, 0), 4e-3, 20, (1, 0, 0))
    matrix = at.make_propagator(scene).transfer_matrix(points)
    focused = (matrix * drives).sum(dim=1).abs()
    # The strongest that 9 transducers can do at each point, less what keeps all frames even.
    assert (focused / matrix.abs().sum(dim=1)).min() > 0.95
    assert run(*command, "play.sequence=out/sequence.npz", "play.modulation={frequency: 100}") == 0
    first, second = entries(tmp_path)
    assert (first["played"]["frames"], first["frames"], first["rate [Hz]"]) == (50, 20, 1000.0)
    assert (second["played"]["frames"], second["frames"], second["rate [Hz]"]) == (100, 40, 2000.0)
    assert run(*command, "play.sequence=out/sequence.npz", "play.rate=500") == 0
    assert (entries(tmp_path)[2]["frames"], entries(tmp_path)[2]["rate [Hz]"]) == (10, 500.0)


def test_frames_without_a_rate_are_played_at_that_of_the_command(command, run, tmp_path):
    assert run(*command, "play.sequence=ours/frames.npz", "play.rate=200") == 0
    (entry,) = entries(tmp_path)
    assert (entry["frames"], entry["rate [Hz]"], entry["played"]["frames"]) == (5, 200.0, 10)


def test_a_line_is_played(command, run, tmp_path):
    assert run(*command, "path=line") == 0
    assert entries(tmp_path)[0]["frames"] == 100


def test_lines_that_end_are_played_once(command, run, tmp_path):
    corners = "path.positions=[[0.08,0,0],[0.08,0.01,0],[0.08,0,0.01]]"
    assert run(*command[:-1], "path=points", corners, "path.closed=false", "path.frequency=20") == 0
    assert entries(tmp_path)[0]["played"]["frames"] == 50


def test_a_line_goes_there_and_back_around_the_control_points(tmp_path, write):
    write("two.yaml", SCENE)
    scene = at.load_scene(tmp_path / "two.yaml")
    line = {"type": "line", "frequency": 100, "length": 8e-3}
    points = path_points("path", {**line, "direction": [0, 1, 0]}, scene, 800)
    wide = 1e-3 * torch.tensor([-4, -2, 0, 2, 4, 2, 0, -2], **REAL)
    expected = torch.stack([torch.full_like(wide, 80e-3), wide, torch.zeros_like(wide)], dim=1)
    torch.testing.assert_close(points, expected, rtol=0, atol=1e-12)
    across = path_points("path", line, scene, 800)
    assert across[:, 0].allclose(torch.tensor(80e-3, **REAL))


def test_ctrl_c_ends_a_loop_with_the_outputs_off(command, run, tmp_path, capsys, monkeypatch):
    def stream(send, *rest):
        def signalled(data):
            sent.append(data)
            if len(sent) == 3:
                signal.raise_signal(signal.SIGINT)
            return send(data)

        return real(signalled, *rest)

    real, sent = link.stream, []
    monkeypatch.setattr(link, "stream", stream)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert run(*command, "play.seconds=null") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(sent) == 3
    assert capsys.readouterr().err.strip().splitlines()[-1] == "autdtorch: SIGINT; the outputs are off"
    assert "SIGINT" in entries(tmp_path)[0]["error"]


def test_a_limit_ends_a_loop(command, run, capsys):
    assert run(*command, "play.seconds=null", "hardware.limits.seconds_in_a_row=0.05") == 3
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.endswith("than the outputs may stay on, 0.05 s in a row; the outputs are off")


MISTAKES = [
    (
        ["hardware.device=sonicsurface", "hardware.limits.amplitude=1"],
        "rate: 1000.0 Hz; must be at most 89.3 for S",
    ),
    (["play.rate=20e3"], "rate: 20000.0 Hz; must be at most 1e+04 for OpenMPD"),
    (["play.rate=0"], "play.rate: 0 Hz; must be finite and > 0"),
    (["play.seconds=-1"], "play.seconds: -1 s; must be finite and > 0"),
    (["play.seconds=90"], "seconds: 90.0 s; must be at most 60, the limit in a row"),
    (
        ["path.frequency=600"],
        "path.frequency: 600.0 Hz; must be in 0.01 to 500, for 100000 to 2 points a lap",
    ),
    (["path.radius=-1"], "path: radius: -1 m; must be finite and > 0"),
    (["path=points"], "path: positions: None; must be given, as [[0, 0, 0.1], [0, 0.01, 0.1]]"),
    (["path=ellipse"], "path: 'ellipse'; must be one of circle, line, points"),
    (["play.modulation=200"], "play.modulation: 200; must be a mapping, such as {frequency: 200}"),
    (["play.modulation={frequency: 200, dept: 1}"], "play.modulation: unknown key 'dept'"),
    (["play.modulation={depth: 1}"], "play.modulation: frequency: None"),
    (["play.sequence=none.npz"], "none.npz"),
    (
        ["play.sequence=one.npz", "path.radius=1e-3"],
        "path.radius=1e-3: has no effect on a file of play.sequence",
    ),
    (
        ["play.sequence=ours/frames.npz"],
        "frames.npz: no rate and loop; must be written by save_sequence, or rate given",
    ),
    (["play.modulation={frequency: 600}"], "play.modulation: rate: 12000.0 Hz; must be at most 1e+04"),
    (["play.tempo=3"], "play.tempo: unknown key"),
    (["trials=3"], "trials=3: has no effect on play"),
]


def test_a_device_must_be_given(refused):
    assert "hardware: None; must be a device, such as hardware=emulated" in refused(
        "play", "scene=homogeneous"
    )


@pytest.mark.parametrize(("words", "message"), MISTAKES)
def test_a_mistake_is_one_line_and_nothing_is_left(command, refused, tmp_path, words, message):
    assert message in refused(*command, *words)
    assert not (tmp_path / "out/play.jsonl").exists() or "error" in entries(tmp_path)[0]
