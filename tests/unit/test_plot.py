"""Figures show their data, with units on every axis, and change no global state."""

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot
import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver, QuiverKey
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from small_scenes import AIR, scene_of_all_kinds, small_scene

import autdtorch as at
from autdtorch.plot.cost_figures import plot_pareto
from autdtorch.plot.data import clipped, parts_of_reflectors
from autdtorch.plot.plane_maps import plot_plane, plot_planes
from autdtorch.plot.scene_figure import plot_scene
from autdtorch.plot.trials import plot_convergence, plot_trials

PLANE = at.Plane(center=(80e-3, 50e-3, 40e-3), normal=(1, 0, 0), size=(60e-3, 40e-3))


def mesh_of(ax: Axes) -> QuadMesh:
    (mesh,) = (artist for artist in ax.collections if isinstance(artist, QuadMesh))
    return mesh


@pytest.mark.parametrize("normal", [(1, 0, 0), (-1, 0, 0)])  # the side v runs along z or against it
def test_plane_map_draws_each_cell_at_its_coordinates_in_mm(normal: tuple[int, int, int]) -> None:
    plane = at.Plane(PLANE.center, normal, PLANE.size)
    points = plane.points(10e-3)
    pressure = torch.complex(points[..., 1], points[..., 2])
    figure = plot_plane(pressure, plane)
    mesh = mesh_of(figure.axes[0])
    corners = mesh.get_coordinates()
    centers = (corners[:-1, :-1] + corners[1:, 1:]) / 2
    np.testing.assert_allclose(centers, 1e3 * points[..., 1:].numpy().swapaxes(0, 1), atol=1e-9)
    np.testing.assert_allclose(mesh.get_array(), pressure.abs().numpy().T)
    assert figure.axes[1].get_ylabel() == "|p| [Pa]"


AXES = {(1, 0, 0): "yz", (0, 1, 0): "zx", (0, 0, -1): "xy", (1, 1, 0): "uz", (1, 1, 1): "uv"}


@pytest.mark.parametrize("normal", AXES)
def test_plane_axes_carry_the_name_of_the_real_axis(normal: tuple[int, int, int]) -> None:
    ax = plot_plane(np.ones((3, 2)), at.Plane((0, 0, 0), normal, (30e-3, 20e-3))).axes[0]
    assert [ax.get_xlabel(), ax.get_ylabel()] == [f"{name} [mm]" for name in AXES[normal]]


def test_points_in_the_plane_are_circled_and_obstacles_outlined_where_it_cuts_them(
    caplog: pytest.LogCaptureFixture,
) -> None:
    points = [80e-3, 30e-3, 45e-3], [60e-3, 30e-3, 45e-3]  # the second is not in the plane
    spheres = [at.Sphere((x, 45e-3, 38e-3), 10e-3, rigid=True) for x in (80e-3, 95e-3)]  # nor is this
    ax = plot_plane(np.ones((6, 4)), PLANE, points, spheres, title="a line\n" + 30 * "word ").axes[0]
    assert "control_points: 1 of 2 are more than a cell off the plane" in caplog.text
    assert ax.get_title().startswith("a line\nword")
    assert max(map(len, ax.get_title().splitlines())) < 60
    plot_plane(np.ones((6, 4)), PLANE, ax=ax)
    assert ax.get_title().startswith("a line")  # that of the user's axes
    (circles,) = ax.get_lines()
    np.testing.assert_allclose(circles.get_xydata(), [[30.0, 45.0]])
    (outline,) = (artist for artist in ax.collections if isinstance(artist, ContourSet))
    ((edge,),) = outline.allsegs
    # Straight lines between samples 0.15 mm apart deviate from the circle by far less.
    np.testing.assert_allclose(np.linalg.norm(edge - [45, 38], axis=1), 10, atol=1e-3)


def test_every_kind_of_obstacle_is_drawn(tmp_path: Path) -> None:
    figure = plot_scene(scene_of_all_kinds(tmp_path))
    figure.canvas.draw()
    # The plane; faces of five obstacles; edges of all but the sphere; points and transducers.
    assert len(figure.axes[0].collections) == 1 + 5 + 4 + 2


