"""Meshes of a scene: transducers, obstacles, control points; axes, colour bars and camera."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from autdtorch.plot import colours
from autdtorch.plot.data import MM, single_drive_phases
from autdtorch.scene.drive import amplitudes_of
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array
from autdtorch.utils.neighbours import nearest_other
from autdtorch.utils.validation import ArrayLike, Vector

if TYPE_CHECKING:
    import pyvista

_WINDOW = (1200, 860)  # pixels

POINT_COLOUR = "#00C8A0"  # green: not in the colour map of the pressure
_SILENT_COLOUR = "#C8C8C8"
_PHASE_BAR = 0.03  # left edge of a colour bar, as a share of the window
FIELD_BAR = 0.9
_CAPTION = (0.85, 0.15)  # lower left corner, as shares of the window
_CAMERA = (-0.75, -1.0, 0.5)  # from the centre towards the camera


_BAR = {"vertical": True, "position_y": 0.25, "width": 0.05, "height": 0.5, "color": "black"}
_BAR |= {"title_font_size": 20, "label_font_size": 18, "unconstrained_font_size": True}


def new_plotter(scene: Scene, off_screen: bool) -> pyvista.Plotter:
    """Return a plotter with obstacles, control points, axes and camera."""
    import pyvista

    with pyvista.vtk_verbosity("error"):  # VTK warns of a missing X server, which it does not need
        plotter = pyvista.Plotter(off_screen=off_screen, window_size=list(_WINDOW))
    plotter.set_background("white")
    for obstacle in scene.obstacles:
        _add_obstacle(plotter, obstacle, scene.domain)
    _add_control_points(plotter, scene)
    _add_axes(plotter, scene)
    return plotter


def emitted_phases(drive: ArrayLike, transducers: int) -> Array:
    """Return the phases (M,) in [0, 2 pi) [rad] of one drive; NaN for silent transducers."""
    phases = single_drive_phases(drive, transducers)
    return np.where(amplitudes_of(drive).detach().cpu().numpy() > 0, phases, np.nan)


def add_transducers(plotter: pyvista.Plotter, scene: Scene, phases: Array | None) -> pyvista.PolyData:
    """Draw the transducers as discs, coloured by their phases (M,) [rad], NaN for silent ones.

    The mesh of all discs is returned, with the phases over pi as "phase" if given.
    """
    import pyvista

    positions = scene.array.positions
    apart = nearest_other(positions)[0].min().item() if len(positions) > 1 else math.inf
    # Point sources are drawn as discs that do not touch, of at most one wavelength.
    radius = MM * (scene.array.radius or 0.42 * min(apart, scene.wavelength))
    points = pyvista.PolyData(MM * positions.numpy())
    points["normals"] = scene.array.normals.numpy()
    if phases is not None:
        points["phase"] = phases / math.pi
    along = {"orient": "normals", "scale": False}
    face, rim = (
        points.glyph(geom=pyvista.Disc(inner=inner, outer=outer, normal=(1.0, 0.0, 0.0), c_res=48), **along)
        for inner, outer in ((0.0, radius), (radius, 1.1 * radius))
    )
    shape = {"tip_length": 0.35, "tip_radius": 0.1, "shaft_radius": 0.03}
    arrow = pyvista.Arrow(start=(0.1 * radius, 0.0, 0.0), scale=2.0 * radius, **shape)
    look = {"scalars": "phase", "cmap": colours.PHASE_MAP, "clim": (0.0, 2.0), "nan_color": _SILENT_COLOUR}
    if phases is None:
        look = {"color": colours.TRANSDUCER_COLOUR}
    actor = plotter.add_mesh(face, lighting=False, show_scalar_bar=False, **look)
    if phases is not None:
        add_bar(plotter, actor, "phase / π", position=_PHASE_BAR, labels=5, fmt="%.1f")
    plotter.add_mesh(rim, color=colours.EDGE_COLOUR, lighting=False)
    plotter.add_mesh(points.glyph(geom=arrow, **along), color="#555555")
    return face


def add_bar(
    plotter: pyvista.Plotter, mesh: pyvista.Actor, title: str, *, position: float, labels: int, fmt: str
) -> None:
    """Draw the colour bar of a mesh; `position` is its left edge, as a share of the window."""
    bar = plotter.add_scalar_bar(
        title + "\n",  # VTK sets the title tight against the bar
        mapper=mesh.mapper,
        n_labels=labels,
        fmt=fmt,
        position_x=position,
        **_BAR,
    )
    _use_font(bar.GetTitleTextProperty(), bar.GetLabelTextProperty())


def add_caption(plotter: pyvista.Plotter, *lines: str) -> None:
    """Write lines below the colour bar of the field."""
    text = plotter.add_text("\n".join(lines), position=_CAPTION, viewport=True, font_size=10, color="black")
    _use_font(text.prop)


def _use_font(*properties: pyvista.TextProperty) -> None:
    """Use the font of Matplotlib's figures; VTK's fonts have no π."""
    from matplotlib import get_data_path

    for text in properties:
        text.SetFontFamily(4)  # VTK_FONT_FILE
        text.SetFontFile(str(Path(get_data_path()) / "fonts/ttf/DejaVuSans.ttf"))


def _add_obstacle(plotter: pyvista.Plotter, obstacle: Obstacle, domain: tuple[Vector, Vector]) -> None:
    """Draw the obstacle's surface and its sharp edges, cut at the boundary of the domain."""
    import pyvista

    vertices, faces = obstacle.surface()
    surface = pyvista.PolyData.from_regular_faces(MM * vertices.numpy(), faces.numpy())
    for outwards, corner in zip((-1.0, 1.0), domain, strict=True):
        for normal in outwards * np.eye(3):
            if (((surface.points - MM * np.array(corner)) @ normal) > 0).any():
                surface = surface.clip(normal=normal, origin=MM * np.array(corner))
    if surface.n_cells == 0:  # only its bounding box reaches into the domain
        return
    sharp = math.degrees(colours.SHARP_ANGLE)
    normals = surface.compute_normals(split_vertices=True, feature_angle=sharp, auto_orient_normals=False)
    plotter.add_mesh(normals, color=colours.OBSTACLE_COLOUR, ambient=0.35, smooth_shading=True)
    edges = surface.extract_feature_edges(sharp)
    if 0 < edges.n_cells <= colours.MOST_EDGES:
        plotter.add_mesh(edges, color=colours.EDGE_COLOUR, line_width=2, lighting=False)


def _add_control_points(plotter: pyvista.Plotter, scene: Scene) -> None:
    import pyvista

    sphere = pyvista.Sphere(radius=MM * scene.wavelength / 5)
    points = pyvista.PolyData(MM * scene.control_points.numpy())
    plotter.add_mesh(points.glyph(orient=False, scale=False, geom=sphere), color=POINT_COLOUR, ambient=0.3)


def _add_axes(plotter: pyvista.Plotter, scene: Scene) -> None:
    lower, upper = scene.domain
    bounds = [MM * corner[axis] for axis in range(3) for corner in (lower, upper)]
    titles = {f"{name}title": f"{name} [mm]" for name in "xyz"}
    style = {"grid": "back", "location": "outer", "fmt": "%.0f", "color": "black", "font_size": 15}
    axes = plotter.show_bounds(bounds=bounds, **titles, **style)
    for axis in range(3):
        axes.SetAxisLabels(axis, None)  # PyVista's are not round numbers, VTK's are
    plotter.view_vector(_CAMERA, viewup=(0.0, 0.0, 1.0))
    plotter.enable_parallel_projection()
    plotter.reset_camera()
    plotter.camera.zoom(1.05)
    plotter.enable_anti_aliasing("ssaa")
