"""Meshes of a scene and of the pressure in it."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import torch

from autdtorch.plot import colours
from autdtorch.plot.data import (
    MM,
    outside_on_plane,
    parts_of_reflectors,
    plane_magnitude,
    single_drive_phases,
)
from autdtorch.plot.plotter3d import CAMERA, FIELD_BAR, add_bar, add_still_axes, empty_plotter
from autdtorch.scene.arrays import radii_of
from autdtorch.scene.drive import amplitudes_of
from autdtorch.scene.geometry import Plane
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.obstacles.base import inside_any
from autdtorch.scene.reflectors import Reflector, are_in_front
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array
from autdtorch.utils.spatial import closest_pair, distances
from autdtorch.utils.validation import ArrayLike, Vector, magnitude_tensor

if TYPE_CHECKING:
    import pyvista

logger = logging.getLogger(__name__)

_MARGINS = (160, 185)  # pixels, for colour bars on the left and on the right

ARROWS = "arrows"
"""Name of the actor of the arrows that show where transducers emit."""
_ARROW_COLOUR = "#555555"
_SILENT_COLOUR = "#C8C8C8"
_PHASE_BAR = 0.045  # left edge of a colour bar, as a share of the window
_REACH = 3.0  # wavelengths around a control point, limit of the isosurface
_SURFACE_COLOUR = "#8CD0FF"  # blue: not in the colour map of the pressure


def new_plotter(scene: Scene, off_screen: bool, bars: tuple[bool, bool]) -> pyvista.Plotter:
    """Return a plotter with obstacles, control points, axes and camera.

    `bars` says whether there is a colour bar on the left, and on the right.
    """
    import pyvista

    plotter = empty_plotter(scene.domain, off_screen)
    if off_screen:
        plotter.remove_bounds_axes()
        left, right = (margin * bar for margin, bar in zip(_MARGINS, bars, strict=True))
        add_still_axes(plotter, scene.domain, CAMERA, (left, right))
    for obstacle in scene.obstacles:
        add_obstacle(plotter, obstacle, scene.domain, scene.reflectors)
    add_reflectors(plotter, scene)
    points = pyvista.PolyData(MM * scene.control_points.numpy())
    sphere = pyvista.Sphere(radius=MM * scene.wavelength / 5)
    spheres = points.glyph(orient=False, scale=False, geom=sphere)
    plotter.add_mesh(spheres, color=colours.FOCUS_COLOUR, ambient=0.3)
    plotter.enable_anti_aliasing("ssaa")
    return plotter


def emitted_phases(drive: ArrayLike, transducers: int) -> Array:
    """Return the phases (M,) in [0, 2 pi) [rad] of one drive; NaN for silent transducers."""
    phases = single_drive_phases(drive, transducers)
    return np.where(amplitudes_of(drive).detach().cpu().numpy() > 0, phases, np.nan)


def add_transducers(
    plotter: pyvista.Plotter, scene: Scene, phases: Array | None, bar: bool = True
) -> pyvista.PolyData:
    """Draw the transducers as discs, coloured by their phases (M,) [rad], NaN for silent ones.

    Return the mesh of all discs; with phases, "phase" holds them over pi. `bar` adds their colour bar.
    """
    import pyvista

    positions = scene.array.positions
    radii = radii_of(scene.array)
    # Point sources are drawn as discs that do not touch, of at most one wavelength.
    drawn = torch.where(radii > 0, radii, 0.42 * min(closest_pair(positions)[0], scene.wavelength))
    points = pyvista.PolyData(MM * positions.numpy())
    points["radius"] = MM * drawn.numpy()
    points["normals"] = scene.array.normals.numpy()
    if phases is not None:
        points["phase"] = phases / math.pi
    along = {"orient": "normals", "scale": "radius"}
    face, rim = (
        points.glyph(geom=pyvista.Disc(inner=inner, outer=outer, normal=(1.0, 0.0, 0.0), c_res=48), **along)
        for inner, outer in ((0.0, 1.0), (1.0, 1.1))
    )
    shape = {"tip_length": 0.35, "tip_radius": 0.1, "shaft_radius": 0.03}
    arrow = pyvista.Arrow(start=(0.1, 0.0, 0.0), scale=2.0, **shape)
    look = {"scalars": "phase", "cmap": colours.PHASE_MAP, "clim": (0.0, 2.0), "nan_color": _SILENT_COLOUR}
    if phases is None:
        look = {"color": colours.TRANSDUCER_COLOUR}
    actor = plotter.add_mesh(face, lighting=False, show_scalar_bar=False, **look)
    if phases is not None and bar:
        add_bar(plotter, actor, "phase [π rad]", position=_PHASE_BAR, labels=5, fmt="%.1f")
    plotter.add_mesh(rim, color=colours.EDGE_COLOUR, lighting=False)
    plotter.add_mesh(points.glyph(geom=arrow, **along), color=_ARROW_COLOUR, name=ARROWS)
    return face


def torus_mesh(radius: float, thickness: float) -> pyvista.PolyData:
    """Return a torus about z; radii of the ring and of its section in mm."""
    import pyvista

    shape = {"u_res": 48, "v_res": 12, "w_res": 12}
    return pyvista.ParametricTorus(ringradius=radius, crosssectionradius=thickness, **shape)


def ring_mesh(center: Array, normal: list[float], inner: float, outer: float) -> pyvista.PolyData:
    """Return a flat ring; lengths in mm."""
    import pyvista

    return pyvista.Disc(center=center, inner=inner, outer=outer, normal=normal, c_res=48)


def arrow_mesh(start: Array, direction: Array, length: float) -> pyvista.PolyData:
    """Return an arrow; lengths in mm."""
    import pyvista

    shape = {"shaft_radius": 0.03, "tip_radius": 0.09, "tip_length": 0.3}
    return pyvista.Arrow(start=start, direction=direction, scale=length, **shape)


def add_obstacle(
    plotter: pyvista.Plotter,
    obstacle: Obstacle,
    domain: tuple[Vector, Vector] | None = None,
    reflectors: Iterable[Reflector] = (),
) -> list[pyvista.Actor]:
    """Draw the obstacle's surface and its sharp edges; return both.

    They are cut at the boundary of a domain [m] and at reflectors.
    """
    import pyvista

    vertices, faces = obstacle.surface()
    surface = pyvista.PolyData.from_regular_faces(MM * vertices.numpy(), faces.numpy())
    sides = [
        (normal, np.array(corner))
        for outwards, corner in zip((-1.0, 1.0), domain or (), strict=False)
        for normal in outwards * np.eye(3)
    ]
    sides += [(-np.array(reflector.normal), np.array(reflector.point)) for reflector in reflectors]
    for normal, corner in sides:
        if (((surface.points - MM * corner) @ normal) > 0).any():
            surface = surface.clip(normal=normal, origin=MM * corner)
    if surface.n_cells == 0:  # only its bounding box reaches into the domain
        return []
    sharp = math.degrees(colours.SHARP_ANGLE)
    normals = surface.compute_normals(split_vertices=True, feature_angle=sharp, auto_orient_normals=False)
    look = {"color": colours.OBSTACLE_COLOUR, "ambient": 0.35, "smooth_shading": True}
    actors = [plotter.add_mesh(normals, **look, reset_camera=False)]
    edges = surface.extract_feature_edges(sharp)
    if 0 < edges.n_cells <= colours.MOST_EDGES:
        look = {"color": colours.EDGE_COLOUR, "line_width": 2, "lighting": False}
        actors.append(plotter.add_mesh(edges, **look, reset_camera=False))
    return actors


def add_reflectors(plotter: pyvista.Plotter, scene: Scene) -> None:
    """Draw the parts of the reflectors that are in the domain, and their edges.

    They are translucent from the front and open from the back, so that they do not tint a field behind.
    """
    import pyvista

    for corners in parts_of_reflectors(scene.reflectors, scene.domain):
        if len(corners):
            sheet = pyvista.PolyData(MM * corners, faces=[len(corners), *range(len(corners))])
            look = {"color": colours.REFLECTOR_COLOUR, "lighting": False, "reset_camera": False}
            plotter.add_mesh(sheet, opacity=colours.REFLECTOR_OPACITY, culling="back", **look)
            plotter.add_mesh(sheet.extract_feature_edges(), line_width=2, **look)


def cut_at_reflectors(actors: Iterable[pyvista.Actor], reflectors: Iterable[Reflector]) -> None:
    """Hide the parts of actors behind reflectors, wherever they are moved."""
    from vtkmodules.vtkCommonDataModel import vtkPlane

    for reflector in reflectors:
        plane = vtkPlane()
        plane.SetOrigin(*(MM * coordinate for coordinate in reflector.point))
        plane.SetNormal(*reflector.normal)
        for actor in actors:
            actor.mapper.AddClippingPlane(plane)


def add_plane(plotter: pyvista.Plotter, plane: Plane, level: Array | None) -> None:
    """Draw the plane, coloured by its level (Nu, Nv) [dB], or translucent if there is none."""
    if level is None:
        sheet = plane_mesh(plane, np.zeros((1, 1)))
        plotter.add_mesh(sheet, color=colours.PLANE_COLOUR, opacity=0.35, lighting=False)
        return
    actor = add_sheet(
        plotter,
        plane_mesh(plane, np.maximum(level, colours.FLOOR)),
        colours.PRESSURE_MAP,
        (colours.FLOOR, 0.0),
    )
    add_bar(plotter, actor, "pressure [dB]", position=FIELD_BAR, labels=7, fmt="%.0f")


def add_sheet(
    plotter: pyvista.Plotter, sheet: pyvista.PolyData, colour_map: str, limits: tuple[float, float]
) -> pyvista.Actor:
    """Draw a mesh from `plane_mesh`, coloured by its values, grey where they are NaN, and its frame."""
    look = {"cmap": colour_map, "clim": limits, "nan_color": colours.OBSTACLE_COLOUR}
    actor = plotter.add_mesh(sheet, lighting=False, show_scalar_bar=False, **look)
    frame = sheet.extract_feature_edges()
    frame.clear_data()
    plotter.add_mesh(frame, color=colours.EDGE_COLOUR, line_width=1, lighting=False)
    return actor


def plane_mesh(plane: Plane, values: Array) -> pyvista.PolyData:
    """Return the plane with `values` (Nu, Nv) at its cell centres, extended to its edges."""
    import pyvista

    u, v = (axis.numpy() for axis in plane.basis)
    along_u, along_v = (
        length * (np.concatenate([[0.0], np.arange(cells) + 0.5, [cells]]) / cells - 0.5)
        for length, cells in zip(plane.size, values.shape, strict=True)
    )
    nodes = MM * (np.asarray(plane.center) + along_u[:, None, None] * u + along_v[None, :, None] * v)
    mesh = pyvista.StructuredGrid(*(nodes[:, :, None, axis] for axis in range(3)))
    mesh["field"] = np.pad(values, 1, mode="edge").ravel(order="F")  # in VTK the first axis varies fastest
    return mesh.extract_surface(algorithm=None)


def add_isosurface(
    plotter: pyvista.Plotter, scene: Scene, level: Array, height: float, name: str = "isosurface"
) -> bool:
    """Draw the surface of level `height` of the levels (Nx, Ny, Nz) [dB] at the domain's cell centres.

    The surface ends near the control points: around the array it would hide everything. Return False if there
    is none.
    """
    import pyvista

    lower, upper = (MM * np.asarray(corner) for corner in scene.domain)
    step = (upper - lower) / level.shape
    grid = pyvista.ImageData(dimensions=level.shape, spacing=step, origin=lower + step / 2)
    grid["level"] = np.maximum(np.nan_to_num(level, nan=colours.FLOOR), 2 * colours.FLOOR).ravel(order="F")
    grid["known"] = (~np.isnan(level)).ravel(order="F").astype(float)
    known = grid.threshold(0.5, scalars="known", all_scalars=True)
    surface = known.contour([height], scalars="level")
    points = torch.from_numpy(np.asarray(surface.points, np.float64))
    surface["away"] = distances(points, MM * scene.control_points).amin(dim=1).numpy()
    surface = surface.clip_scalar(scalars="away", value=MM * _REACH * scene.wavelength)
    if surface.n_cells == 0:
        logger.warning("no isosurface: the level around the control points is below %g dB", height)
        return False
    surface.clear_data()
    look = {"color": _SURFACE_COLOUR, "opacity": 0.45, "smooth_shading": True}
    plotter.add_mesh(surface.compute_normals(), name=name, reset_camera=False, **look)
    return True


def plane_pressure(scene: Scene, field: ArrayLike) -> tuple[Plane, Array]:
    """Return the observation plane and the magnitude of a `field` (Nu, Nv) on it, NaN inside obstacles."""
    magnitude = plane_magnitude("field", field)
    if scene.observation_plane is None:
        raise ValueError("field: given for a scene without observation plane; must be None")
    return scene.observation_plane, outside_on_plane(
        magnitude, scene.observation_plane, scene.obstacles, scene.reflectors
    )


def volume_magnitude(scene: Scene, volume: ArrayLike) -> Array:
    """Return |p| (Nx, Ny, Nz) in the domain, NaN where unknown, inside obstacles and behind reflectors."""
    magnitude: Array = magnitude_tensor("volume", volume, "Pa").detach().cpu().numpy()
    if magnitude.ndim != 3 or min(magnitude.shape) < 2:
        raise ValueError(f"volume: shape {magnitude.shape}; must be (Nx, Ny, Nz), each at least 2")
    if np.isnan(magnitude).all() or np.isinf(magnitude).any():
        raise ValueError("volume: infinite, or NaN everywhere; must be finite where it is known")
    lower, upper = (np.asarray(corner) for corner in scene.domain)
    axes = (
        low + (high - low) * (np.arange(count) + 0.5) / count
        for low, high, count in zip(lower, upper, magnitude.shape, strict=True)
    )
    points = torch.from_numpy(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    hidden = inside_any(points, scene.obstacles) | ~are_in_front(scene.reflectors, points)
    return np.where(hidden.numpy(), np.nan, magnitude)


def map_colours(name: str, count: int) -> list[str]:
    """Return colours of a colour map from its lower end on, as of HTML."""
    import pyvista

    table = pyvista.LookupTable(name, n_values=count)
    return ["#{:02x}{:02x}{:02x}".format(*rgba[:3]) for rgba in table.values]