def test_edges_that_their_own_obstacle_hides_are_not_drawn() -> None:
    slab = np.zeros((5, 4, 5), bool)
    slab[:, 0] = True
    with_voxel_behind = slab.copy()
    with_voxel_behind[3, 3, 1] = True  # seen from low x, low y and high z, the slab is in front of it
    drawn = []
    for mask in (slab, with_voxel_behind):
        voxels = at.VoxelMask(mask, 4e-3, origin=(30e-3, 30e-3, 30e-3), smooth=False, rigid=True)
        ax = plot_scene(small_scene((voxels,), extent=80e-3)).axes[0]
        (edges,) = (artist for artist in ax.collections if isinstance(artist, Line3DCollection))
        drawn.append(edges._segments3d)
    np.testing.assert_array_equal(*drawn)


def test_what_is_drawn_of_an_obstacle_ends_at_the_domain() -> None:
    triangle = np.array([(-1.0, 0.5, 0.5), (3.0, 0.5, 0.5), (-1.0, 0.5, 4.5)])  # x + z <= 3.5 at y = 0.5
    inside = clipped(triangle, (0, 0, 0), (2, 1, 2))
    wanted = {(0, 0.5, 0.5), (2, 0.5, 0.5), (2, 0.5, 1.5), (1.5, 0.5, 2), (0, 0.5, 2)}
    assert {tuple(corner) for corner in inside.tolist()} == wanted
    ends = clipped(triangle[:2], (0, 0, 0), (2, 1, 2)).tolist()
    assert {tuple(end) for end in ends} == {(0, 0.5, 0.5), (2, 0.5, 0.5)}
    assert clipped(triangle, (0, 1, 0), (2, 2, 2)).shape == (0, 3)
    wall = at.Box((50e-3, 40e-3, 40e-3), (10e-3, 1.0, 1.0), rigid=True)
    ax = plot_scene(small_scene((wall,), extent=80e-3)).axes[0]
    # The wall is open where it leaves the domain, so that its far side is drawn too. Its edges are outside.
    assert sum(isinstance(artist, Poly3DCollection) for artist in ax.collections) == 2
    assert not any(isinstance(artist, Line3DCollection) for artist in ax.collections)


def field_of_a_ball() -> tuple[torch.Tensor, at.Plane, at.Sphere]:
    """The exact field (40, 30) of a point source beside a ball of heavy gas, a lens, by a plane across it."""
    ball = at.Sphere((30e-3, 0.0, 0.0), 8e-3, density=5.0, sound_speed=150.0)
    plane = at.Plane((40e-3, 0.0, 0.0), (0, 0, 1), (40e-3, 30e-3))
    ratios = {"density_ratio": 5.0 / 1.2, "speed_ratio": 150.0 / 340.0}
    points = plane.points(1e-3)
    field = at.analytic.fluid_sphere(
        points.reshape(-1, 3), [[0.0, 0.0, 0.0]], 2 * np.pi * 40e3 / 340.0, ball.center, ball.radius, **ratios
    )
    return field.reshape(points.shape[:2]), plane, ball


def test_obstacles_are_masked_and_the_scale_is_that_of_the_field_outside() -> None:
    field, plane, ball = field_of_a_ball()
    inside = (plane.points(1e-3) - torch.tensor(ball.center)).norm(dim=-1) < ball.radius
    loudest = field.abs()[~inside].max().item()
    assert field.abs().max() > 2 * loudest  # of the ball, which would be the scale
    figures = (
        plot_plane(field, plane, obstacles=[ball]),
        plot_planes({"ball": {"gabs": field}}, {"ball": plane}, obstacles={"ball": [ball]}),
        plot_plane(field, plane, obstacles=[ball], decibels=True),
    )
    for figure in figures:
        mesh = mesh_of(figure.axes[0])
        values = np.ma.getdata(mesh.get_array()).T
        np.testing.assert_array_equal(np.isnan(values), inside)
        assert mpl.colors.to_hex(mesh.get_cmap().get_bad()) == "#b0b0b0"
        assert mesh.get_clim()[1] == pytest.approx(0.0 if figure is figures[-1] else loudest)
    assert f"0 dB = {loudest:.3g} Pa" in figures[-1].axes[1].get_ylabel()
    # No obstacles are given: there is nothing to mask.
    assert mesh_of(plot_plane(field, plane).axes[0]).get_clim()[1] == pytest.approx(field.abs().max())


