"""The 3D view: rendered with an OpenGL driver; a missing driver is reported, not fatal."""

import json
import math
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scenes import scene_of_all_kinds, small_scene

import autdtorch as at
from autdtorch.plot.plotter3d import STILL_AXES
from autdtorch.plot.view3d import animate3d, rendering_problem, view3d

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
    if problem := rendering_problem():
        pytest.skip(problem)


@pytest.fixture
def broken_pyvista(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Replace the PyVista of the check's child process by some code."""

    def replace(code: str) -> None:
        (tmp_path / "pyvista.py").write_text(code, encoding="utf-8")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    rendering_problem.cache_clear()
    yield replace
    rendering_problem.cache_clear()


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        pytest.param(
            "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)",
            "SIGSEGV",
            marks=pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals"),
        ),
        ("raise ModuleNotFoundError('no such package here')", "no such package here"),
        ("import time\ntime.sleep(60)", "within 0.5 s"),
    ],
)
def test_a_failed_check_is_a_reason_not_to_render(
    scene: at.Scene, broken_pyvista: Callable[[str], None], monkeypatch, code: str, cause: str
) -> None:
    if "sleep" in code:
        monkeypatch.setattr(sys.modules["autdtorch.plot.view3d"], "_PROBE_TIMEOUT", 0.5)
    broken_pyvista(code)
    assert cause in str(rendering_problem())
    with pytest.raises(RuntimeError, match=cause):
        view3d(scene)


