from pathlib import Path

import numpy as np
import pytest
import torch
from benchmarks.peer_programs.task import Answer, Task
from benchmarks.peer_scene import next_smooth, scene_grid, spread
from benchmarks.peers import OURS, Point, requirements, settled
from shared.cases import free_space_case, sphere_case

import autdtorch as at


def task() -> Task:
    return Task(
        density=np.ones((3, 4, 5), np.float32), sound_speed=340.0, spacing=1e-3, frequency=40e3,
        time_step=1e-6, steps_per_period=12, source_cells=np.array([[1, 2, 3]]),
        source_weights=np.ones(1, np.float32), receiver_cells=np.array([[0, 0, 0], [2, 3, 4]]),
        ends=np.array([6, 9]), layer_cells=8, order=4,
    )  # fmt: skip


def point(program: str, error: float, seconds: float, remaining: float = 0.0, case: str = "cubes"):
    return Point(case, program, "1 mm", 20, remaining, error, seconds, None)


def test_tasks_and_answers_survive_their_files(tmp_path: Path) -> None:
    for one in (task(), Answer(np.array([[1 + 2j]]), 0.5, 2.0, 0.0, 60)):
        one.save(tmp_path / "one.npz")
        loaded = vars(type(one).load(tmp_path / "one.npz"))
        assert all(np.array_equal(loaded[name], value) for name, value in vars(one).items())
        assert [type(value) for value in loaded.values()] == [type(value) for value in vars(one).values()]


def test_phasors_are_those_of_our_sign() -> None:
    asked = task()
    assert asked.drive()[0] == 0
    recorded = np.array([[1.0, 0.3]]) * asked.drive()[:, None]
    late = np.array([[1.0, 0.3]]) * asked.drive(-1.5)[:, None]
    # the transform takes whole periods after the ramp: exact to rounding
    assert np.allclose(asked.phasors(recorded), [[1, 0.3]] * 2, atol=1e-12)
    turned = np.exp(2j * np.pi * 1.5 / 12)  # e^{-i w t}: what comes later is turned forwards
    assert np.allclose(asked.phasors(late)[1], turned * np.array([1, 0.3]), atol=1e-12)


def test_points_between_cells_read_waves() -> None:
    kappa = 2 * np.pi / 8.5
    place = np.array([20.3, 20.0, 20.5])
    cells, weights = spread(place)
    for direction in np.array([[1, 0, 0], [0.6, 0, 0.8], [0.48, 0.6, 0.64]]):
        read = weights @ np.exp(1j * kappa * cells @ direction)
        # 1e-3 is what a sinc of this width reaches at 8.5 cells per wavelength (Hicks 2002)
        assert abs(read - np.exp(1j * kappa * place @ direction)) < 2e-3


def test_grids_hold_the_scene() -> None:
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


def test_densities_are_harmonic_means() -> None:
    scene = sphere_case("sphere").scene
    grid = scene_grid(scene, 2e-3, 0.0, 8, smooth=True)
    sphere = scene.obstacles[0]
    assert isinstance(sphere, at.Sphere)
    light, heavy = 1 / scene.medium.density, 1 / sphere.density
    filled = (light - 1 / grid.density.astype(float)).sum() / (light - heavy) * (2e-3) ** 3
    # 1 % is what points a third of a millimetre apart tell of a volume of 16 mm across
    assert filled == pytest.approx(4 / 3 * torch.pi * sphere.radius**3, rel=1e-2)
    assert all(next_smooth(n + 16) == n + 16 for n in grid.density.shape)


def test_requirements_compare_the_fastest_peer_to_each_error() -> None:
    points = [
        point(OURS, 0.009, 0.5, case="three cubes"),
        point("jwave", 0.08, 5.0, case="three cubes"),
        point("kwave", 0.04, 600.0, case="three cubes"),
    ]
    rows = [line.split(" | ")[1:] for line in requirements(points).splitlines()[2:]]
    # nobody was measured in free space
    assert rows == [["20 %", "at least 4", "10", "yes |"], ["10 %", "at least 20", "10", "**no** |"]]


def test_runs_count_once_they_stay_in_the_steady_state() -> None:
    run = [point("jwave", 0.1, t, left) for t, left in ((1, 0.3), (2, 0.009), (3, 0.02), (4, 0.005), (5, 0))]
    assert [p.seconds for p in settled(run)] == [4]