def test_a_plane_within_an_obstacle_is_grey() -> None:
    block = at.Box(PLANE.center, (0.1, 0.1, 0.1), rigid=True)
    figure = plot_plane(np.ones((3, 2)), PLANE, obstacles=[block])
    figure.draw_without_rendering()
    assert np.isnan(np.ma.getdata(mesh_of(figure.axes[0]).get_array())).all()
    with pytest.raises(ValueError, match="pressure: 0 Pa everywhere"):
        plot_plane(np.ones((3, 2)), PLANE, obstacles=[block], decibels=True)


def test_the_ends_of_the_colours_the_reference_and_the_axes_can_be_chosen() -> None:
    pressure = np.array([[2.0, 0.2], [0.0, 0.02]])
    ax = Figure().add_subplot()
    figure = plot_plane(pressure, PLANE, ax=ax, decibels=True)
    assert figure is ax.figure
    np.testing.assert_allclose(mesh_of(ax).get_array().T, [[0, -20], [-30, -30]], atol=1e-12)  # rounding
    assert mesh_of(ax).get_clim() == (-30, 0)
    assert "0 dB = 2 Pa" in figure.axes[1].get_ylabel()
    plain = plot_plane(pressure, PLANE, vmin=0.1, vmax=1.0)
    assert mesh_of(plain.axes[0]).get_clim() == (0.1, 1.0)
    levels = plot_plane(pressure, PLANE, decibels=True, reference=20.0, vmin=-45, vmax=-10)
    mesh = mesh_of(levels.axes[0])
    np.testing.assert_allclose(mesh.get_array().T, [[-20, -40], [-45, -45]], atol=1e-12)
    assert mesh.get_clim() == (-45, -10)
    assert "0 dB = 20 Pa" in levels.axes[1].get_ylabel()
    maps = {"a": {"gabs": pressure}, "b": {"gabs": 3 * pressure}}
    figure = plot_planes(maps, dict.fromkeys(maps, PLANE), vmax=4.0)
    assert [mesh_of(ax).get_clim() for ax in figure.axes[:2]] == [(0, 4), (0, 4)]
    # One bar for both, with an arrow at its end: some pressures of b are beyond.
    assert [ax._colorbar.extend for ax in figure.axes[2:]] == ["max"]


def test_planes_of_a_scene_share_their_colour_scale() -> None:
    pressure = {
        "three_cubes": {"lssg": np.full((3, 2), 1.0), "gabs": np.full((3, 2), 4.0)},
        "empty": {"lssg": np.full((3, 2), 2.0)},
    }
    figure = plot_planes(pressure, dict.fromkeys(pressure, PLANE))
    # Without the axes of colour bars.
    lssg, other, gabs, empty = (ax for ax in figure.axes if ax.get_aspect() == 1 or not ax.axison)
    assert [mesh_of(ax).get_clim() for ax in (lssg, gabs, other)] == [(0, 4), (0, 4), (0, 2)]
    assert not empty.axison
    assert [ax.get_title() for ax in (lssg, other)] == ["three cubes", "empty"]
    assert [ax.texts[0].get_text() for ax in (lssg, gabs)] == ["LSSG", "GABS"]
    assert {(ax.get_xlabel(), ax.get_ylabel()) for ax in (lssg, other, gabs)} == {("y [mm]", "z [mm]")}


