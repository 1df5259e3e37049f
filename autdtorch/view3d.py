"""The scene in 3D, rendered off-screen with PyVista (optional extra ``viz``)."""

from __future__ import annotations

import functools
import math
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from autdtorch.drawing import (
    EDGE_COLOUR,
    FOCUS_COLOUR,
    MM,
    MOST_EDGES,
    OBSTACLE_COLOUR,
    PHASE_MAP,
    PLANE_COLOUR,
    PRESSURE_MAP,
    SHARP_ANGLE,
    TRANSDUCER_COLOUR,
    Array,
    plane_magnitude,
    single_drive_phases,
)
from autdtorch.geometry import Plane
from autdtorch.obstacles import Obstacle
from autdtorch.scene import Scene
from autdtorch.validation import ArrayLike, Vector, distances

if TYPE_CHECKING:
    import pyvista

_PROBE = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(32, 32))
plotter.add_mesh(pyvista.Sphere())
if not plotter.screenshot(return_img=True).std():
    raise SystemExit("the rendered picture is blank")
"""
_PROBE_TIMEOUT = 120.0  # s; a first import of PyVista from a cold disk takes tens of seconds


@functools.cache
def rendering_problem() -> str | None:
    """Why this machine cannot render in 3D, or None if it can; found out once per process.

    A child process tries it: where no OpenGL driver is found, VTK does not raise but its process is killed.
    """
    try:
        child = subprocess.run(
            [sys.executable, "-c", _PROBE],
            capture_output=True,
            text=True,
            timeout=_PROBE_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        cause = f"a trial rendering did not end within {_PROBE_TIMEOUT:g} s"
    else:
        if child.returncode == 0:
            return None
        cause = _cause_of_death(child)
    return (
        f"3D rendering is not available: {cause}. It needs pip install 'autdtorch[viz]' and an OpenGL "
        "driver, on Debian the packages libegl1 libgl1-mesa-dri libosmesa6"
    )


def view3d(
    scene: Scene,
    drive: ArrayLike | None = None,
    field: ArrayLike | None = None,
    *,
    screenshot: str | Path | None = None,
    off_screen: bool = True,
) -> pyvista.Plotter:
    """Draw transducers, obstacles, control points and observation plane, in millimetres.

    Args:
        scene: what to draw.
        drive: complex (M,); colours the transducers by phase.
        field: pressure on the observation plane (Nu, Nv) [Pa], complex or its magnitude, at the points of
            `Plane.points`; colours the plane by |p|. Without it, the plane is a translucent sheet.
        screenshot: PNG file to write.
        off_screen: False for a plotter whose ``show()`` opens a window.

    Returns:
        The plotter, for changes or ``show()``; close it when done.

    Raises:
        RuntimeError: this machine cannot render; the message says what is missing.
        ValueError: `drive` or `field` does not fit the scene.
    """
    phases = None if drive is None else single_drive_phases(drive, len(scene.array))
    magnitude = None if field is None else plane_magnitude("field", field)
    if magnitude is not None and scene.observation_plane is None:
        raise ValueError("field: given for a scene without observation plane; must be None")
    problem = rendering_problem()
    if problem is not None:
        raise RuntimeError(problem)
    import pyvista

    plotter = pyvista.Plotter(off_screen=off_screen, window_size=[1400, 900])
    plotter.set_background("white")
    _add_transducers(plotter, scene, phases)
    for obstacle in scene.obstacles:
        _add_obstacle(plotter, obstacle, scene.domain)
    _add_control_points(plotter, scene)
    if scene.observation_plane is not None:
        _add_plane(plotter, scene.observation_plane, magnitude)
    _add_axes(plotter, scene)
    if screenshot is not None:
        plotter.screenshot(str(screenshot))
    return plotter


def _cause_of_death(child: subprocess.CompletedProcess[str]) -> str:
    if child.returncode < 0:
        return f"a trial rendering was killed by {signal.Signals(-child.returncode).name}"
    lines = child.stderr.strip().splitlines() or [f"exit status {child.returncode}"]
    return f"a trial rendering failed with {lines[-1].strip()!r}"


def _add_transducers(plotter: pyvista.Plotter, scene: Scene, phases: Array | None) -> None:
    import pyvista

    positions = scene.array.positions
    apart = distances(positions, positions).fill_diagonal_(math.inf).min().item()
    # The scene holds points, not apertures: draw discs that do not touch, of one wavelength at most.
    radius = MM * 0.42 * min(apart, scene.wavelength)
    points = pyvista.PolyData(MM * positions.numpy())
    points["normals"] = scene.array.normals.numpy()
    disc = pyvista.Disc(inner=0.0, outer=radius, normal=(1.0, 0.0, 0.0), c_res=48)
    arrow = pyvista.Arrow(
        start=(0.1 * radius, 0.0, 0.0),
        scale=2.0 * radius,
        tip_length=0.35,
        tip_radius=0.12,
        shaft_radius=0.035,
    )
    if phases is not None:
        points["phase"] = phases
    discs = points.glyph(orient="normals", scale=False, geom=disc)
    if phases is None:
        plotter.add_mesh(discs, color=TRANSDUCER_COLOUR, lighting=False)
    else:
        plotter.add_mesh(
            discs,
            scalars="phase",
            cmap=PHASE_MAP,
            clim=(0.0, 2 * math.pi),
            lighting=False,
            show_scalar_bar=False,
        )
        _add_bar(plotter, "phase [rad]", 0.05)
    plotter.add_mesh(points.glyph(orient="normals", scale=False, geom=arrow), color="#555555")


def _add_obstacle(plotter: pyvista.Plotter, obstacle: Obstacle, domain: tuple[Vector, Vector]) -> None:
    """The obstacle's surface and its sharp edges, cut off and left open where the domain ends."""
    import pyvista

    vertices, faces = obstacle.surface()
    surface = pyvista.PolyData.from_regular_faces(MM * vertices.numpy(), faces.numpy())
    for outwards, corner in zip((-1.0, 1.0), domain, strict=True):
        for normal in outwards * np.eye(3):
            if (((surface.points - MM * np.array(corner)) @ normal) > 0).any():
                surface = surface.clip(normal=normal, origin=MM * np.array(corner))
    if surface.n_cells == 0:  # only its bounding box reaches into the domain
        return
    normals = surface.compute_normals(
        split_vertices=True, feature_angle=math.degrees(SHARP_ANGLE), auto_orient_normals=False
    )
    plotter.add_mesh(normals, color=OBSTACLE_COLOUR, ambient=0.35, smooth_shading=True)
    edges = surface.extract_feature_edges(math.degrees(SHARP_ANGLE))
    if 0 < edges.n_cells <= MOST_EDGES:
        plotter.add_mesh(edges, color=EDGE_COLOUR, line_width=2, lighting=False)


