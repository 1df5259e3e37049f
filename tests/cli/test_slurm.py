"""Slurm: answers of its queue, and jobs that are killed or run out of time and lose nothing."""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import signal
import subprocess
import sys
import time

import pytest
from hydra import compose, initialize_config_dir
from one_node_slurm import missing_programs, one_node_slurm

from autdtorch.cli import slurm
from autdtorch.cli.main import CONFIGS
from autdtorch.cli.slurm import QueueWatcher
from autdtorch.study.folder import TrialFile
from autdtorch.study.results_file import load_results

pytest.importorskip("submitit")

pytestmark = pytest.mark.processes


@pytest.fixture
def squeue(tmp_path, monkeypatch):
    """Puts a shell script in the place of `squeue`; there is none before."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(slurm, "_PAUSE", (0.0, 0.0))

    def install(script):
        (tmp_path / "squeue").write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        (tmp_path / "squeue").chmod(0o755)

    return install


@pytest.fixture
def watcher():
    watcher = QueueWatcher("logs/%j")
    watcher.register_job("7_0")
    return watcher


def answering(*rows):
    """A script that fills each row into the format that it is given, as `squeue` does."""
    lines = ['for format; do case "$format" in --format=*) format=${format#--format=};; esac; done']
    for row in rows:
        lines.append("line=$format")
        for field, value in zip(("%F", "%T", "%r"), row, strict=True):
            lines.append(f'line="${{line%%{field}*}}{value}${{line#*{field}}}"')
        lines.append('echo "$line"')
    return "\n".join(lines)


def test_a_job_without_a_reason_is_in_the_queue(squeue, watcher):
    squeue(answering(("7", "RUNNING", ""), ("8", "PENDING", "Priority")))
    assert not watcher.is_done("7_0")
    squeue(answering(("8", "PENDING", "")))
    assert watcher.is_done("7_0")


def test_why_jobs_wait_is_told_with_all_words_of_the_reason(squeue, watcher, caplog):
    squeue(answering(("7", "PENDING", "ReqNodeNotAvail, Reserved | for maintenance")))
    with caplog.at_level(logging.INFO):
        assert not watcher.is_done("7_0")
    assert caplog.messages == ["jobs wait in the queue: ReqNodeNotAvail, Reserved | for maintenance"]


REFUSE = "echo 'slurm_load_jobs error:' >&2\necho 'no controller' >&2\nexit 1"


@pytest.mark.parametrize(
    ("script", "reason"),
    [(None, "No such file or directory: 'squeue'"), (REFUSE, "error: no controller")],
    ids=["missing", "refused"],
)
def test_a_squeue_that_fails_for_good_ends_the_wait_in_a_line_that_says_what_to_do(
    squeue, watcher, caplog, script, reason
):
    if script is not None:
        squeue(script)
    with caplog.at_level(logging.INFO):
        for _ in range(slurm._MOST_FAILURES - 1):
            assert not watcher.is_done("7_0")
    (told,) = (each.getMessage() for each in caplog.records if each.name == slurm.logger.name)
    assert reason in told
    with pytest.raises(OSError, match=rf"{reason}.* jobs 7 may still run; .* the same command") as caught:
        watcher.is_done("7_0")
    assert "\n" not in str(caught.value) + told


def test_failures_are_counted_anew_after_an_answer(squeue, watcher):
    for _ in range(2):
        squeue("exit 1")
        for _ in range(slurm._MOST_FAILURES - 1):
            assert not watcher.is_done("7_0")
        squeue(answering(("7", "RUNNING", "None")))
        assert not watcher.is_done("7_0")


TRIALS = 20
SWEEP = ("scene=sphere", "solver.spacing=2.8e-3", "solver.tolerance=0.1", "plane_spacing=0.02", "seed=0,1")
SWEEP += ("method=gabs", f"trials={TRIALS}")
# With a limit below ten minutes, submitit takes every signal for the one that Slurm sends before the limit.
LAUNCHER = ("hydra/launcher=slurm", "hydra.launcher.timeout_min=5", "hydra.launcher.mem_gb=1")

# A sitecustomize.py: a job that runs for the first time waits after a block of trials for what disturbs it.
HALTING = f"""
import os, time

def append_and_wait(*block):
    append(*block)
    time.sleep(300)

if "SLURM_JOB_ID" in os.environ and os.environ.get("SLURM_RESTART_COUNT", "0") == "0":
    from {TrialFile.__module__} import TrialFile
    append, TrialFile.append = TrialFile.append, append_and_wait