def test_figures_change_no_global_state() -> None:
    before = dict(mpl.rcParams)
    for figure in (plot_plane(np.ones((3, 3)), PLANE), plot_trials({"f [1]": {"empty": {"gabs": [1.0]}}})):
        figure.draw_without_rendering()
    assert dict(mpl.rcParams) == before
    assert mpl.pyplot.get_fignums() == []


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plot_plane(np.ones(3), PLANE), r"pressure: shape \(3,\); must be \(Nu, Nv\)"),
        (lambda: plot_plane(np.zeros((2, 2)), PLANE, decibels=True), "pressure: 0 Pa everywhere"),
        (lambda: plot_plane(np.ones((2, 2)), PLANE, vmin=-1), "vmin: -1 Pa; must be finite and >= 0"),
        (lambda: plot_plane(np.ones((2, 2)), PLANE, vmin=2), "vmin: 2 Pa; must be < 1, the upper end"),
        (
            lambda: plot_plane(np.ones((2, 2)), PLANE, vmin=2, vmax=2),
            "vmax: 2 Pa; must be > 2, the lower end",
        ),
        (lambda: plot_plane(np.ones((2, 2)), PLANE, decibels=True, vmin=0), "vmin: 0 dB; must be < 0"),
        (lambda: plot_plane(np.ones((2, 2)), PLANE, reference=2), "reference: 2 Pa; must be None without"),
        (lambda: plot_planes({"a": {"b": np.ones((2, 2))}}, {"a": PLANE}, vmax=0), "vmax: 0 Pa; must be > 0"),
        (lambda: plot_planes({"empty": {"gabs": np.ones((3, 2))}}, {}), r"planes: none for \['empty'\]"),
        (lambda: plot_pareto({"a": {"b": [(1.0,)]}}, "", ""), r"\['b'\]: shape \(1, 1\); must be"),
        (lambda: plot_pareto({"a": {"b": [(0.0, 1.0)]}}, "", ""), "0; must be > 0"),
        (lambda: plot_trials({}), "quantities: empty"),
        (lambda: plot_trials({"f [1]": {"empty": {"gabs": [[1.0]]}}}), r"\['gabs'\]: shape \(1, 1\)"),
        (lambda: plot_trials({"f [1]": {"gabs": np.ones(3)}}), r"\['gabs'\]: .* method names"),
        (lambda: plot_convergence({"gabs": np.ones((3, 4))}), r"history\['gabs'\]: .*; must be a mapping"),
        (lambda: plot_convergence({"empty": {}}), "at least one method"),
        (lambda: plot_convergence({"empty": {"gabs": [1.0]}}), r"must be \(trials, evaluations\)"),
        (lambda: plot_convergence({"empty": {"gabs": [[1.0]]}}, {"two": {}}), r"levels: of scenes \['two'\]"),
    ],
)
def test_bad_data_is_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_scene_draws_everything_in_mm() -> None:
    array = at.TransducerArray.grid((2, 2), pitch=10e-3, center=(0, 0, 0), normal=(1, 0, 0))
    box = at.Box(center=(40e-3, 0, 0), size=(10e-3,) * 3, rigid=True)
    plane = at.Plane((80e-3, 0, 0), (1, 0, 0), (40e-3, 40e-3))
    scene = at.Scene(array, at.Medium(1.293, 340.0), 40e3, [[80e-3, 0, 0]], (box,), plane)
    drive = at.drive_from_phases([0.0, 1.0, 2.0, 3.0])
    figure = plot_scene(scene, drive)
    ax = figure.axes[0]
    assert {"x [mm]", "y [mm]", "z [mm]"} <= {text.get_text() for text in figure.texts}
    assert figure.axes[1].get_ylabel() == "phase [rad]"
    _plane, box, edges, foci, transducers = ax.collections
    assert len(box._faces) == 6  # triangles of the three faces that the viewer sees
    assert len(edges._segments3d) == 9
    np.testing.assert_allclose(np.concatenate(edges._segments3d).max(axis=0), [45, 5, 5])
    np.testing.assert_allclose(np.stack(foci._offsets3d, axis=-1), [[80, 0, 0]])
    drawn = np.stack(transducers._offsets3d, axis=-1)
    np.testing.assert_allclose(drawn, 1e3 * scene.array.positions, atol=1e-9)
    np.testing.assert_allclose(transducers.get_array(), [0, 1, 2, 3])
    with pytest.raises(ValueError, match="a single drive"):
        plot_scene(scene, drive.expand(3, 4))


def room(**changes):
    """A panel, a wall, and a box that leans on the panel."""
    array = at.TransducerArray.grid((2, 2), 8e-3, (0, 0, 0), (0, 0, 1))
    parts = {
        "obstacles": [at.Box((20e-3, 0, 0), (10e-3, 10e-3, 10e-3), (0, 0.5, 0), rigid=True)],
        "reflectors": [at.Reflector.behind(array), at.Reflector((-12e-3, 0, 0), (1, 0, 0))],
    }
    return at.Scene(array, AIR, 40e3, [(0, 0, 20e-3)], **parts | changes)


