"""The scene in 3D, drawn with Matplotlib."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from autdtorch.drawing import (
    EDGE_COLOUR,
    FOCUS_COLOUR,
    MM,
    OBSTACLE_COLOUR,
    PHASE_MAP,
    PLANE_COLOUR,
    TRANSDUCER_COLOUR,
    Array,
    single_drive_phases,
)
from autdtorch.plot.style import TICK_SIZE, new_figure, styled
from autdtorch.scene import Box, Scene
from autdtorch.validation import ArrayLike


@styled
def plot_scene(scene: Scene, drive: ArrayLike | None = None) -> Figure:
    """The paper's Fig. 1: the scene in 3D, where `view3d` cannot render. What lies behind is not hidden.

    Args:
        scene: what to draw.
        drive: complex (M,); colours the transducers by phase.

    Returns:
        The figure.

    Raises:
        ValueError: `drive` does not fit the array.
    """
    figure = new_figure(5.2, 4.2)
    ax = cast(Axes3D, figure.add_subplot(projection="3d", computed_zorder=False))
    if scene.observation_plane is not None:
        corners = scene.observation_plane.corners[[0, 1, 3, 2]].numpy()
        ax.add_collection3d(Poly3DCollection([MM * corners], facecolor=PLANE_COLOUR, alpha=0.3, zorder=1))
    for box in scene.obstacles:
        ax.add_collection3d(
            Poly3DCollection(_faces(box), facecolor=OBSTACLE_COLOUR, edgecolor=EDGE_COLOUR, zorder=2)
        )
    foci = MM * scene.control_points.numpy()
    ax.scatter(*foci.T, color=FOCUS_COLOUR, s=22, depthshade=False, label="control points", zorder=3)
    _scatter_transducers(ax, scene, drive)
    lower, upper = (MM * np.array(corner) for corner in scene.domain)
    ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
    ax.set(xlabel="x [mm]", ylabel="y [mm]")
    ax.zaxis.set_rotate_label(False)  # which would set it upside down
    ax.set_zlabel("z [mm]", rotation=90)
    ax.set_box_aspect(upper - lower, zoom=0.85)
    ax.view_init(elev=22, azim=-118)
    ax.tick_params(labelsize=TICK_SIZE)
    ax.legend(loc="upper left")
    return figure


def _faces(box: Box) -> list[Array]:
    """The six faces of a box, four corners each [mm]."""
    grid = np.meshgrid(*zip(box.lower, box.upper, strict=True), indexing="ij")
    corners = MM * np.stack(grid, axis=-1)
    faces = [corners.take(end, axis=axis) for axis in range(3) for end in (0, 1)]
    return [face.reshape(4, 3)[[0, 1, 3, 2]] for face in faces]


def _scatter_transducers(ax: Axes3D, scene: Scene, drive: ArrayLike | None) -> None:
    positions = MM * scene.array.positions.numpy()
    style: Any = {
        "edgecolors": EDGE_COLOUR,
        "s": 36,
        "depthshade": False,
        "zorder": 1,
        "label": "transducers",
    }
    if drive is None:
        ax.scatter(*positions.T, color=TRANSDUCER_COLOUR, **style)
        return
    phases = single_drive_phases(drive, len(scene.array))
    dots = ax.scatter(*positions.T, c=phases, cmap=PHASE_MAP, vmin=0, vmax=2 * np.pi, **style)
    bar = ax.get_figure().colorbar(dots, ax=ax, shrink=0.6, pad=0.12)
    bar.set_ticks([0, np.pi, 2 * np.pi], labels=["0", "π", "2π"])
    bar.set_label("phase [rad]")
