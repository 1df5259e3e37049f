"""Meshes of the pressure: on the observation plane, and surfaces of equal level in the domain."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
import torch

from autdtorch.plot.colours import EDGE_COLOUR, FLOOR, PLANE_COLOUR, PRESSURE_MAP
from autdtorch.plot.data import MM, plane_magnitude
from autdtorch.plot.view3d.scene_meshes import FIELD_BAR, add_bar
from autdtorch.scene.geometry import Plane
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array
from autdtorch.utils.neighbours import distances
from autdtorch.utils.validation import ArrayLike, magnitude_tensor, positive

if TYPE_CHECKING:
    import pyvista

logger = logging.getLogger(__name__)

_REACH = 3.0  # wavelengths around a control point, limit of the isosurface
_SURFACE_COLOUR = "#8CD0FF"  # blue: not in the colour map of the pressure


def add_plane(plotter: pyvista.Plotter, plane: Plane, level: Array | None) -> None:
    """Draw the plane, coloured by its level (Nu, Nv) [dB], or translucent if there is none."""
    if level is None:
        sheet = plane_mesh(plane, np.zeros((1, 1)))
        plotter.add_mesh(sheet, color=PLANE_COLOUR, opacity=0.35, lighting=False)
        return
    actor = add_sheet(plotter, plane_mesh(plane, np.maximum(level, FLOOR)), PRESSURE_MAP, (FLOOR, 0.0))
    add_bar(plotter, actor, "pressure [dB]", position=FIELD_BAR, labels=7, fmt="%.0f")


def add_sheet(
    plotter: pyvista.Plotter, sheet: pyvista.PolyData, colours: str, limits: tuple[float, float]
) -> pyvista.Actor:
    """Draw a mesh from `plane_mesh`, coloured by its values, and its frame."""
    actor = plotter.add_mesh(sheet, cmap=colours, clim=limits, lighting=False, show_scalar_bar=False)
    frame = sheet.extract_feature_edges()
    frame.clear_data()
    plotter.add_mesh(frame, color=EDGE_COLOUR, line_width=1, lighting=False)
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


def add_isosurface(plotter: pyvista.Plotter, scene: Scene, level: Array, height: float) -> None:
    """Draw the surface where the level (Nx, Ny, Nz) [dB], at the domain's cell centres, is `height`.

    It is limited to the surroundings of the control points: near the array it would hide everything.
    """
    import pyvista

    lower, upper = (MM * np.asarray(corner) for corner in scene.domain)
    step = (upper - lower) / level.shape
    grid = pyvista.ImageData(dimensions=level.shape, spacing=step, origin=lower + step / 2)
    grid["level"] = np.maximum(np.nan_to_num(level, nan=FLOOR), 2 * FLOOR).ravel(order="F")
    grid["known"] = (~np.isnan(level)).ravel(order="F").astype(float)
    known = grid.threshold(0.5, scalars="known", all_scalars=True)
    surface = known.contour([height], scalars="level")
    points = torch.from_numpy(np.asarray(surface.points, np.float64))
    surface["away"] = distances(points, MM * scene.control_points).amin(dim=1).numpy()
    surface = surface.clip_scalar(scalars="away", value=MM * _REACH * scene.wavelength)
    if surface.n_cells == 0:
        logger.warning("no isosurface: the level around the control points is below %g dB", height)
        return
    surface.clear_data()
    plotter.add_mesh(surface.compute_normals(), color=_SURFACE_COLOUR, opacity=0.45, smooth_shading=True)


def plane_pressure(scene: Scene, field: ArrayLike) -> tuple[Plane, Array]:
    """Return the scene's observation plane and the magnitude of a `field` (Nu, Nv) on it."""
    magnitude = plane_magnitude("field", field)
    if scene.observation_plane is None:
        raise ValueError("field: given for a scene without observation plane; must be None")
    return scene.observation_plane, magnitude


def volume_magnitude(volume: ArrayLike) -> Array:
    """Return |p| (Nx, Ny, Nz) of complex pressure, or of its magnitude; NaN where unknown."""
    magnitude: Array = magnitude_tensor("volume", volume, "Pa").detach().cpu().numpy()
    if magnitude.ndim != 3 or min(magnitude.shape) < 2:
        raise ValueError(f"volume: shape {magnitude.shape}; must be (Nx, Ny, Nz), each at least 2")
    if np.isnan(magnitude).all() or np.isinf(magnitude).any():
        raise ValueError("volume: infinite, or NaN everywhere; must be finite where it is known")
    return magnitude


def zero_level(reference: float | None, on_plane: Array | None, in_domain: Array | None) -> float:
    """Return the pressure of 0 dB [Pa]: the reference, or the peak on the plane, or that in the volume."""
    if reference is not None:
        return positive("reference", reference, "Pa")
    name, shown = ("field", on_plane) if on_plane is not None else ("volume", in_domain)
    if shown is None:  # no pressure to draw
        return 1.0
    peak = float(np.nanmax(shown))
    if peak == 0:
        raise ValueError(f"{name}: 0 Pa everywhere has no level; give the reference of 0 dB [Pa]")
    return peak
