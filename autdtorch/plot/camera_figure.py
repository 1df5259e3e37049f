"""A figure of a camera's picture beside the simulated plane."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from autdtorch.hardware.camera.picture import Picture
from autdtorch.plot.data import largest
from autdtorch.plot.pressure_maps import plot_planes
from autdtorch.scene.geometry import Plane
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array


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
