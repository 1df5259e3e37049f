"""Figures over the pressure on a plane: the force on a body or particle, and a camera's picture beside it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from autdtorch.hardware.camera.picture import Picture
from autdtorch.plot.data import MM, largest
from autdtorch.plot.plane_map import coordinates_in
from autdtorch.plot.pressure_maps import plot_plane, plot_planes
from autdtorch.plot.style import styled
from autdtorch.scene.geometry import Plane, cell_centers_of
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import ArrayLike, real_tensor, require_kind

_ARROW = 1.0  # length of the median arrow, relative to the distance of two
_LONGEST = 2.5  # of all arrows, likewise; longer ones are cut


@styled
def plot_force(
    force: ArrayLike,
    pressure: ArrayLike,
    plane: Plane,
    control_points: ArrayLike | None = None,
    obstacles: Iterable[Obstacle] = (),
) -> Figure:
    """Plot the force at places of a plane as arrows, over the pressure magnitude on it.

    Arrows are the part of the force along the plane. Their lengths are in proportion to the force, up to 2.5
    times their distance.

    Args:
        force: (Mu, Mv, 3) [N], at `plane.points(...)` of another spacing; 0 draws no arrow.
        pressure: complex pressure or its magnitude (Nu, Nv) [Pa], at `plane.points(...)`.
        plane: the plane.
        control_points: (P, 3) [m]; those in the plane are circled.
        obstacles: obstacles, masked and outlined in the plane.

    Raises:
        ValueError: an argument of another shape or out of range.
    """
    require_kind("plane", plane, Plane)
    force = real_tensor("force", force, "N").detach().cpu()
    if force.ndim != 3 or force.shape[2] != 3 or not force.numel():
        raise ValueError(f"force: shape {tuple(force.shape)}; must be (Mu, Mv, 3), at points of the plane")
    figure: Figure = plot_plane(pressure, plane, control_points, obstacles)
    counts = force.shape[0], force.shape[1]
    places = cell_centers_of(plane, counts).reshape(-1, 3)
    starts = coordinates_in(plane, places).numpy()
    along = coordinates_in(plane, places + force.reshape(-1, 3)).numpy() - starts  # coordinates are linear
    size = np.linalg.norm(along, axis=1)
    apart = MM * min(side / count for side, count in zip(plane.size, counts, strict=True))
    typical = float(np.median(size[size > 0])) if size.any() else 1.0
    shown = along * (_ARROW * apart / typical)
    shown /= np.maximum(np.linalg.norm(shown, axis=1) / (_LONGEST * apart), 1)[:, None]
    drawn = size > 0  # Matplotlib would mark the others by dots
    figure.axes[0].quiver(
        *(MM * starts[drawn]).T, *shown[drawn].T, angles="xy", scale_units="xy", scale=1, color="white",
        pivot="mid", width=0.006, path_effects=[withStroke(linewidth=1.6, foreground="black")],
    )  # fmt: skip
    return figure


def camera_figure(picture: Picture, simulated: Array, plane: Plane, scene: Scene) -> Figure:
    """Draw a picture and |p| (Nu, Nv) [Pa] as `simulated` on a plane, with colours of one scale."""
    maps = {"camera": picture.pressure.numpy(), "simulation": np.nan_to_num(simulated)}
    return plot_planes(
        {name: {"": magnitude} for name, magnitude in maps.items()},
        {"camera": picture.plane, "simulation": plane},
        dict.fromkeys(maps, scene.control_points),
        dict.fromkeys(maps, scene.obstacles),
        vmax=max(map(largest, maps.values())) or 1.0,
        reflectors=dict.fromkeys(maps, scene.reflectors),
    )
