"""Sweeps: a job for each scene and method, here and in other processes, and what a failure leaves of them."""

import csv
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import torch
from checks.kills import Subject, of_studies, wait
from hydra import compose, initialize_config_dir

from autdtorch.cli import config_files
from autdtorch.cli.config_files import CONFIGS
from autdtorch.study.report.tables import save_summary
from autdtorch.study.results_file import load_results
from autdtorch.study.sweeps import collect_results

pytestmark = pytest.mark.processes

QUICK = ("scene=homogeneous", "plane_spacing=0.02")


def jobs(folder):
    return sorted(file.parent.name for file in folder.rglob("results.h5"))


def test_a_sweep_by_submitit_has_a_folder_for_each_job(run, tmp_path):
    status = run("-m", "hydra/launcher=submitit_local", *QUICK, "method=lssg")
    logs = sorted((tmp_path / "multirun" / ".submitit").glob("*/*.*"))
    assert status == 0, "\n".join(f"{path.name}: {path.read_bytes()[-2000:]!r}" for path in logs)
    assert jobs(tmp_path) == ["method=lssg,plane_spacing=0.02,scene=homogeneous"]


CLIMBING = """
import autdtorch as at

def climb(objective, steps, trials, seed):
    return at.random_search(objective, evaluations=steps, trials=trials, seed=seed)
"""


@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_jobs_log_a_line_each_and_find_methods_in_the_working_directory(
    run, write, tmp_path, capsys, launcher
):
    write("climbing.py", CLIMBING)
    write("mine/method/climb.yaml", "_target_: climbing.climb\nsteps: 5\n")
    command = ["--config-dir", "mine", "-m", f"hydra/launcher={launcher}", "modules=climbing"]
    command += [*QUICK, "method=climb,lssg", "trials=3"]
    if launcher == "basic":
        assert run(*command) == 0
        output = capsys.readouterr()
        out, err = output.out, output.err
    else:  # in a process of its own, as workers write to stderr and not to what stands for it in a test
        command = [sys.executable, "-m", "autdtorch", *command]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        out, err = done.stdout, done.stderr
    start, *each = err.splitlines()
    assert start.startswith("sweep into multirun: ")
    assert sorted(line.partition(" free space")[0] for line in each) == [
        f"job {number}: homogeneous:" for number in (0, 1)
    ]
    assert out.splitlines()[-1].startswith("autdtorch collect FOLDER merges")
    assert jobs(tmp_path) == [
        f"method={name},plane_spacing=0.02,scene=homogeneous,trials=3" for name in ("climb", "lssg")
    ]
    methods = collect_results(tmp_path).results.scenes["homogeneous"].methods
    assert sorted(methods) == ["climb", "lssg"]
    assert methods["climb"].solution.evaluations.tolist() == [5, 5, 5]


def test_jobs_in_one_scene_share_its_matrices(run, tmp_path):
    coarse = ("solver.method=box", "solver.spacing=2.8e-3", "solver.tolerance=0.1", "plane_spacing=0.02")
    assert run("-m", "scene=sphere", *coarse, "method=lss,lssg") == 0
    (matrix,) = (tmp_path / "multirun" / "matrices").iterdir()
    assert matrix.suffix == ".matrix"


def test_a_trusted_folder_may_ask_for_a_sweep(run, write, tmp_path):
    sweep = "hydra: {mode: MULTIRUN, sweeper: {params: {method: 'lss,lssg'}}}"
    write("lab/experiment/both.yaml", f"# @package _global_\n{sweep}\n")
    assert run("experiment=both", "hydra.searchpath=[lab]", "plane_spacing=0.02") == 0
    assert len(jobs(tmp_path)) == 2


