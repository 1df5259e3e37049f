"""Threads and memory of this process, which control groups limit."""

import functools
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from small_scenes import CUBE, small_scene
from threadpoolctl import threadpool_info

import autdtorch as at
from autdtorch.fdtd.kernels import cpu
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.study.run_study import run_study
from autdtorch.utils import process


@pytest.fixture
def four_threads(monkeypatch, set_threads):
    monkeypatch.setattr(process, "_processors", lambda: 8)
    set_threads(4)


def in_new_thread() -> int:
    found = []
    new = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    new.start()
    new.join()
    return found[0]


def test_work_within_work_shares_the_threads(four_threads: None) -> None:
    def inner(_: int) -> int:
        return process.thread_count()

    assert [process.spread(inner, range(count)) for count in (1, 2, 3, 9)] == [[4], [2] * 2, [1] * 3, [1] * 9]


@pytest.mark.parametrize("threads", [1, 2, 3, 4, 7, 8, 16, 64])
@pytest.mark.parametrize("edge", [40, 130, 250, 500])
def test_runs_at_once_occupy_the_threads_and_limited_memory(threads, edge, monkeypatch) -> None:
    """Four runs of one thread each left most of many processors idle on large grids."""
    monkeypatch.setattr(cpu, "thread_count", lambda: threads)
    kernel, shape = CpuKernel(), (edge,) * 3
    chunks, runs = len(cpu._cuts(shape)) - 1, kernel.at_once(shape)
    busy = runs * min(chunks, threads // runs)
    assert min(threads, chunks) * 0.75 <= busy <= threads
    assert runs <= max(1, threads // chunks) or runs * edge**3 <= 2**27


@pytest.mark.usefixtures("four_threads")
def test_torch_and_numpy_have_one_thread_inside_and_what_they_had_outside() -> None:
    with process.one_library_thread():
        assert torch.get_num_threads() == 1
        assert process.thread_count() == 4
        with process.one_library_thread():
            assert process.thread_count() == 4
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == in_new_thread() == 4

    def counts() -> list[int]:
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    before = counts()
    with process.one_library_thread():
        with process.one_library_thread():
            pass
        assert all(count == 1 for count in counts())
    assert counts() == before


@pytest.mark.usefixtures("four_threads")
def test_threads_that_leave_in_the_order_they_entered_leave_nothing_behind() -> None:
    entered, left = threading.Event(), threading.Event()
    seen = []

    def second() -> None:
        with process.one_library_thread():
            seen.append(process.thread_count())
            entered.set()
            left.wait(60)

    other = threading.Thread(target=second)
    with process.one_library_thread():
        other.start()
        assert entered.wait(60)
    left.set()
    other.join()
    assert seen == [4]
    assert torch.get_num_threads() == in_new_thread() == 4


@pytest.mark.usefixtures("four_threads")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here")
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_a_child_has_one_thread_also_after_leaving_what_its_parent_had_entered() -> None:
    with process.one_library_thread():
        child = os.fork()
        inside = process.thread_count()
    if child == 0:
        libraries = [each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]
        os._exit(max(inside, torch.get_num_threads(), *libraries))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    assert torch.get_num_threads() == 4


AIR = small_scene()
OBJECTIVE = at.SimulatedObjective(AIR, at.make_propagator(AIR))
DRIVE = at.drive_from_phases(torch.zeros(4, dtype=torch.float64))
WIDE = small_scene((at.Box((0.1, 0.1, 0.1), (0.09, 0.09, 0.09), rigid=True),), extent=0.2)

HUGE: dict[str, tuple[str, Callable[[], object]]] = {
    "cells": ("spacing", lambda: at.make_propagator(WIDE, "full", 1.8e-5)),
    "cells of a box": ("spacing", lambda: at.make_propagator(WIDE, "box", 1.8e-5)),
    "transducers": ("shape", lambda: at.TransducerArray.grid((10**5, 10**5), 1e-3, (0, 0, 0))),
    "units": ("units", lambda: at.TransducerArray.autd3((0, 0, 0), units=(10**5, 10**5))),
    "points": ("count", lambda: at.circle_points((0, 0, 0), 0.1, 10**18, (1, 0, 0))),
    "samples": ("spacing", lambda: at.Plane((0, 0, 0), (1, 0, 0), (1, 1)).points(1e-9)),
    "trials of gabs": ("trials", lambda: at.gabs(OBJECTIVE, trials=10**11)),
    "levels of gabs": ("levels", lambda: at.gabs(OBJECTIVE, levels=10**10)),
    "passes of gabs": ("passes", lambda: at.gabs(OBJECTIVE, passes=10**12)),
    "levels of lssg": ("levels", lambda: at.lssg(OBJECTIVE, levels=10**10)),
    "random drives": ("evaluations", lambda: at.random_search(OBJECTIVE, evaluations=10**12)),
    "random trials": ("trials", lambda: at.random_search(OBJECTIVE, trials=10**11)),
    "bayes_opt": ("evaluations", lambda: at.bayes_opt(OBJECTIVE, 10**9, fixed_transducer=0)),
    "identify": ("evaluations", lambda: at.identify(OBJECTIVE, evaluations=10**11)),
    "starts": ("starts", lambda: at.gradient_ascent(OBJECTIVE, starts=10**11)),
    "steps": ("steps", lambda: at.gradient_ascent(OBJECTIVE, steps=10**12)),
    "numbers of trials": ("trials", lambda: at.gabs(OBJECTIVE, trials=range(10**11))),
    "study": ("trials.gabs", lambda: run_study({"a": AIR}, {"gabs": at.gabs}, Path(), trials=10**11)),
}


@pytest.mark.parametrize("what", HUGE)
def test_too_much_memory_is_refused_with_both_figures(what: str) -> None:
    field, call = HUGE[what]
    with pytest.raises(ValueError, match=rf"^{field}: .* needs about .* GB of memory, .* may use .* GB$"):
        call()


def test_too_many_earlier_readings_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    drives = at.drive_from_phases(torch.rand((10**4, 4), dtype=torch.float64))
    readings = at.Readings(drives, torch.ones((10**4, len(AIR.control_points)), dtype=torch.float64))
    monkeypatch.setattr(process, "available_memory", lambda: 1e6)
    monkeypatch.setattr(process, "_NEGLIGIBLE", 0)
    with pytest.raises(ValueError, match=r"^readings: 10000; needs about 0\.0.* GB of memory"):
        at.identify(OBJECTIVE, readings=readings)


@pytest.mark.parametrize("obstacles", [(), (CUBE,)], ids=["free space", "box"])
def test_many_points_are_refused(obstacles: tuple[at.Box, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    propagator = at.make_propagator(small_scene(obstacles), "box" if obstacles else "free_space", 2e-3)
    assert not obstacles or propagator.planned_runs > 0  # its grid is assembled
    points = at.circle_points((0.1, 0, 0), 0.02, 8000, (1, 0, 0))
    monkeypatch.setattr(process, "available_memory", lambda: 1_000_000)
    for call in (propagator.transfer_matrix, functools.partial(propagator.field, DRIVE.expand(3, 4))):
        with pytest.raises(ValueError, match=r"^points: \(8000, 3\); needs about"):
            call(points)


def test_many_transducers_need_no_matrix_of_their_distances() -> None:
    array = at.TransducerArray.grid((300, 300), 10e-3, (0, 0, 0))  # 65 GB, if it took one
    assert len(array) == 90_000


def test_the_first_evaluations_by_strength_count(monkeypatch: pytest.MonkeyPatch) -> None:
    # each trial plays every transducer alone, all in one call of the objective: 16 bytes x M^2, and copies
    monkeypatch.setattr(process, "available_memory", lambda: 10_000_000)
    array = at.TransducerArray.grid((16, 16), 10e-3, (0, 0, 0))
    scene = at.Scene(array, AIR.medium, 40e3, [(0.1, 0.0, 0.0)])
    objective = at.SimulatedObjective(scene, at.make_propagator(scene))
    at.gabs(objective, levels=2)
    with pytest.raises(ValueError, match=r"^levels: 2; needs about"):
        at.gabs(objective, levels=2, order="strength", trials=20)


def test_a_study_needs_the_memory_of_a_block_of_its_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "available_memory", lambda: 5_000_000)
    with pytest.raises(ValueError, match=r"^evaluations: 3000; needs about"):
        at.random_search(OBJECTIVE, evaluations=3000, trials=75)
    method = functools.partial(at.random_search, evaluations=3000)
    study = run_study({"a": AIR}, {"random": method}, tmp_path, trials=75)
    assert len(study.scenes["a"].methods["random"].solution.score) == 75


def test_a_chosen_spacing_is_refused_by_the_tolerance(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = small_scene((CUBE,))
    coarse = at.estimate(scene, 2e-3, method="box").memory
    monkeypatch.setattr(process, "available_memory", lambda: int(6 * coarse))
    with pytest.raises(ValueError, match=r"^tolerance: 0\.0001; its first grid has spacing: .* needs about"):
        at.make_propagator(scene, "box", spacing=None, tolerance=1e-4)
    reached = at.make_propagator(scene, "box", spacing=None, tolerance=1e-4, seconds=1e3)
    assert at.estimate(scene, reached.spacing, method="box").memory < 6 * coarse


def test_the_second_grid_of_an_error_is_refused_before_any_run(monkeypatch: pytest.MonkeyPatch) -> None:
    propagator = at.make_propagator(small_scene((CUBE,)), "box", 2e-3, cache=False)
    between = (propagator.plan.memory + propagator.plan.second.memory) / 2
    assert propagator.plan.second.spacing < propagator.spacing
    for call in (propagator.point_errors, lambda: propagator.transfer_matrix(return_error=True)):
        monkeypatch.setattr(process, "available_memory", lambda: int(between))
        with pytest.raises(
            ValueError, match=r"^spacing: 0\.002 m; the second grid of its error .* needs about"
        ):
            call()
        assert not propagator.runs
    monkeypatch.undo()  # a refusal is that of its moment
    assert not propagator.plan.second.refusal
    assert propagator.transfer_matrix(return_error=True)[1] > 0


def test_a_plan_is_refused_by_the_memory_of_the_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    planned = at.make_propagator(small_scene((CUBE,)), "box", 1e-3).plan
    monkeypatch.setattr(process, "available_memory", lambda: 1_000_000)
    assert "needs about" in planned.refusal
    monkeypatch.undo()
    assert not planned.refusal


def test_the_simulation_of_a_body_is_refused_as_that_of_a_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    propagator = at.make_propagator(small_scene((CUBE,)), "tmatrix", spacing=0.7e-3)
    monkeypatch.setattr(process, "available_memory", lambda: int(propagator.plan.memory / 2))
    with pytest.raises(ValueError, match=r"^spacing: 0\.0007 m; needs about"):
        propagator.transfer_matrix()


def group(folder: Path, most: object, used: int, inactive: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    files = {"memory.max": most, "memory.current": used, "memory.stat": f"inactive_file {inactive}"}
    for name, content in files.items():
        (folder / name).write_text(f"{content}\n", encoding="ascii")


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of control groups, with no other limit of the process."""
    monkeypatch.setattr(process, "_MOUNT", tmp_path / "fs")
    monkeypatch.setattr(process, "_CGROUP", tmp_path / "cgroup")
    monkeypatch.setattr(process, "_left_to_process", lambda: iter(()))
    (tmp_path / "fs").mkdir()
    return tmp_path


def test_the_tightest_of_nested_groups_of_either_version_counts(groups: Path) -> None:
    assert process.available_memory() > 10_000_000  # without groups, the machine's
    (groups / "cgroup").write_text("0::/job/step\n", encoding="utf-8")
    group(groups / "fs/job", most=5_000_000, used=4_000_000, inactive=500_000)
    group(groups / "fs/job/step", most="max", used=1_000_000, inactive=0)
    assert process.available_memory() == 1_500_000  # what is cached of files can be dropped
    group(groups / "fs/job", most=1_000_000, used=2_000_000, inactive=0)
    assert process.available_memory() == 0
    (groups / "cgroup").write_text("5:cpu:/\n4:memory:/job\n", encoding="utf-8")
    own = groups / "fs/memory/job"
    own.mkdir(parents=True)
    (own / "memory.limit_in_bytes").write_text("3000000\n", encoding="ascii")
    (own / "memory.usage_in_bytes").write_text("2000000\n", encoding="ascii")
    (own / "memory.stat").write_text("cache 7\ntotal_inactive_file 0\n", encoding="ascii")
    assert process.available_memory() == 1_000_000
