"""The folder of a study: what is used again or moved aside, also after the process was killed."""

import functools
import logging
import multiprocessing
import os
import signal
import time
from unittest.mock import Mock

import pytest
import slow_study
import torch
from checks.kills import SUBJECTS
from filelock import FileLock
from small_scenes import CUBE, small_scene

from autdtorch.methods.functions import gabs
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.scene import Scene
from autdtorch.study.folder import PREVIOUS, TRIALS_FILE
from autdtorch.study.results import PROVENANCE_FILE, load_provenance
from autdtorch.study.results_file import RESULTS_FILE, load_results
from autdtorch.study.run_study import run_study
from autdtorch.utils.files import SET_ASIDE

FILES = (RESULTS_FILE, TRIALS_FILE, PROVENANCE_FILE)
SIMULATED = {"method": "auto", "spacing": 2e-3, "tolerance": 0.2, "kernel": "reference"}


def study(folder, seed=0, config="config", **changes):
    arguments = {
        "scenes": {"one": small_scene(), "two": small_scene(extent=30e-3)},
        "methods": {"gabs": functools.partial(gabs, levels=4)},
        "solver": {"method": "free_space"},
        "trials": 3,
        **changes,
    }
    return run_study(**arguments, folder=folder, config=f"{config} {seed}", seed=seed)  # type: ignore[arg-type]


def numbers(results):
    solutions = [scene.methods["gabs"].solution for scene in results.scenes.values()]
    return torch.cat([torch.cat([solution.drive, solution.history], dim=1) for solution in solutions])


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.fixture
def warnings(caplog):
    def since():
        messages = [one.getMessage() for one in caplog.records if one.levelno >= logging.WARNING]
        caplog.clear()
        return messages

    return since


@pytest.mark.parametrize("name", [RESULTS_FILE, PROVENANCE_FILE])
def test_a_damaged_file_is_kept_and_costs_no_trial(tmp_path, warnings, name):
    undisturbed, before = study(tmp_path), contents(tmp_path)
    damaged = before[name][:-2]
    (tmp_path / name).write_bytes(damaged)
    again = study(tmp_path)
    assert torch.equal(numbers(again), numbers(undisturbed))
    assert again.provenance == undisturbed.provenance == load_provenance(tmp_path)
    assert contents(tmp_path)[TRIALS_FILE] == before[TRIALS_FILE]
    (line,) = warnings()
    assert name in line
    assert contents(tmp_path / f"{PREVIOUS}1") == {name: damaged}
    mended = contents(tmp_path)
    study(tmp_path)
    assert warnings() == []
    assert contents(tmp_path) == mended


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_another_study_is_not_used_and_costs_no_other(tmp_path, name):
    own, other = tmp_path / "own", tmp_path / "other"
    undisturbed, before = study(own), contents(own)
    assert not torch.equal(numbers(study(other, seed=1)), numbers(undisturbed))
    swapped = contents(other)[name]
    (own / name).write_bytes(swapped)
    assert torch.equal(numbers(study(own)), numbers(undisturbed))
    assert load_results(own).provenance == undisturbed.provenance
    if name == TRIALS_FILE:
        assert contents(own)[TRIALS_FILE + SET_ASIDE] == swapped
    else:
        assert contents(own / f"{PREVIOUS}1") == {name: swapped}
        assert contents(own)[TRIALS_FILE] == before[TRIALS_FILE]


def test_another_study_is_kept_whole_and_a_refused_one_moves_nothing(tmp_path, warnings):
    made, mine = {"plane.png", "report.html", "drive_one_gabs.csv"}, {"notes.txt", "drive_mine.csv"}
    for seed in (0, 1):
        study(tmp_path, seed)
        for name in made | mine:
            (tmp_path / name).write_text(f"{name} of {seed}", encoding="utf-8")
        before = contents(tmp_path)
        with pytest.raises(ValueError, match="solver: dtype"):
            study(tmp_path, seed=2, solver={"method": "free_space", "dtype": "int"})
        assert contents(tmp_path) == before
    study(tmp_path, seed=2)
    assert contents(tmp_path / f"{PREVIOUS}2") == {name: before[name] for name in {*FILES, *made}}
    assert {name for name in contents(tmp_path) if not name.startswith(".")} == {*FILES, *mine}
    assert len(warnings()) == 2


def test_drives_of_another_study_are_not_replaced_where_its_results_cannot_be_read(tmp_path):
    study(tmp_path)
    (tmp_path / RESULTS_FILE).write_bytes(b"of an earlier version")
    (tmp_path / "drive_one_gabs.csv").write_text("of the first", encoding="utf-8")
    study(tmp_path, seed=1)
    aside = tmp_path / f"{PREVIOUS}1" / "drive_one_gabs.csv"
    assert aside.read_text(encoding="utf-8") == "of the first"


@pytest.mark.parametrize("missing", [RESULTS_FILE, PROVENANCE_FILE])
def test_lines_of_trials_are_set_aside_where_another_file_is_of_the_study(tmp_path, missing):
    undisturbed = study(tmp_path)
    (tmp_path / missing).unlink()
    damaged = (tmp_path / TRIALS_FILE).read_bytes().replace(b'"trial"', b'"tria1"')
    (tmp_path / TRIALS_FILE).write_bytes(damaged)
    assert torch.equal(numbers(study(tmp_path)), numbers(undisturbed))
    assert contents(tmp_path)[TRIALS_FILE + SET_ASIDE] == damaged
    assert not (tmp_path / f"{PREVIOUS}1").exists()