def test_reflectors_are_drawn_in_the_domain_and_cut_obstacles() -> None:
    scene = room()
    figure = plot_scene(scene)
    figure.canvas.draw()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "reflectors", "control points", "transducers"
    ]  # fmt: skip
    parts = parts_of_reflectors(scene.reflectors, scene.domain)
    assert [len(part) for part in parts] == [4, 4]
    lower, upper = map(np.array, scene.domain)
    for part, plane in zip(parts, scene.reflectors, strict=True):
        assert ((part >= lower - 1e-9) & (part <= upper + 1e-9)).all()
        assert np.allclose((part - plane.point) @ plane.normal, 0, atol=1e-12)
    assert parts[1][:, 2].min() == pytest.approx(0, abs=1e-12)  # the wall ends at the panel
    vertices, faces = (part.numpy() for part in scene.obstacles[0].surface())
    cut = [clipped(each, *scene.domain, scene.reflectors) for each in vertices[faces]]
    heights = np.concatenate(cut)[:, 2]
    assert vertices[:, 2].min() < -5e-3
    assert heights.min() == pytest.approx(0, abs=1e-12)


def test_a_map_is_grey_behind_reflectors_with_strokes_on_their_backs() -> None:
    scene = room()
    plane = at.Plane((0, 0, 5e-3), (0, -1, 0), (30e-3, 40e-3))  # over z and x
    figure = at.plot_plane(np.ones((15, 20)), plane, reflectors=scene.reflectors)
    ax = figure.axes[0]
    values = ax.collections[0].get_array()
    assert values.mask.sum() == 20 * 5 + 10 * 4
    panel, wall = (line.get_xydata() for line in ax.lines)
    assert np.allclose(panel[:, 0], 0)
    assert np.allclose(wall[:, 1], -12)
    assert sorted(panel[:, 1]) == pytest.approx([-12, 20])  # where the wall is
    assert panel[1, 1] > panel[0, 1]  # strokes are on the left: at z < 0
    assert wall[1, 0] < wall[0, 0]  # at x < -12 mm
    aside = at.Plane((0, 0, 60e-3), (0, 0, 1), (10e-3, 10e-3))
    assert not at.plot_plane(np.ones((5, 5)), aside, reflectors=scene.reflectors).axes[0].lines
    with pytest.raises(ValueError, match=r"reflectors\[0\].*must be a Reflector"):
        at.plot_plane(np.ones((5, 5)), aside, reflectors=[{"point": (0, 0, 0)}])


def test_maps_of_several_methods_share_the_reflectors() -> None:
    scene = room()
    plane = at.Plane((0, 0, 5e-3), (0, -1, 0), (30e-3, 40e-3))
    figure = at.plot_planes({"a": np.ones((6, 8))}, plane, reflectors=scene.reflectors)
    assert len(figure.axes[0].lines) == 2


def test_a_map_with_swapped_axes_is_told(recwarn) -> None:
    plane = at.Plane(center=(0, 0, 0), normal=(0, 0, 1), size=(20e-3, 40e-3))
    field = np.ones(plane.points(2e-3).shape[:2])
    at.plot_plane(field, plane)
    at.plot_plane(field[:, ::3], plane)  # oblong cells of a user's choice
    assert not recwarn
    with pytest.warns(at.ScaleWarning, match=r"shape \(20, 10\) has cells of 1 mm x 4 mm"):
        at.plot_plane(field.T, plane)


def test_no_arrow_is_drawn_where_there_is_no_force() -> None:
    plane = at.Plane(center=(0, 0, 0), normal=(0, 0, 1), size=(4e-3, 4e-3))
    force = torch.zeros(4, 4, 3)
    for count in range(3):
        (arrows,) = at.plot_force(force, torch.ones(8, 8), plane).axes[0].findobj(Quiver)
        assert len(arrows.get_offsets()) == arrows.N == count
        keys = [key.text.get_text() for key in arrows.axes.findobj(QuiverKey)]
        assert keys == ["median force 2.0 µN"] * min(count, 1)
        force[count, 0, 0] = 2e-6