def _add_control_points(plotter: pyvista.Plotter, scene: Scene) -> None:
    import pyvista

    sphere = pyvista.Sphere(radius=MM * scene.wavelength / 6)
    points = pyvista.PolyData(MM * scene.control_points.numpy())
    plotter.add_mesh(points.glyph(orient=False, scale=False, geom=sphere), color=FOCUS_COLOUR)


def _add_plane(plotter: pyvista.Plotter, plane: Plane, magnitude: Array | None) -> None:
    sheet = _plane_mesh(plane, magnitude)
    if magnitude is None:
        plotter.add_mesh(sheet, color=PLANE_COLOUR, opacity=0.35, lighting=False)
    else:
        limits = (0.0, float(magnitude.max()))
        plotter.add_mesh(
            sheet, scalars="pressure", cmap=PRESSURE_MAP, clim=limits, lighting=False, show_scalar_bar=False
        )
        _add_bar(plotter, "pressure [Pa]", 0.88)


def _plane_mesh(plane: Plane, magnitude: Array | None) -> pyvista.StructuredGrid:
    import pyvista

    shape = (1, 1) if magnitude is None else magnitude.shape
    u, v = (axis.numpy() for axis in plane.basis)
    along_u, along_v = (
        length * np.linspace(-0.5, 0.5, cells + 1) for length, cells in zip(plane.size, shape, strict=True)
    )
    nodes = MM * (np.asarray(plane.center) + along_u[:, None, None] * u + along_v[None, :, None] * v)
    mesh = pyvista.StructuredGrid(*(nodes[:, :, None, axis] for axis in range(3)))
    if magnitude is not None:
        mesh.cell_data["pressure"] = magnitude.ravel(order="F")  # VTK counts the first axis fastest
    return mesh


def _add_bar(plotter: pyvista.Plotter, title: str, position: float) -> None:
    plotter.add_scalar_bar(
        title + "\n",  # VTK sets the title tight against the bar
        vertical=True,
        position_x=position,
        position_y=0.25,
        width=0.05,
        height=0.5,
        n_labels=5,
        fmt="%.3g",
        color="black",
        font_family="arial",
        title_font_size=22,
        label_font_size=18,
    )


def _add_axes(plotter: pyvista.Plotter, scene: Scene) -> None:
    lower, upper = scene.domain
    plotter.show_bounds(
        bounds=[MM * corner[axis] for axis in range(3) for corner in (lower, upper)],
        xtitle="x [mm]",
        ytitle="y [mm]",
        ztitle="z [mm]",
        grid="back",
        location="outer",
        fmt="%.0f",
        n_xlabels=5,
        n_ylabels=5,
        n_zlabels=5,
        color="black",
        font_size=13,
    )
    plotter.view_vector((-0.55, -1.0, 0.5), viewup=(0.0, 0.0, 1.0))
    plotter.enable_parallel_projection()
    plotter.reset_camera()
    plotter.camera.zoom(1.05)
    plotter.enable_anti_aliasing("ssaa")