def test_trials_alone_are_used_and_a_damaged_one_is_run_again(tmp_path, warnings, caplog):
    caplog.set_level(logging.INFO)
    undisturbed = study(tmp_path)
    assert "re-using" not in caplog.text
    lines = (tmp_path / TRIALS_FILE).read_bytes().splitlines(keepends=True)
    (tmp_path / RESULTS_FILE).unlink()
    (tmp_path / PROVENANCE_FILE).unlink()
    (tmp_path / TRIALS_FILE).write_bytes(b"".join([lines[0], b"{}\n", *lines[2:]]))
    assert torch.equal(numbers(study(tmp_path)), numbers(undisturbed))
    assert "re-using 5 trials" in caplog.text
    (line,) = warnings()
    assert f"{TRIALS_FILE}, line 2" in line
    again = (tmp_path / TRIALS_FILE).read_bytes().splitlines(keepends=True)
    assert again[:-1] == [lines[0], *lines[2:]]


def test_a_damaged_matrix_is_computed_again(tmp_path, warnings):
    cache = tmp_path / "matrices"
    solver = SIMULATED | {"cache": cache}
    simulated = functools.partial(study, tmp_path, scenes={"cube": small_scene((CUBE,))}, solver=solver)
    undisturbed = simulated()
    matrices = contents(cache)
    for name, content in matrices.items():
        (cache / name).write_bytes(content[:-1] + b"\1")
    (tmp_path / RESULTS_FILE).unlink()
    again = simulated()
    for name, scene in again.scenes.items():
        assert torch.equal(scene.transfer_matrix, undisturbed.scenes[name].transfer_matrix)
    assert len(warnings()) == len(matrices) > 0
    assert contents(cache) == matrices


def test_trials_of_other_shapes_do_not_count_though_the_settings_are_called_the_same(tmp_path):
    study(tmp_path, scenes={"one": small_scene()})
    (tmp_path / RESULTS_FILE).unlink()
    small = small_scene()
    array = TransducerArray.grid((2, 3), pitch=8e-3, center=(1.2e-3, 12e-3, 12e-3))
    other = Scene(array, small.medium, 40e3, small.control_points)
    (found,) = study(tmp_path, scenes={"one": other}).scenes.values()
    assert found.methods["gabs"].solution.drive.shape == (3, 6)


def test_with_a_method_of_ones_own_everything_is_computed_again(tmp_path):
    def own(objective, trials, seed):
        found = gabs(objective, levels=2, trials=trials, seed=seed)
        calls.append(trials)
        return found

    calls = []
    for count in (1, 2):
        study(tmp_path, methods={"gabs": functools.partial(own)})
        assert len(calls) == count * 2  # two scenes, a block of trials each
    assert sorted(contents(tmp_path / f"{PREVIOUS}1")) == sorted(FILES)


@pytest.mark.parametrize("name", FILES)
def test_a_folder_in_the_place_of_a_file_is_told_and_nothing_is_lost(tmp_path, name):
    study(tmp_path)
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    before = contents(tmp_path)
    with pytest.raises(IsADirectoryError, match=name):
        study(tmp_path)
    assert contents(tmp_path) == before


def test_a_link_to_a_file_is_used_as_the_file(tmp_path, warnings):
    folder = tmp_path / "study"
    study(folder)
    for name in FILES:
        (folder / name).replace(tmp_path / name)
        (folder / name).symlink_to(tmp_path / name)
    before = contents(folder)
    study(folder)
    assert contents(folder) == before
    assert warnings() == []


STUDY = SUBJECTS["study"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here")
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_killed_again_and_again_a_study_ends_with_the_same_numbers(tmp_path, monkeypatch):
    folders = calm, killed = tmp_path / "calm", tmp_path / "killed"
    for folder in folders:
        folder.mkdir()

    def run(folder):
        monkeypatch.setattr("sys.argv", ["slow_study.py", str(folder / "out")])
        slow_study.main()

    def finish(folder):
        with monkeypatch.context() as patched:
            patched.setattr("slow_study.time", Mock())
            run(folder)

    monkeypatch.setattr("autdtorch.study.run_study.BLOCK", 1)  # the study sets it, too
    finish(calm)
    undisturbed = STUDY.numbers(calm)
    for trials in (2, 8):  # in the midst of either scene
        process = multiprocessing.get_context("fork").Process(target=run, args=(killed,))
        process.start()
        while process.is_alive() and STUDY.lines(killed) < trials:
            time.sleep(0.01)
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    assert STUDY.lines(killed) < 12
    finish(killed)
    resumed = STUDY.numbers(killed)
    assert len(resumed) == len(undisturbed) > 0
    assert all(map(torch.equal, resumed, undisturbed))
    # Nothing is done twice: a line a trial.
    assert STUDY.lines(killed) == STUDY.lines(calm) == 12


def test_a_second_process_on_the_same_folder_is_refused(tmp_path):
    with FileLock(tmp_path / ".lock"), pytest.raises(ValueError, match="another process writes there"):
        run_study({"a": small_scene()}, {"gabs": gabs}, solver={"method": "free_space"}, folder=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    results = run_study({"a": small_scene()}, {"gabs": gabs}, folder=tmp_path, config="a: 1")
    assert list(results.scenes) == ["a"]
