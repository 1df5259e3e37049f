"""The commands of scripts/ and their blocks in the docs; cases and reports of benchmarks and studies."""

import contextlib
import importlib
import itertools
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks.accuracy import Row, compare, observed_order, store_reference, worst_point, write_report
from benchmarks.peer_programs.task import Answer, Task
from benchmarks.peer_scene import next_smooth, scene_grid, spread
from benchmarks.peers import OURS, Point, settled, times
from benchmarks.pictures import measured
from checks.damage import check
from shared import cases, document
from shared.cases import cube_case, free_space_case, piston_case, simulate, slab_case, sphere_case, wall_case
from shared.document import DOCS, with_block
from shared.runner import SCRIPTS, commands, run
from shared.scenes import MIDDLE, paper_scene, with_array
from small_scenes import small_scene
from studies.conditions import CONDITIONS, outcome

import autdtorch as at
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.plot.cost_figures import fit_power
from autdtorch.propagators import FreeSpacePropagator
from autdtorch.propagators.free_space import free_space_matrix

FOLDERS = {"benchmark": "benchmarks", "check": "checks", "study": "studies"}
PATHS = os.pathsep.join((str(SCRIPTS), str(SCRIPTS.parent)))
OUTPUT: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 120}


@pytest.mark.parametrize("script", FOLDERS)
def test_every_command_has_a_summary_and_its_block_in_the_documentation(script: str) -> None:
    summaries = commands(FOLDERS[script])
    assert summaries
    for name, summary in summaries.items():
        assert summary.endswith(".")
        source = (SCRIPTS / FOLDERS[script] / f"{name}.py").read_text(encoding="utf-8")
        for page in re.findall(r'^DOCUMENT = "(.+)"', source, re.MULTILINE):
            with_block((DOCS / page).read_text(encoding="utf-8"), f"{script}.py {name}", "")


