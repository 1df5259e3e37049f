"""The 3D view: rendered where an OpenGL driver is found; a missing driver is reported, not fatal."""

import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scenes import scene_of_all_kinds, small_scene

import autdtorch as at
from autdtorch.view3d import rendering_problem, view3d

SPACING = 5e-3  # m, cells of the plane in the pictures


@pytest.fixture
def scene() -> at.Scene:
    return at.Scene(
        array=at.TransducerArray.grid((4, 3), pitch=10e-3, center=(0.0, 0.0, 0.0), normal=(1, 0, 0)),
        medium=at.Medium(density=1.293, sound_speed=340.0),
        frequency=40e3,
        control_points=at.circle_points(center=(80e-3, 0, 0), radius=20e-3, count=3, normal=(1, 0, 0)),
        obstacles=(at.Box(center=(40e-3, 0, 0), size=(10e-3,) * 3, rigid=True),),
        observation_plane=at.Plane(center=(80e-3, 0, 0), normal=(1, 0, 0), size=(80e-3, 60e-3)),
    )


@pytest.fixture
def renderer() -> None:
    problem = rendering_problem()
    if problem is not None:
        pytest.skip(problem)


@pytest.fixture
def broken_pyvista(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Replaces the PyVista that the probe's child process finds by the code given to it."""

    def replace(code: str) -> None:
        (tmp_path / "pyvista.py").write_text(code, encoding="utf-8")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    rendering_problem.cache_clear()
    yield replace
    rendering_problem.cache_clear()


def test_the_name_stays_the_function_after_its_module_has_been_imported() -> None:
    assert at.view3d is view3d
    assert sys.modules["autdtorch.view3d"] is not view3d


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_a_probe_killed_by_a_signal_is_a_reason(broken_pyvista: Callable[[str], None]) -> None:
    broken_pyvista("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)")
    problem = rendering_problem()
    assert problem is not None
    assert "SIGSEGV" in problem
    assert "libegl1 libgl1-mesa-dri libosmesa6" in problem


def test_a_missing_package_is_a_reason(broken_pyvista: Callable[[str], None]) -> None:
    broken_pyvista("raise ModuleNotFoundError('no such package here')")
    problem = rendering_problem()
    assert problem is not None
    assert "no such package here" in problem
    assert "autdtorch[viz]" in problem


def test_a_probe_that_hangs_is_a_reason(
    broken_pyvista: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    broken_pyvista("import time\ntime.sleep(60)")
    monkeypatch.setattr(sys.modules["autdtorch.view3d"], "_PROBE_TIMEOUT", 0.5)
    assert "did not end within 0.5 s" in str(rendering_problem())


def test_view3d_says_why_it_cannot_render(scene: at.Scene, broken_pyvista: Callable[[str], None]) -> None:
    broken_pyvista("raise SystemExit('no driver')")
    with pytest.raises(RuntimeError, match="no driver"):
        view3d(scene)


def test_bad_input_is_refused_before_anything_is_rendered(
    scene: at.Scene, broken_pyvista: Callable[[str], None]
) -> None:
    broken_pyvista("raise SystemExit('not reached')")
    with pytest.raises(ValueError, match=r"drive: shape \(2, 12\); must be \(12,\)"):
        view3d(scene, drive=torch.ones(2, 12, dtype=torch.complex128))
    with pytest.raises(ValueError, match=r"field: shape \(7,\); must be \(Nu, Nv\)"):
        view3d(scene, field=torch.ones(7))


def test_a_field_needs_an_observation_plane(scene: at.Scene) -> None:
    without = at.Scene(scene.array, scene.medium, scene.frequency, scene.control_points)
    with pytest.raises(ValueError, match="without observation plane"):
        view3d(without, field=torch.ones(3, 3))


@pytest.mark.usefixtures("renderer")
def test_a_picture_is_written_and_not_blank(scene: at.Scene, tmp_path: Path) -> None:
    import matplotlib.image

    view3d(scene, screenshot=tmp_path / "scene.png").close()
    picture = matplotlib.image.imread(tmp_path / "scene.png")
    assert picture.shape[:2] == (900, 1400)
    # The discs are drawn without lighting, so that their colour is exact: at least 100 pixels each, of 12.
    disc = np.abs(picture[..., :3] - np.array([0x00, 0x72, 0xB2]) / 255).max(axis=-1) < 0.01
    assert disc.sum() > 1200


@pytest.mark.usefixtures("renderer")
def test_obstacles_are_drawn_where_they_are_in_millimetres(tmp_path: Path) -> None:
    scene = scene_of_all_kinds(tmp_path)
    plotter = view3d(scene)
    drawn = [mesh.bounds for mesh in plotter.meshes]
    plotter.close()
    for obstacle in scene.obstacles:
        vertices, _ = obstacle.surface()
        wanted = 1e3 * torch.stack([vertices.amin(dim=0), vertices.amax(dim=0)]).T.reshape(-1).numpy()
        assert any(np.allclose(bounds, wanted, atol=1e-4) for bounds in drawn)  # VTK keeps float32


@pytest.mark.usefixtures("renderer")
def test_a_wall_is_drawn_as_far_as_the_domain() -> None:
    wall = at.Box((50e-3, 40e-3, 40e-3), (10e-3, 1.0, 1.0), rigid=True)
    outside = at.Sphere((85e-3, 85e-3, 85e-3), 8e-3, rigid=True)  # but for its bounding box
    plotter = view3d(small_scene((wall, outside), extent=80e-3))
    bounds = [mesh.bounds for mesh in plotter.meshes]
    plotter.close()
    assert any(np.allclose(found, (45, 55, 0, 80, 0, 80), atol=1e-4) for found in bounds)  # VTK keeps float32


@pytest.mark.usefixtures("renderer")
def test_meshes_hold_the_phases_and_pressures_given_in_millimetres(scene: at.Scene) -> None:
    assert scene.observation_plane is not None
    drive = at.drive_from_phases(torch.linspace(0, 6, len(scene.array)))
    points = scene.observation_plane.points(SPACING)
    pressure = at.green(points.reshape(-1, 3), scene.array.positions, scene.wavenumber) @ drive
    pressure = pressure.reshape(points.shape[:2])
    plotter = view3d(scene, drive=drive, field=pressure)
    (sheet,) = (mesh for mesh in plotter.meshes if "pressure" in mesh.array_names)
    discs, _arrows = (mesh for mesh in plotter.meshes if "phase" in mesh.array_names)
    limits = {title: bar.lookup_table.GetRange() for title, bar in plotter.scalar_bars.items()}
    plotter.close()

    # Cell by cell: drawn at the point of the plane in mm (1e-4 mm: VTK keeps float32), with the |p| there.
    order = np.lexsort(np.round(sheet.cell_centers().points, 3).T)
    wanted = 1e3 * points.reshape(-1, 3).numpy()
    wanted_order = np.lexsort(np.round(wanted, 3).T)
    np.testing.assert_allclose(sheet.cell_centers().points[order], wanted[wanted_order], atol=1e-4)
    np.testing.assert_allclose(sheet["pressure"][order], pressure.abs().reshape(-1).numpy()[wanted_order])

    assert set(np.round(discs["phase"], 6)) == set(np.round(at.phases_of(drive).numpy(), 6))
    assert limits["phase [rad]\n"] == pytest.approx((0, 2 * math.pi))
    assert limits["pressure [Pa]\n"] == pytest.approx((0, pressure.abs().max().item()))
