"""The command line: one run, an experiment, and what it says of wrong settings."""

import dataclasses
import inspect
import json
import re
import signal
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.hydra import Hydra
from omegaconf import OmegaConf

import autdtorch.cli.arguments
import autdtorch.study.run_study
from autdtorch.cli.config_files import CONFIGS
from autdtorch.cli.settings import load_method
from autdtorch.hardware import DEVICES, Limits
from autdtorch.io.drive_file import load_drive, save_drive
from autdtorch.io.goal_section import load_goal
from autdtorch.io.scene_file import load_scene
from autdtorch.methods.base import Method
from autdtorch.objectives.goals import MeanPressure, TargetPressures, WeakestFocus
from autdtorch.objectives.kinds import GOALS
from autdtorch.objectives.quiet import Contrast, QuietPoints
from autdtorch.propagators import make_propagator
from autdtorch.study.results_file import load_results

CONFIG_NAMES = {
    group: sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))
    for group in ("scene", "method", "goal")
}
SINGLE_FILES = ("results.h5", "trials.jsonl", "provenance.json", ".lock", "plane.png")


def written(folder):
    """All files below a folder, by their path in it."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def composed(*overrides):
    # `output` refers to Hydra's settings, which compose() leaves out.
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return OmegaConf.to_container(compose("config", [*overrides, "output=x"]), resolve=True)


def test_a_run_composes_its_settings_once(run, monkeypatch):
    composing = mock.Mock(wraps=Hydra.compose_config)
    monkeypatch.setattr(Hydra, "compose_config", lambda *some, **named: composing(*some, **named))
    assert run("method=lssg", "plane_spacing=0.02") == 0
    composing.assert_called_once()


def test_every_scene_builds_and_has_the_name_of_its_file():
    for name in CONFIG_NAMES["scene"]:
        assert load_scene(composed(f"scene={name}")["scene"]).name == name


def test_every_method_builds_with_known_settings():
    for name in CONFIG_NAMES["method"]:
        assert isinstance(load_method("method", composed(f"method={name}")["method"], ()), Method)


def test_every_goal_has_a_config_of_its_name_with_all_its_settings():
    assert sorted({*GOALS} - {"over_scenes"}) == CONFIG_NAMES["goal"]  # that of scenarios, around a goal
    for name in CONFIG_NAMES["goal"]:
        goal = GOALS[name]
        section = composed(f"goal={name}")["goal"]
        assert section["name"] == name
        assert list(section)[1:] == [field.name for field in dataclasses.fields(goal)]
        if "particle" in section:
            assert load_goal("goal", section) == load_goal("goal", name) == goal(None)


def test_the_papers_experiment():
    config = composed("experiment=paper")
    assert load_goal("goal", config["goal"]) == WeakestFocus()
    assert not {"scene", "method"} & set(config)
    assert all(load_scene(scene) for scene in config["scenes"].values())
    assert all(load_method(name, method, ()) for name, method in config["methods"].items())
    assert list(config["scenes"]) == ["homogeneous", "three_cubes", "two_cubes"]
    assert list(config["methods"]) == ["lssg", "bayes_opt", "bo_foci", "gabs", "identify", "gradient_ascent"]
    assert config["methods"]["gabs"] == {
        "_target_": "autdtorch.gabs", "levels": 16, "order": "random", "first": None, "passes": 1
    }  # fmt: skip
    assert config["methods"]["bayes_opt"]["evaluations"] == 256
    assert config["trials"]["gabs"] == config["trials"]["bayes_opt"] == 50
    assert composed("experiment=paper", "trials=7")["trials"] == 7


GOAL_WORDS = {
    "": WeakestFocus(),
    "goal.weights=[1,2,1,2]": WeakestFocus([1, 2, 1, 2]),
    "goal=mean_pressure": MeanPressure(),
    "goal=target_pressures goal.targets=[4,2,4,2]": TargetPressures([4, 2, 4, 2]),
    "goal=quiet_points goal.points=[2,3]": QuietPoints(WeakestFocus(), [2, 3], 0.03),
    "goal=quiet_points goal.points=[3] goal.ratio=0.1 goal.goal=mean_pressure": QuietPoints(
        MeanPressure(), [3], 0.1
    ),
    "goal=quiet_points goal.points=[0] goal.goal={name:target_pressures,targets:[4,2,4]}": QuietPoints(
        TargetPressures([4, 2, 4]), [0], 0.03
    ),
    "goal=contrast goal.points=1-3": Contrast([1, 2, 3]),
}


def test_a_run_maximises_the_goal_of_its_settings_and_uses_no_results_of_another(
    run, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("autdtorch.cli.study_command._draw_plane", lambda *_: None)
    command = ("scene=homogeneous", "method=gabs", "method.levels=4", "plane_spacing=20e-3", "output=out")
    for words, goal in GOAL_WORDS.items():
        for reused in (False, True) if "contrast" in words else (False,):
            assert run(*command, *words.split()) == 0
            assert ("re-using" in capsys.readouterr().err) is reused
        scene = load_results(tmp_path / "out").scenes["homogeneous"]
        assert load_goal("goal", scene.goal) == goal
        solution = scene.methods["gabs"].solution
        assert solution.score.tolist() == goal(solution.pressure).tolist()
        assert solution.score.max() <= scene.bound == goal.bound(scene.transfer_matrix)
    assert len(list((tmp_path / "out").glob("previous-*"))) == len(GOAL_WORDS) - 1


def test_runs_of_other_methods_in_a_scene_simulate_its_matrix_once(run, tmp_path, capsys):
    words = ("scene=two_cubes", "solver.spacing=2.5e-3", "solver.tolerance=0.1", "plane_spacing=0.05")
    shares = []
    for method, runs in (("lss", 2), ("gradient", 1)):  # the observation plane is simulated each time
        assert run(*words, f"method={method}", "drive=full") == 0
        captured = capsys.readouterr()
        assert f"box, {runs} run" in captured.err
        assert (f"kept in {Path('outputs', 'matrices')}" in captured.err) == (method == "gradient")
        shares.append(float(re.search(r"([\d.]+) % of [\d.]+ Pa", captured.out)[1]))
        folder = tmp_path / "outputs" / f"two_cubes_{method}"
        found = load_results(folder).scenes["two_cubes"]
        (solution,) = (own.solution for own in found.methods.values())
        share = 100 * float(solution.score) / found.bound
        assert share - 0.101 < shares[-1] <= share  # rounded down
        np.testing.assert_allclose(load_drive(folder / "drive.csv"), solution.drive[0], atol=1e-12)
    assert shares[0] < shares[1] <= 100
    assert len(list((tmp_path / "outputs" / "matrices").iterdir())) == 1


def test_the_best_drive_is_written_as_the_levels_of_a_device(run, refused, tmp_path):
    array = "scene.array={type: sonicsurface, center: [1e-3, 50e-3, 50e-3]}"
    words = ("scene=homogeneous", "method=random", "method.evaluations=2", "trials=3", "plane_spacing=0.05")
    wide = ("~scene.array", f"+{array}", "~scene.domain", *words)
    assert run(*wide, "drive=sonicsurface", "output=out") == 0
    (own,) = load_results(tmp_path / "out").scenes["homogeneous"].methods.values()
    best = own.solution.drive[int(own.solution.score.argmax())]
    np.testing.assert_array_equal(
        load_drive(tmp_path / "out" / "drive.csv"), DEVICES["sonicsurface"].quantised(best)
    )
    assert "drive: 'autd3'" in refused(*words, "drive=autd3")
    assert "did you mean 'autd3'" in refused(*words, "drive=audt3")


@pytest.mark.filterwarnings("always")
def test_degrees_and_millimetres_on_the_command_line_are_told(run, capsys):
    words = ("scene=homogeneous", "solver.method=free_space", "method=lss", "plane_spacing=0.02")
    turned = "{type: box, center: [41e-3, 50e-3, 50e-3], size: [9e-3, 9e-3, 9e-3], rotation: [0, 0, 45]}"
    assert run(*words, f"scene.obstacles=[{turned[:-1]}, rigid: true}}]") == 0
    told = r"^obstacles\[0\]: Box\.rotation: \(0\.0, 0\.0, 45\.0\) rad is more than a turn"
    assert re.search(told, capsys.readouterr().err, re.MULTILINE)
    assert run(*words, "~scene.observation_plane", "~scene.domain", "scene.control_points.radius=20") == 0
    assert re.search(r"^Scene: ", capsys.readouterr().err, re.MULTILINE)


def test_one_scene_and_one_method_are_computed_once(run, tmp_path, capsys, monkeypatch):
    command = ("scene=homogeneous", "method=gabs", "solver.method=free_space", "trials=2")
    assert run(*command) == 0
    folder = tmp_path / "outputs" / "homogeneous_gabs"
    # Free space has no matrix to keep.
    assert written(tmp_path) == {f"outputs/homogeneous_gabs/{name}" for name in SINGLE_FILES}
    assert Path.cwd() == tmp_path
    method = load_results(folder).scenes["homogeneous"].methods["gabs"]
    assert method.trials == 2
    rows = [json.loads(line) for line in (folder / "trials.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [row["mean"] for row in rows] == method.metrics.mean.tolist()
    captured = capsys.readouterr()
    table = head, row, end = captured.out.splitlines()
    assert head.split()[:3] == ["scene", "method", "trials"]
    assert row.split()[:4] == ["homogeneous", "GABS", "2", f"{method.metrics.mean.mean():.2f}"]
    assert end == f"The results are in {Path('outputs', 'homogeneous_gabs')}"
    assert re.search("^homogeneous: free space, ", captured.err, re.MULTILINE)

    monkeypatch.setattr(autdtorch.study.run_study, "_run_scene", lambda *_: pytest.fail("computed again"))
    assert run(*command, f"solver.cache={tmp_path / 'two'}") == 0  # changes no result
    captured = capsys.readouterr()
    assert captured.out.splitlines() == table
    assert "re-using homogeneous" in captured.err
    # Where results go does not change them, but there is nothing to use elsewhere.
    with pytest.raises(pytest.fail.Exception):
        run(*command, "output=elsewhere")


def save_mask(size):
    np.save("mask.npy", np.ones((size,) * 3, bool))


def save_array(pitch):
    Path("array.csv").write_text(f"x [mm],y [mm],z [mm]\n0,0,0\n{pitch},0,0\n", encoding="utf-8")


MASK = "{type: voxel_mask, path: mask.npy, spacing: 1e-3, origin: [40e-3, 0, 0], rigid: true}"
ARRAY = "{type: file, path: array.csv, center: [1e-3, 50e-3, 50e-3], normal: [1, 0, 0]}"


@pytest.mark.parametrize(
    ("save", "overrides"),
    [
        (save_mask, ["solver.method=free_space", f"scene.obstacles=[{MASK}]"]),
        (save_array, ["~scene.array", f"+scene.array={ARRAY}"]),
    ],
    ids=["mask", "array"],
)
def test_a_scene_with_a_changed_file_is_computed_again(run, capsys, save, overrides):
    for value, reused in ((2, False), (2, True), (3, False)):
        save(value)
        assert run("method=lssg", "plane_spacing=10e-3", "output=out", *overrides) == 0
        assert ("re-using" in capsys.readouterr().err) is reused


def test_ones_own_scene_file(run, write, tmp_path):
    text = (CONFIGS / "scene" / "homogeneous.yaml").read_text(encoding="utf-8")
    write("mine/scene/pair.yaml", text.replace("count: 4", "count: 2"))
    assert run("--config-dir", "mine", "scene=pair", "method=lssg", "plane_spacing=10e-3") == 0
    assert load_results(tmp_path / "outputs" / "pair_lssg").scenes["pair"].transfer_matrix.shape == (2, 16)


def test_an_experiment_ends_with_its_report(run, drawn, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("autdtorch.study.report.study_report.rendering_problem", lambda: "not tried")
    command = (
        "experiment=paper",
        "~methods.bayes_opt",
        "~methods.bo_foci",
        "~methods.identify",
        "~scenes.two_cubes",
        "plane_spacing=5e-3",
        "trials=2",
    )
    assert run(*command, "solver.method=free_space") == 0
    captured = capsys.readouterr()
    assert captured.out.splitlines()[-1] == f"The report is {Path('outputs', 'paper', 'report.html')}"
    results = load_results(tmp_path / "outputs" / "paper")
    assert list(results.scenes) == ["homogeneous", "three_cubes"]
    assert [method.trials for method in results.scenes["three_cubes"].methods.values()] == [1, 2, 2]
    report = (tmp_path / "outputs" / "paper" / "report.md").read_text(encoding="utf-8")
    assert f"`autdtorch {' '.join(command)} solver.method=free_space`" in report.replace("'", "")


def test_ctrl_c_ends_with_one_line_and_its_status(run, capsys, monkeypatch):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    monkeypatch.setattr(
        autdtorch.study.run_study, "_run_scene", lambda *_: signal.raise_signal(signal.SIGINT)
    )
    try:
        assert run("solver.method=free_space") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("autdtorch: interrupted; ")


def test_help_tells_what_there_is_with_the_defaults(run, tmp_path, capsys):
    assert run("--help") == 0
    text = capsys.readouterr().out
    assert "autdtorch experiment=paper" in text
    assert f"scene: {', '.join(CONFIG_NAMES['scene'])}" in text
    assert re.search(r"^hardware: autd3, (?!.*base)", text, re.MULTILINE)
    assert len(text.splitlines()) <= 48
    rows = re.findall(r"^  ([a-z_.]+) +\S.* \[(.*)\]$", text, re.MULTILINE)
    assert len(rows) >= 8
    config = OmegaConf.create(composed())
    for key, default in rows:
        if key != "output":  # named after scene and method
            shown = OmegaConf.create(f"x: {default}").x
            assert OmegaConf.select(config, key, throw_on_missing=True) == shown, key
    for words, part in ((["--cfg", "job"], "tolerance: 0.002"), (["--hydra-help"], "--multirun")):
        assert run(*words) == 0
        assert part in capsys.readouterr().out
    assert run("--version") == 0
    assert capsys.readouterr().out == f"autdtorch {autdtorch.__version__}\n"
    assert written(tmp_path) == set()


NUMBER = r"[\d.e-]+"


@pytest.mark.parametrize(
    ("given", "work"),
    [
        (["scene=homogeneous"], "homogeneous: free space"),
        (["scene=sphere"], f"sphere: tmatrix, exact waves, within {NUMBER}"),
        (
            ["scene=two_cubes", "solver.spacing=2.1e-3", "solver.tolerance=0.1"],
            rf"two_cubes: box, \d runs?, within {NUMBER} of steady, [\d,]+ cells of 2.1 mm",
        ),
        (
            ["scene=two_cubes", "solver.spacing=null", "solver.tolerance=0.3"],
            rf"two_cubes: box, \d runs?, estimated error {NUMBER}, [\d,]+ cells of {NUMBER} mm",
        ),
    ],
)
def test_a_job_logs_one_line_of_cells_runs_error_and_seconds(run, capsys, monkeypatch, given, work):
    monkeypatch.setattr("autdtorch.utils.progress._PATIENCE", float("inf"))  # no forecasts on a busy machine
    given = [*given, "method=gabs", "trials=2", "plane_spacing=0.02"]
    assert run(*given) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert re.fullmatch(rf"{work}, {NUMBER} s; gabs, 2 trials, {NUMBER} s", line)
    if "scene=sphere" in given:
        assert run(*given) == 0  # finished before
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("re-using sphere from ")
        assert run(*given, "hydra.verbose=autdtorch", "seed=1") == 0
        assert "transfer matrix" in capsys.readouterr().err


def test_solver_settings_are_the_defaults_of_make_propagator():
    """One truth: a script and the command line simulate alike."""
    parameters = inspect.signature(make_propagator).parameters.values()
    defaults = {parameter.name: parameter.default for parameter in parameters if parameter.name != "scene"}
    assert OmegaConf.to_container(OmegaConf.load(CONFIGS / "solver" / "default.yaml")) == defaults


BENCHES = ["autd3", "emulated", "openmpd", "sonicsurface", "ultraino"]
SENSORS = sorted(path.stem for path in (CONFIGS / "hardware" / "sensor").glob("*"))


@pytest.mark.parametrize("bench", BENCHES)
def test_every_bench_has_the_same_keys(bench):
    """Sensors and benches are files of their own: each with one of the others, and all with the emulator."""
    device = "sonicsurface" if bench == "emulated" else bench
    for sensor in SENSORS if bench == "emulated" else SENSORS[BENCHES.index(bench) :][:1]:
        words = (f"hardware={bench}", f"hardware/sensor={sensor}", "hardware.limits.amplitude=1")
        where = ("hardware.sensor.path=x",) if sensor == "file" else ()
        section = composed(*words, f"hardware.device={device}", *where)["hardware"]
        assert section["device"] == device
        assert section["sensor"]["kind"] == sensor
        assert section["emulated"] is (bench == "emulated")
        assert section["limits"] == dataclasses.asdict(Limits(amplitude=1))


def test_a_path_of_the_obstacles_is_a_study_of_its_poses(run, tmp_path, refused, monkeypatch):
    coarse = ("scene=two_cubes", "solver.spacing=2.5e-3", "solver.tolerance=0.1", "plane_spacing=0.02")
    poses = "poses={offset: [0, 4e-3, 0], rotation: [0, 0, 0.1], count: 3}"
    assert run(*coarse, "method=lssg", poses, "+scene.pose={offset: [0, 1e-3, 0]}", "output=path") == 0
    results = load_results(tmp_path / "path")
    assert list(results.scenes) == ["two_cubes_0", "two_cubes_1", "two_cubes_2"]
    assert (tmp_path / "path" / "poses.png").stat().st_size > 0
    scene = load_scene(CONFIGS / "scene" / "two_cubes.yaml").moved((0, 5e-3, 0), (0, 0, 0.1))
    last = make_propagator(scene, spacing=2.5e-3, tolerance=0.1, cache=False).transfer_matrix()
    # the same simulation, up to rounding in single precision
    assert float((results.scenes["two_cubes_2"].transfer_matrix - last).norm() / last.norm()) < 1e-3
    monkeypatch.setattr("autdtorch.study.report.study_report.rendering_problem", lambda: "not tried")
    assert run("collect", "path") == 0
    assert "count: 1; must be an integer >= 2" in refused(*coarse, "poses={count: 1}")


def test_explore_without_a_driver_names_what_to_install(run, monkeypatch, capsys):
    monkeypatch.setattr("autdtorch.plot.view3d.rendering_problem", lambda: "no driver; it needs libegl1")
    assert run("explore", "scene=homogeneous", "explore.browser=false") == 2
    assert capsys.readouterr().err == "autdtorch: no driver; it needs libegl1\n"


def test_explore_shows_the_scene_and_drive_of_the_settings(run, write, monkeypatch, capsys):
    shown = {}

    class Live:
        address = "http://127.0.0.1:1/token/index.html"

        def wait(self):
            signal.raise_signal(signal.SIGTERM)

        def close(self):
            shown["closed"] = True

    def explore(scene, drive, **settings):
        shown.update(settings, scene=scene, drive=drive)
        return Live()

    monkeypatch.setattr("autdtorch.plot.explore.explore", explore)
    drive = np.linspace(0.1, 1, 16) * 1j
    array = load_scene(CONFIGS / "scene" / "sphere.yaml").array
    save_drive("drive.npz", drive, array)
    arguments = ("explore", "scene=sphere", "explore.drive=drive.npz", "explore.browser=false")
    assert run(*arguments, "solver.spacing=2e-3", "scene.frequency=41e3", "explore.port=8123") == 0
    assert shown["scene"].frequency == 41e3
    assert np.array_equal(shown["drive"], drive)
    assert (shown["spacing"], shown["port"], shown["open_browser"]) == (2e-3, 8123, False)
    assert shown["closed"]
    assert Live.address in capsys.readouterr().out