def test_a_file_of_ours_that_asks_for_a_sweep_is_refused(write, tmp_path, monkeypatch):
    write("experiment/both.yaml", "# @package _global_\nhydra: {mode: MULTIRUN}\n")
    monkeypatch.setattr(config_files, "CONFIGS", tmp_path)
    source = config_files.FileConfigSource("main", f"file://{tmp_path}")
    with pytest.raises(ValueError, match=r"hydra\.mode; must be set on the command line"):
        source.load_config("experiment/both.yaml")


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL is of POSIX")
def test_a_killed_sweep_goes_on_with_the_same_command(run, tmp_path):
    command = ("-m", *QUICK, "method=gabs,identify", "trials=2")
    sweep = Subject(("-m", "autdtorch", *command), "multirun/*/trials.jsonl", of_studies)
    process = sweep.start(tmp_path)
    wait(lambda: sweep.lines(tmp_path) > 0, process)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert run(*command) == 0
    assert run(*command, "hydra.sweep.dir=calm") == 0
    assert sweep.lines(tmp_path) == 4
    found, undisturbed = of_studies(tmp_path / "multirun"), of_studies(tmp_path / "calm")
    assert len(found) == len(undisturbed) > 0
    assert all(map(torch.equal, found, undisturbed))


def test_a_real_cluster_has_its_config():
    """All keys are those of the plugin, else Hydra refuses them; what runs out of time is queued again."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        launcher = compose("config", ["hydra/launcher=slurm"], return_hydra_config=True).hydra.launcher
    assert launcher._target_.endswith("SlurmLauncher")
    assert launcher.max_num_timeout > 0


def test_without_slurm_it_says_so(refused, monkeypatch):
    monkeypatch.setenv("PATH", "")
    line = refused("-m", "hydra/launcher=slurm", *QUICK)
    assert line.startswith('autdtorch: Could not detect "srun"')


def test_where_a_job_fails_the_others_go_on(run, tmp_path, capsys):
    assert run("-m", *QUICK, "method.levels=1,4") == 2
    (folder,) = jobs(tmp_path)
    assert folder.startswith("method.levels=4,")
    errors = capsys.readouterr().err.splitlines()
    assert "job 0 failed: method: levels: 1; must be an integer >= 2" in errors[-1]


def test_the_folder_of_a_job_has_a_name_that_every_file_system_takes(run, tmp_path):
    overrides = [f"scene.control_points.{key}" for key in ("center.0=8e-2", "radius=29e-3", "angle=0.1")]
    overrides += ["scene.medium.sound_speed=341", "scene.array.pitch=11e-3", "solver.cache=some/where"]
    for name in ("scene.name='a b'", "scene.name='a/b'"):  # differ in what a folder's name cannot have
        assert run("-m", *QUICK, "method=lssg", *overrides, name) == 0
    folders = jobs(tmp_path)
    assert len(folders) == 2
    assert max(map(len, folders)) <= 150
    assert [shlex.quote(name) for name in folders] == folders


def test_settings_and_folders_can_be_pasted_into_a_shell(run, tmp_path, capsys):
    assert run(*QUICK, "method=lssg", "output=my results") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "The results are in 'my results'"
    settings = (*QUICK, "method=lssg", "poses={offset: [0, 2e-3, 0], count: 2}")
    assert run("-m", *settings) == 0
    printed = capsys.readouterr()
    (folder,) = jobs(tmp_path / "multirun")
    assert shlex.quote(folder) == folder
    assert Path(shlex.split(printed.out.splitlines()[-2])[-1]) == Path("multirun", folder)
    (begun,) = (line for line in printed.err.splitlines() if line.startswith("sweep into multirun: "))
    pasted = [
        setting.replace(" ", "") for setting in shlex.split(begun.removeprefix("sweep into multirun: "))
    ]
    assert pasted[:3] == list(settings[:3])
    assert pasted[3].startswith("poses={offset:[0,")


def test_collected_seeds_are_trials_and_other_settings_make_names(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("autdtorch.study.report.study_report.rendering_problem", lambda: "not tried")
    assert run("-m", *QUICK, "method=gabs", "method.levels=4,8", "seed=0,1", "trials=2") == 0
    assert run("-m", *QUICK, "method=lssg", "seed=0,1") == 0
    alone = load_results(
        next(path for path in tmp_path.rglob("results.h5") if "levels=8" in path.parent.name)
    )
    capsys.readouterr()
    assert run("collect", "multirun") == 0
    output = capsys.readouterr().out.splitlines()
    assert output[-1].startswith(
        "6 studies: the table is multirun/summary.csv, the report multirun/report.html"
    )
    sweep = collect_results(tmp_path)
    methods = sweep.results.scenes["homogeneous"].methods
    assert {name: method.trials for name, method in methods.items()} == {
        "lssg": 1,  # no chance in it: two seeds give the same trial
        "gabs,levels=4": 4,
        "gabs,levels=8": 4,
    }
    one = alone.scenes["homogeneous"].methods["gabs"].solution.drive
    drives = methods["gabs,levels=8"].solution.drive
    assert any(drives[start : start + 2].equal(one) for start in (0, 2))
    with (tmp_path / "multirun" / "summary.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["scene"], row["method"], row["method.levels"]) for row in rows] == [
        ("homogeneous", "lssg", ""),
        ("homogeneous", "gabs", "4"),
        ("homogeneous", "gabs", "8"),
    ]
    # The summary's median is over all trials.
    assert float(rows[2]["median score"]) == pytest.approx(
        float(methods["gabs,levels=8"].solution.score.quantile(0.5)), rel=1e-12
    )
    report = (tmp_path / "multirun" / "report.md").read_text(encoding="utf-8")
    assert "- seeds: 0, 1\n" in report
    assert "in the folders that the settings name: `results.h5`" in report


def test_swept_goals_are_scenes_of_their_own(run, tmp_path):
    assert run("-m", *QUICK, "method=lssg", "goal=weakest_focus,mean_pressure") == 0
    targets = ("goal=target_pressures", "goal.targets=[4,2,4,2],[2,4,2,4]")
    assert run("-m", *QUICK, "method=lssg", *targets) == 0
    sweep = collect_results(tmp_path)
    save_summary(sweep, tmp_path / "summary.csv")
    scenes = sweep.results.scenes
    assert [scene.goal["name"] for scene in scenes.values()] == [
        "mean_pressure", "target_pressures", "target_pressures", "weakest_focus"
    ]  # fmt: skip
    assert "homogeneous,goal=target_pressures,targets=4x2x4x2" in scenes
    with (tmp_path / "summary.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["goal"] for row in rows] == [scene.goal["name"] for scene in scenes.values()]
    assert [row["unit"] for row in rows] == ["Pa", "", "", "Pa"]
    assert [row["gap to the bound"] == "" for row in rows] == [False, True, True, False]


def test_an_unfinished_study_is_left_out(run, tmp_path, capsys):
    assert run("-m", *QUICK, "method=gabs,lssg") == 0
    next(file for file in tmp_path.rglob("results.h5") if "lssg" in file.parent.name).unlink()
    assert collect_results(tmp_path).studies == 1
    assert (
        "method=lssg,plane_spacing=0.02,scene=homogeneous: not finished, left out" in capsys.readouterr().err
    )


#: As a sweep does it, without the packages of a sweep. A suite that `nohup` started ignores SIGHUP.
WORKERS = """
import signal, subprocess, sys, time
from autdtorch.cli.main import end_workers_with_us
signal.signal(signal.SIGHUP, signal.SIG_DFL)
worker = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(300)"])
end_workers_with_us()
print(worker.pid, flush=True)
time.sleep(300)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_workers_end_with_a_process_that_a_signal_ends(number):
    command = [sys.executable, "-c", WORKERS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        worker = psutil.Process(int(process.stdout.readline()))
        process.send_signal(number)
        assert process.wait(120) == -number
    psutil.wait_procs([worker], timeout=120)
    assert not worker.is_running()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_workers_end_with_a_sweep_that_a_signal_ends(tmp_path):
    endless = ("method=random", "method.evaluations=100000", "trials=10000", "hydra.launcher.n_jobs=2")
    scenes = ("scene=homogeneous,two_cubes", "solver.spacing=2.4e-3", "plane_spacing=0.02")
    command = [sys.executable, "-m", "autdtorch", "-m", "hydra/launcher=joblib", *scenes, *endless]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}
    sweep = subprocess.Popen(command, cwd=tmp_path, **quiet)
    parent = psutil.Process(sweep.pid)
    wait(lambda: len(parent.children(recursive=True)) >= 2, sweep)
    workers = parent.children(recursive=True)
    sweep.send_signal(signal.SIGTERM)
    assert sweep.wait(120) == -signal.SIGTERM
    _, alive = psutil.wait_procs(workers, timeout=120)
    assert not alive