def test_bad_input_is_refused_before_anything_is_rendered(
    scene: at.Scene, broken_pyvista: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    broken_pyvista("raise SystemExit('not reached')")
    drive = torch.ones(12, dtype=torch.complex128)
    field = torch.ones(4, 4, dtype=torch.complex128)
    without = at.Scene(scene.array, scene.medium, scene.frequency, scene.control_points)
    calls: dict[str, Callable[[], object]] = {
        r"drive: shape \(2, 12\); must be \(12,\)": lambda: view3d(scene, drive.expand(2, 12)),
        r"field: shape \(7,\); must be \(Nu, Nv\)": lambda: view3d(scene, field=torch.ones(7)),
        r"field\[0, 0\]: nan Pa": lambda: view3d(scene, field=torch.full((4, 4), torch.nan)),
        "field: 0 Pa everywhere": lambda: view3d(scene, field=torch.zeros(4, 4)),
        "field: .* without observation plane": lambda: view3d(without, field=field),
        r"volume: shape \(3, 3\); must be \(Nx, Ny, Nz\)": lambda: view3d(scene, volume=torch.ones(3, 3)),
        "isosurface: 3 dB; must be in -30 to 0": lambda: view3d(scene, isosurface=3),
        r"save: 'a.bmp'; .* one of .png, .html, .gltf": lambda: view3d(scene, save="a.bmp"),
        "field: .* complex numbers": lambda: animate3d(scene, drive, field.real, "wave.gif"),
        "frames: 1; must be an integer >= 2": lambda: animate3d(scene, drive, field, "wave.gif", frames=1),
    }
    for message, call in calls.items():
        with pytest.raises(ValueError, match=message):
            call()
    monkeypatch.setitem(sys.modules, "trame_pyvista", None)
    with pytest.raises(ImportError, match=r"save: 'scene.html' needs trame-pyvista"):
        view3d(scene, save="scene.html")


@pytest.mark.usefixtures("renderer")
def test_a_picture_is_written_and_not_blank(scene: at.Scene, tmp_path: Path) -> None:
    import matplotlib.image

    view3d(scene, save=tmp_path / "scene.png").close()
    picture = matplotlib.image.imread(tmp_path / "scene.png")
    assert picture.shape[:2] == (860, 1200)
    # The 12 discs are drawn without lighting, in an exact colour: at least 100 pixels each.
    disc = np.abs(picture[..., :3] - np.array([0x00, 0x72, 0xB2]) / 255).max(axis=-1) < 0.01
    assert disc.sum() > 1200
    # Imported after the driver, Triton would end the process.
    assert find_spec("triton") is None or "triton" in sys.modules


@pytest.mark.usefixtures("renderer")
def test_labels_of_the_axes_are_in_the_window_and_clear_of_the_colour_bars() -> None:
    array = at.TransducerArray.autd3((0.0, 0.0, 0.0), normal=(0, 0, 1))
    plane = at.Plane((0.0, 0.0, 150e-3), (0, 0, 1), (150e-3, 150e-3))
    scene = at.Scene(array, at.Medium.air(), 40e3, [[0.0, 0.0, 150e-3]], (), plane)
    plotter = view3d(scene, at.drive_from_phases(np.zeros(len(array))), np.ones((3, 3)))
    plotter.render()
    boxes = {}
    for name, actor in plotter.actors.items():
        if name.startswith(STILL_AXES) and hasattr(actor, "GetDisplayOffset"):
            plotter.renderer.SetWorldPoint(*actor.GetPosition(), 1.0)
            plotter.renderer.WorldToDisplay()
            low = np.array(plotter.renderer.GetDisplayPoint()[:2]) + actor.GetDisplayOffset()
            letters = actor.GetTextProperty().GetFontSize()
            extent = np.array([0.65 * len(actor.GetInput()), 1.0])  # letters of the font are narrower
            boxes[actor.GetInput()] = low, low + letters * extent
    width, height = plotter.window_size
    bars = [bar.GetPosition()[0] * width for bar in plotter.scalar_bars.values()]
    plotter.close()
    assert {"x [mm]", "y [mm]", "z [mm]", "0", "50"} <= boxes.keys()
    for low, high in boxes.values():
        assert low[0] > min(bars) + 0.05 * width
        assert high[0] < max(bars)
        assert low[1] > 0
        assert high[1] < height


@pytest.mark.usefixtures("renderer")
def test_obstacles_are_drawn_where_they_are_in_millimetres_as_far_as_the_domain(tmp_path: Path) -> None:
    def bounds(scene: at.Scene) -> list[tuple[float, ...]]:
        plotter = view3d(scene)
        boxes = [mesh.bounds for mesh in plotter.meshes]
        plotter.close()
        return boxes

    wall = at.Box((50e-3, 40e-3, 40e-3), (10e-3, 1.0, 1.0), rigid=True)
    outside = at.Sphere((85e-3, 85e-3, 85e-3), 8e-3, rigid=True)  # only its bounding box is inside
    drawn = bounds(small_scene((wall, outside), extent=80e-3))
    assert any(np.allclose(one, (45, 55, 0, 80, 0, 80), atol=1e-4) for one in drawn)  # VTK keeps float32
    scene = scene_of_all_kinds(tmp_path)
    drawn = bounds(scene)
    for obstacle in scene.obstacles:
        vertices, _ = obstacle.surface()
        wanted = 1e3 * torch.stack([vertices.amin(dim=0), vertices.amax(dim=0)]).T.reshape(-1).numpy()
        assert any(np.allclose(one, wanted, atol=1e-4) for one in drawn)


@pytest.mark.usefixtures("renderer")
def test_meshes_hold_the_phases_and_levels_given_in_millimetres(scene: at.Scene) -> None:
    assert scene.observation_plane is not None
    drive = at.drive_from_phases(torch.linspace(0, 6, len(scene.array)))
    drive[3] = 0.0
    points = scene.observation_plane.points(SPACING)
    pressure = free_field(scene, drive, points)
    plotter = view3d(scene, drive=drive, field=pressure, reference=2.0)
    (sheet,) = (mesh for mesh in plotter.meshes if "field" in mesh.array_names)
    discs = next(mesh for mesh in plotter.meshes if "phase" in mesh.array_names)
    limits = {title: bar.lookup_table.GetRange() for title, bar in plotter.scalar_bars.items()}
    plotter.close()

    # The sheet has the level of every point of the plane (within 1e-4 mm: VTK keeps float32).
    apart = torch.cdist(1e3 * points.reshape(-1, 3), torch.from_numpy(sheet.points).double())
    nearest, index = apart.min(dim=1)
    assert nearest.max() < 1e-4
    level = (20 * (pressure.abs() / 2.0).log10()).clamp(min=-30).reshape(-1)
    np.testing.assert_allclose(sheet["field"][index], level.numpy())

    wanted = np.delete(at.phases_of(drive).numpy(), 3) / math.pi
    assert set(np.round(discs["phase"][~np.isnan(discs["phase"])], 6)) == set(np.round(wanted, 6))
    assert np.isnan(discs["phase"]).mean() == pytest.approx(1 / len(drive))  # the silent one
    assert limits["phase [π rad]\n"] == pytest.approx((0, 2))
    assert limits["pressure [dB]\n"] == pytest.approx((-30, 0))


@pytest.mark.usefixtures("renderer")
def test_the_isosurface_lies_where_the_volume_has_its_level(scene: at.Scene) -> None:
    # The field falls as 1 / distance from control point 0, from 1 Pa at 5 mm, and is NaN on one side. The
    # isosurface of half a pascal is a sphere of 10 mm.
    lower, upper = np.array(scene.domain)
    counts = np.round((upper - lower) / 2e-3).astype(int)
    cells = np.moveaxis(np.indices(counts), 0, -1) + 0.5
    center = scene.control_points[0].numpy()
    away = lower + (upper - lower) * cells / counts - center
    volume = 5e-3 / np.linalg.norm(away, axis=-1)
    volume[away[..., 0] > 2e-3] = np.nan
    plotter = view3d(scene, volume=volume, isosurface=20 * math.log10(0.5), reference=1.0)
    surface = plotter.meshes[-1]
    plotter.close()
    radius = np.linalg.norm(surface.points - 1e3 * center, axis=1)
    np.testing.assert_allclose(radius, 10.0, atol=0.1)  # linear in 2 mm cells: h^2 / 8 times the curvature
    assert surface.points[:, 0].max() <= 1e3 * center[0] + 2.0 + 1e-4
    assert surface.points[:, 0].min() == pytest.approx(1e3 * center[0] - 10.0, abs=0.1)


@pytest.mark.usefixtures("renderer")
def test_fields_inside_obstacles_are_not_shown(scene: at.Scene, caplog: pytest.LogCaptureFixture) -> None:
    plane = at.Plane(center=(40e-3, 0, 0), normal=(0, 0, 1), size=(40e-3, 40e-3))  # across the box
    scene = replace(scene, observation_plane=plane, control_points=[[60e-3, 0, 0]])
    points = plane.points(2e-3)
    inside = scene.obstacles[0].contains(points)
    plotter = view3d(scene, field=torch.where(inside, 100.0, 2.0))
    (sheet,) = (mesh for mesh in plotter.meshes if "field" in mesh.array_names)
    captions = [actor.GetInput() for actor in plotter.actors.values() if hasattr(actor, "GetInput")]
    plotter.close()
    assert np.isnan(sheet["field"]).sum() == inside.sum()
    assert np.nanmax(sheet["field"]) == 0
    assert "0 dB = 2 Pa" in captions
    # A volume that is loud in the box alone, near the control point, has no surface of that level.
    lower, upper = np.array(scene.domain)
    counts = np.round((upper - lower) / 2e-3).astype(int)
    cells = lower + (upper - lower) * (np.moveaxis(np.indices(counts), 0, -1) + 0.5) / counts
    volume = np.where(scene.obstacles[0].contains(cells), 100.0, 1.0)
    view3d(scene, volume=volume, isosurface=-1.0, reference=100.0).close()
    assert "no isosurface" in caplog.text


@pytest.mark.usefixtures("renderer")
def test_exports_are_self_contained(scene: at.Scene, tmp_path: Path) -> None:
    field = torch.rand(4, 3, generator=torch.manual_seed(0))
    view3d(scene, field=field, save=tmp_path / "scene.gltf").close()
    content = json.loads((tmp_path / "scene.gltf").read_text(encoding="utf-8"))
    assert all(buffer["uri"].startswith("data:") for buffer in content["buffers"])
    # The corner of the plane, in metres and with z upwards, which is the format's y.
    nodes = content["nodes"]
    (root,) = (nodes[index] for index in content["scenes"][0]["nodes"])
    corners = []
    for node in (nodes[index] for index in root["children"] if "mesh" in nodes[index]):
        (part,) = content["meshes"][node["mesh"]]["primitives"]
        corner = [*content["accessors"][part["attributes"]["POSITION"]]["max"], 1.0]
        corners.append(np.diag([*root["scale"], 1]) @ np.reshape(node["matrix"], (4, 4)).T @ corner)
    assert any(np.allclose(corner[:3], (40e-3, 30e-3, 80e-3)) for corner in corners)
    assert "cameras" not in content
    pytest.importorskip("trame_pyvista", reason="in the extra notebook")
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    view3d(scene, field=field, reference=1.5, save=tmp_path / "scene.html").close()
    assert handlers == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    assert signal.set_wakeup_fd(-1) == -1
    assert "trame_vtklocal" not in sys.modules  # which downloads from the network
    page = (tmp_path / "scene.html").read_text(encoding="utf-8")
    assert all(text in page for text in ("pressure [dB]<div", "0 dB = 1.5 Pa"))
    assert 'src="http' not in page


@pytest.mark.usefixtures("renderer")
def test_an_animation_turns_the_wave_through_one_period(scene: at.Scene, tmp_path: Path) -> None:
    from PIL import Image, ImageSequence

    assert scene.observation_plane is not None
    drive = at.drive_from_phases(torch.zeros(len(scene.array)))
    field = free_field(scene, drive, scene.observation_plane.points(SPACING))
    animate3d(scene, drive, field, tmp_path / "wave.gif", frames=2)
    with Image.open(tmp_path / "wave.gif") as wave:
        assert (wave.n_frames, wave.info["loop"]) == (2, 0)
        first, second = (np.asarray(one.convert("RGB"), float) for one in ImageSequence.Iterator(wave))
    # Half a period later the pressure has the other sign: red where blue was. Elsewhere nothing moves.
    redness, later = (frame[..., 0] - frame[..., 2] for frame in (first, second))
    assert np.abs(redness).max() > 100
    moved = (first != second).any(axis=-1)
    moved[:, :500] = False  # the transducers, whose colours turn on
    assert moved.mean() > 0.02
    assert np.corrcoef(redness[moved], later[moved])[0, 1] < -0.95


def free_field(scene: at.Scene, drive: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    pressure = at.green(points.reshape(-1, 3), scene.array.positions, scene.wavenumber) @ drive
    return pressure.reshape(points.shape[:2])