@pytest.mark.parametrize("folder", FOLDERS.values())
def test_the_help_of_every_command_is_printed_and_nothing_is_started(
    folder: str, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, flag in zip(commands(folder), itertools.cycle(("--help", "-h")), strict=False):
        with contextlib.suppress(ModuleNotFoundError):  # of an extra; there is a help without its options
            module = importlib.import_module(f"{folder}.{name}")
            monkeypatch.setattr(module, "main", lambda **_: pytest.fail("the work was started"))
        monkeypatch.setattr(sys, "argv", [folder, name, flag])
        try:
            status = run(folder, "")
        except SystemExit as end:
            status = end.code
        assert status == 0, name
        assert capsys.readouterr().out.startswith("usage: ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("script", [*FOLDERS, "hardware_trial", "one_node_slurm"])
def test_the_help_of_a_script_is_printed_and_nothing_is_started(script: str, tmp_path) -> None:
    code = [sys.executable, SCRIPTS / f"{script}.py", "--help"]
    done = subprocess.run(code, cwd=tmp_path, env=os.environ | {"PYTHONPATH": PATHS}, **OUTPUT)
    assert done.returncode == 0, done.stderr
    source = (SCRIPTS / f"{script}.py").read_text(encoding="utf-8")
    assert source.partition('"""')[2].partition("\n")[0].removesuffix('"""') in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_command_without_its_package_is_refused_in_a_line(monkeypatch, capsys) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name}", name="acoustools")

    monkeypatch.setattr("shared.runner.importlib.import_module", missing)
    monkeypatch.setattr(sys, "argv", ["check.py", "bound"])
    with pytest.raises(SystemExit) as end:
        run("checks", "")
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("checks/bound.py needs acoustools, which is not installed")


def test_damaged_files_change_no_number_and_cost_no_undamaged_line(tmp_path) -> None:
    counts, wrong = check(damages=5, seed=1, folder=tmp_path)
    assert counts.total() == 5
    assert wrong == []


SIZES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


@pytest.mark.parametrize("spacings", [(1.0, 0.7), (1.0, 0.7, 0.5)])
def test_the_order_of_a_power_law_is_its_power(spacings: tuple[float, ...]) -> None:
    assert observed_order(spacings, [0.3 * h**1.7 for h in spacings]) == pytest.approx(1.7, rel=1e-12)


def test_errors_are_measured_of_the_scattered_field_too() -> None:
    case = sphere_case("sphere", (0.2e-3, -0.3e-3, 0.1e-3))
    free = free_space_matrix(case.points, case.scene.array, case.scene.wavenumber)
    row = compare(case, "nothing scattered", 1.0, cases.SimulatedCase(free, 0.0, True))
    # two sums of the same series; 1e-9 of the smaller scattered field is far above rounding
    assert row.scattered == pytest.approx(1, abs=1e-9)
    row = worst_point(1.5)
    # 0.4 % measured at 2 mm; a wrong normalisation would be of the order of one
    assert row.total < 5e-3
    assert row.settled
    assert simulate(slab_case(), 2.0).seconds > 0


@pytest.mark.parametrize("make", [lambda: sphere_case("rigid sphere"), slab_case, wall_case, piston_case])
def test_cases_are_normalised_as_free_space(make) -> None:
    case = make()
    free = free_space_matrix(case.points, case.scene.array, case.scene.wavenumber)
    # of the order of the incident field: a wall at most doubles it, 4 pi would be far outside
    assert 0.3 < float(case.exact.norm() / free.norm()) < 2


def test_cubes_reference_is_the_finest_of_the_stored_matrices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class PowerLaw:
        """Transfer matrices of free space times a function of the spacing."""

        def __init__(self, scene: at.Scene, _: str, spacing: float, tolerance: float) -> None:
            self.scene, self.factor = scene, 1 + spacing

        def transfer_matrix(self) -> torch.Tensor:
            scene = self.scene
            return self.factor * free_space_matrix(scene.control_points, scene.array, scene.wavenumber)

    monkeypatch.setattr(cases, "CUBE_MATRICES", tmp_path / "cubes.json")
    monkeypatch.setattr("benchmarks.accuracy.uncached", PowerLaw)
    store_reference()
    case = cube_case("two_cubes")
    free = free_space_matrix(case.scene.control_points[:1], case.scene.array, case.scene.wavenumber)
    assert torch.allclose(case.exact, 1.2 * free, rtol=1e-10)


def test_a_report_names_the_limits_that_are_exceeded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marks = "<!-- from scripts/benchmark.py accuracy -->\n<!-- end -->"
    (tmp_path / "benchmarks.md").write_text(marks, encoding="utf-8")
    monkeypatch.setattr(document, "DOCS", tmp_path)
    rows = [Row("sphere", "default", h, 0.02 * h, 0.05 * h, 3 / h, h > 1) for h in (2.0, 1.0)]
    page = document.Page("benchmarks.md", "benchmark.py accuracy", tmp_path)
    assert write_report(rows, page) == []
    (failed,) = write_report([Row("slab", "default", 1.0, 0.02, None, 1.0, True), *rows], page)
    assert failed.startswith("slab, default, 1 mm, total: 2 %")


@pytest.mark.parametrize(
    ("costs", "exponent", "sizes"),
    [
        ([0.3 * size**-4.0 for size in SIZES], -4.0, (1.0, 16.0)),
        ([max(4.0, size) for size in SIZES], 1.0, (8.0, 32.0)),  # a constant overhead is not fitted
        ([max(0.125, 1 / size) for size in SIZES], -1.0, (1.0, 4.0)),
    ],
)
def test_exponent_of_a_power_law_is_its_power(
    costs: list[float], exponent: float, sizes: tuple[float, float]
) -> None:
    fit = fit_power(SIZES, costs)
    assert fit is not None
    assert (fit.exponent, *fit.sizes) == pytest.approx((exponent, *sizes), rel=1e-12)
    assert fit_power(SIZES, [1.0, 1.2, 0.9, 1.0, 1.1, 1.7]) is None  # they do not grow


def test_domain_holds_paper_and_large_array() -> None:
    scene = paper_scene("two_cubes")
    lower, upper = torch.tensor(
        with_array(scene, at.TransducerArray.autd3(MIDDLE, units=(2, 1), radius=None)).domain
    )
    assert (lower < torch.tensor(scene.domain[0])).all()
    assert (upper > torch.tensor(scene.domain[1])).all()


@pytest.mark.parametrize("condition", CONDITIONS)
def test_trials_together_are_those_one_by_one(condition: str) -> None:
    scene = small_scene()
    objective = SimulatedObjective(scene, FreeSpacePropagator(scene))
    alone, together = (
        outcome(at.GABS(levels=4), objective, CONDITIONS[condition], 3, joined) for joined in (False, True)
    )
    # GABS sums in equal groups, as all trials take the same steps.
    assert torch.equal(alone.true, together.true)
    assert torch.equal(alone.observed, together.observed)
    if condition == "undisturbed":
        assert torch.equal(alone.true, alone.observed)


def task() -> Task:
    return Task(
        density=np.ones((3, 4, 5), np.float32), sound_speed=340.0, spacing=1e-3, frequency=40e3,
        time_step=1e-6, steps_per_period=12, source_cells=np.array([[1, 2, 3]]),
        source_weights=np.ones(1, np.float32), receiver_cells=np.array([[0, 0, 0], [2, 3, 4]]),
        ends=np.array([6, 9]), layer_cells=8, order=4,
    )  # fmt: skip


def point(program: str, error: float, seconds: float, remaining: float = 0.0, case: str = "cubes"):
    return Point(case, program, "1 mm", 20, remaining, error, seconds)


def test_tasks_and_answers_survive_their_files(tmp_path: Path) -> None:
    for one in (task(), Answer(np.array([[1 + 2j]]), 0.5, 2.0)):
        one.save(tmp_path / "one.npz")
        loaded = vars(type(one).load(tmp_path / "one.npz"))
        assert all(np.array_equal(loaded[name], value) for name, value in vars(one).items())
        assert [type(value) for value in loaded.values()] == [type(value) for value in vars(one).values()]


def test_points_between_cells_read_waves_and_phasors_are_those_of_our_sign() -> None:
    asked = task()
    assert asked.drive()[0] == 0
    recorded = np.array([[1.0, 0.3]]) * asked.drive()[:, None]
    late = np.array([[1.0, 0.3]]) * asked.drive(-1.5)[:, None]
    # the transform takes whole periods after the ramp: exact to rounding
    assert np.allclose(asked.phasors(recorded), [[1, 0.3]] * 2, atol=1e-12)
    turned = np.exp(2j * np.pi * 1.5 / 12)  # e^{-i w t}: what comes later is turned forwards
    assert np.allclose(asked.phasors(late)[1], turned * np.array([1, 0.3]), atol=1e-12)
    kappa = 2 * np.pi / 8.5
    place = np.array([20.3, 20.0, 20.5])
    cells, weights = spread(place)
    for direction in np.array([[1, 0, 0], [0.6, 0, 0.8], [0.48, 0.6, 0.64]]):
        read = weights @ np.exp(1j * kappa * cells @ direction)
        # 1e-3 is what a sinc of this width reaches at 8.5 cells per wavelength (Hicks 2002)
        assert abs(read - np.exp(1j * kappa * place @ direction)) < 2e-3


def test_grids_hold_the_scene_and_densities_are_harmonic_means() -> None:
    scene = free_space_case().scene
    on, between = (scene_grid(scene, 1e-3, offset, 8, smooth=False) for offset in (0.0, 0.5))
    assert on.source_cells.shape == (1, 3)
    assert (on.receiver_weights.sum(axis=0) == 1).all()
    apart = on.receiver_cells - on.source_cells
    wanted = 1e3 * (scene.array.positions - scene.control_points[0]).numpy()
    assert sorted(map(tuple, apart)) == sorted(map(tuple, wanted.round().astype(int)))
    for grid in (on, between):
        assert np.allclose(grid.density, scene.medium.density)
        cells = np.concatenate((grid.source_cells, grid.receiver_cells))
        assert (cells >= 0).all()
        assert (cells < grid.density.shape).all()
        assert np.allclose(grid.receiver_weights.sum(axis=1), 1)
    scene = sphere_case("sphere").scene
    grid = scene_grid(scene, 2e-3, 0.0, 8, smooth=True)
    sphere = scene.obstacles[0]
    assert isinstance(sphere, at.Sphere)
    light, heavy = 1 / scene.medium.density, 1 / sphere.density
    filled = (light - 1 / grid.density.astype(float)).sum() / (light - heavy) * (2e-3) ** 3
    # 1 % is what points a third of a millimetre apart tell of a volume of 16 mm across
    assert filled == pytest.approx(4 / 3 * torch.pi * sphere.radius**3, rel=1e-2)
    assert all(next_smooth(n + 16) == n + 16 for n in grid.density.shape)


def test_the_fastest_settled_run_to_an_error_counts() -> None:
    points = [point(OURS, 0.09, 0.5), point(OURS, 0.009, 0.7), point("jwave", 0.2, 5.0)]
    rows = [line.split(" | ") for line in times(points).splitlines()[2:]]
    assert rows == [["| cubes", "0.5, 0.9", "-, 20 |"]]
    run = [point("jwave", 0.1, t, left) for t, left in ((1, 0.3), (2, 0.009), (3, 0.02), (4, 0.005), (5, 0))]
    assert [p.seconds for p in settled(run)] == [4]


def test_foci_are_equal_after_few_pictures() -> None:
    # the transducers' gains and phases, and the array's place, from two dozen pictures of 45 points
    array = at.TransducerArray.grid((5, 5), 10e-3, (0.0, 0.0, 0.0), (1, 0, 0))
    places = [[80e-3, 5e-3 * y, 5e-3 * z] for y in range(-3, 4) for z in range(-3, 3)]
    foci = [[80e-3, -20e-3, 0.0], [80e-3, 20e-3, 10e-3], [80e-3, 0.0, 20e-3]]
    scene = at.Scene(array, at.Medium(1.2, 340.0), frequency=40e3, control_points=torch.tensor(foci + places))
    result = measured(at.make_propagator(scene), {"array.y": 2e-3}, 3, "pictures", 16, 8, seed=0)
    assert result.weakest > 0.97
    assert result.largest < 0.03