"""

# submitit waits 15 s for the results of a job that has ended, as network drives are slow.
IMPATIENT = """
from submitit.core.core import Job
from autdtorch.cli import main, slurm
slurm._PAUSE = (1.0, 1.0)
Job._results_timeout_s = 1
main.main()
"""


@pytest.fixture(scope="module")
def cluster():
    """The environment in which Slurm's commands find the cluster."""
    if missing := missing_programs():
        pytest.skip(f"no {', '.join(missing)}; python scripts/one_node_slurm.py true installs them")
    with one_node_slurm() as environment:
        yield environment


def job_folder(sweep, seed):
    (folder,) = sweep.glob(f"*seed={seed}*")
    return folder


def finished_trials(sweep, seed):
    return sum(file.read_bytes().count(b"\n") for file in sweep.glob(f"*seed={seed}*/trials.jsonl"))


def answer(cluster, *command):
    return subprocess.check_output(command, env=cluster, text=True)


def kill(job, cluster):
    """Kill the process of a job, as a node short of memory does."""
    number = answer(cluster, "squeue", "--noheader", "--format=%A", f"--job={job}").strip()
    rows = [line.split() for line in answer(cluster, "scontrol", "listpids", number).splitlines()]
    (process,) = (int(pid) for pid, _, step, task, _ in rows if (step, task) == ("0", "0"))
    os.kill(process, signal.SIGKILL)


def run_out_of_time(job, cluster):
    """Send a job what Slurm sends before the time limit."""
    answer(cluster, "scancel", "--signal=USR2", job)


def test_disturbed_jobs_end_with_the_numbers_of_undisturbed_ones(cluster, tmp_path, run, write):
    write("halting/sitecustomize.py", HALTING)
    paths = filter(None, (str(tmp_path / "halting"), os.environ.get("PYTHONPATH")))
    environment = cluster | {"PYTHONPATH": os.pathsep.join(paths)}
    assert run("-m", *SWEEP) == 0
    undisturbed, disturbed = tmp_path / "multirun", tmp_path / "auf Slurm, gestört"
    same = (*SWEEP, f"hydra.sweep.dir='{disturbed}'")
    command = [sys.executable, "-c", IMPATIENT, "-m", *LAUNCHER, "hydra.launcher.cpus_per_task=1"]

    popen = subprocess.Popen([*command, *same], env=environment, stderr=subprocess.PIPE, text=True)
    with popen as sweep, contextlib.ExitStack() as ending:
        ending.callback(sweep.kill)  # a failure would otherwise wait for it
        for seed, disturb in ((0, kill), (1, run_out_of_time)):
            while not finished_trials(disturbed, seed):
                assert sweep.poll() is None
                time.sleep(0.1)
            (number,) = (path.name[:-2] for path in (disturbed / ".submitit").glob("*_0"))
            disturb(f"{number}_{seed}", cluster)
            assert finished_trials(disturbed, seed) < TRIALS
        _, errors = sweep.communicate()
    assert sweep.returncode == 2
    assert f"job {number}_0" in errors.splitlines()[-1]
    assert "sacct" not in errors
    assert not (job_folder(disturbed, 0) / "results.h5").exists()
    assert (job_folder(disturbed, 1) / "results.h5").exists()
    assert "Restarts=1" in answer(cluster, "scontrol", "show", "job", f"{number}_1")

    assert run("-m", *same) == 0
    for seed in (0, 1):
        sweeps = (undisturbed, disturbed)
        one, other = (load_results(job_folder(sweep, seed)).scenes["sphere"] for sweep in sweeps)
        assert one.transfer_matrix.equal(other.transfer_matrix)
        for key in ("drive", "pressure", "score", "evaluations", "history"):
            values = [getattr(scene.methods["gabs"].solution, key) for scene in (one, other)]
            assert values[0].equal(values[1]), key


def test_a_job_may_use_the_cores_that_it_asks_for(cluster, tmp_path):
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        launcher = compose("config", ["hydra/launcher=slurm"], return_hydra_config=True).hydra.launcher
    cores, output = len(os.sched_getaffinity(0)), tmp_path / "cores"
    count = "import os; print(len(os.sched_getaffinity(0)), os.environ['OMP_NUM_THREADS'])"
    script = "\n".join(["#!/bin/bash", *launcher.setup, shlex.join(["srun", sys.executable, "-c", count])])
    asked = ["--nodes=1", "--ntasks-per-node=1", f"--cpus-per-task={cores}"]  # as submitit asks
    submit = ["sbatch", "--wait", f"--output={output}", *asked]
    subprocess.run(submit, input=script, env=cluster, text=True, check=True)
    assert output.read_text(encoding="utf-8").split() == [str(cores), str(cores)]
