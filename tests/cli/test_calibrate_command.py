"""`autdtorch calibrate`: a scene and a file of readings make a calibrated scene, a picture and a summary."""

import dataclasses

import pytest
import torch

import autdtorch as at

SCENE = """
name: bench
frequency: 40e3
medium: {density: 1.2, sound_speed: 340}
array: {type: grid, shape: [2, 2], pitch: 8.0e-3, center: [0, 0, 0], normal: [1, 0, 0]}
control_points: {type: points, positions: [[0.05, 0, 0], [0.05, 0.01, 0]]}
"""
COMMAND = ("calibrate", "--config-dir", "lab", "scene=bench", "readings=readings.csv")


@pytest.fixture
def bench(write, tmp_path):
    """Writes a scene, and 30 drives with their pressures; returns the true matrix and the drives."""
    write("lab/scene/bench.yaml", SCENE)
    scene = at.load_scene(tmp_path / "lab/scene/bench.yaml")
    true = dataclasses.replace(
        scene, array=scene.array.calibrated([1.1, 0.9, 1.0, 1.0], [0.3, 0.0, -0.3, 0.0])
    )
    matrix = at.make_propagator(true).transfer_matrix()
    draws = torch.Generator().manual_seed(0)
    drives = at.drive_from_phases(6 * torch.rand(30, 4, dtype=torch.float64, generator=draws))
    at.save_readings(tmp_path / "readings.csv", at.Readings(drives, (drives @ matrix.T).abs()))
    return matrix, drives


def test_a_scene_is_calibrated(bench, run, tmp_path, capsys):
    matrix, drives = bench
    assert run(*COMMAND, "calibrate.prior.rest=0.01") == 0
    folder, printed = tmp_path / "outputs/bench_calibrated", capsys.readouterr().out
    assert sorted(path.name for path in folder.iterdir()) == [
        *("calibration.npz", "calibration.png", "scene", "summary.txt")
    ]
    assert printed.startswith((folder / "summary.txt").read_text())
    calibration = at.load_calibration(folder / "calibration.npz")
    assert calibration.held_back.error < 0.01
    scene = at.load_scene(folder / "scene/bench_calibrated.yaml")
    pressure = (drives @ at.make_propagator(scene).transfer_matrix().T).abs()
    expected = (drives @ matrix.T).abs()
    assert (pressure - expected).norm() < 0.02 * expected.norm()  # there is no noise, and a small rest
    *_, last = printed.splitlines()
    assert run(*last.split()[1:], "method=gabs", "method.levels=4", "output=out", "plane_spacing=20e-3") == 0


def test_units_changes_and_folds_are_settings(bench, run, tmp_path, capsys):
    titled = (tmp_path / "readings.csv").read_text()
    (tmp_path / "readings.csv").write_text(titled.replace(" [Pa peak]", "").replace(" [rad]", ""))
    prior = "calibrate.prior.variants={temperature: 3, points\\[0\\].x: 1e-3}"
    units = ("calibrate.file.pressure='kPa rms'", "calibrate.file.phases=rad")
    assert run(*COMMAND, *units, prior, "calibrate.folds=0", "output=out") == 0
    printed = capsys.readouterr().out
    assert "held back" not in printed
    assert "temperature" in printed
    assert "points[0].x" in printed
    calibration = at.load_calibration(tmp_path / "out/calibration.npz")
    assert calibration.scale.value == pytest.approx(1000 * 2**0.5, rel=0.1)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("method=lssg", "method=lssg: has no effect on calibrate; give scene, readings, calibrate.KEY"),
        ("readings=none.csv", "readings: none.csv; there is no such file"),
        ("readings=.", "readings: trial.jsonl; there is no such file"),
        ("readings=null", "readings: None; must be a file, as in readings=trial.csv"),
        ("calibrate.prior.gain=-1", "calibrate.prior: gain: -1; must be in 1e-06 to 3"),
        ("+calibrate.prior.noise=1", "calibrate.prior: unknown key 'noise'"),
        ("+calibrate.file.unit=Pa", "calibrate.file: unknown key 'unit'"),
        ("calibrate.file.pressure=bar", "readings: pressure: 'bar'; must be Pa, kPa"),
        ("calibrate.folds=1", "calibrate: folds: 1; must be 0, or 2 to 60"),
        (
            "calibrate.prior.variants={wind: 1}",
            "calibrate: prior.variants: names: 'wind'; must be a change: obstacles.(",
        ),
        ("scene=homogeneous", "calibrate: readings: 2 points and 4 transducers; must be 4 and 16"),
        (
            "calibrate.prior.variants={points[0].x: 1}",
            "argument 'calibrate.prior.variants={points[0].x: 1}': no viable alternative at input "
            "'{points['; in {...}, brackets of a name have backslashes",
        ),
        ("-m", "calibrate: a sweep; must be one scene at a time"),
    ],
)
def test_wrong_settings_are_refused_in_a_line(words, message, bench, refused):
    line = refused(*COMMAND, words)
    assert line.startswith(f"autdtorch: {message}")
