"""Pressures that are drawn as levels [dB]: checks, and what 0 dB is."""

from __future__ import annotations

import numpy as np

from autdtorch.plot.drawing import plane_magnitude
from autdtorch.scene.geometry import Plane
from autdtorch.scene.scene import Scene
from autdtorch.utils.arrays import Array
from autdtorch.utils.validation import ArrayLike, magnitude_tensor, positive


def plane_pressure(scene: Scene, field: ArrayLike) -> tuple[Plane, Array]:
    """Return the scene's observation plane, and the magnitude of a `field` (Nu, Nv) on it.

    Raises:
        ValueError: not (Nu, Nv) finite numbers, or the scene has no plane.
    """
    magnitude = plane_magnitude("field", field)
    if scene.observation_plane is None:
        raise ValueError("field: given for a scene without observation plane; must be None")
    return scene.observation_plane, magnitude


def volume_magnitude(volume: ArrayLike) -> Array:
    """Return |p| (Nx, Ny, Nz) of complex pressure or its magnitude in a domain; NaN where it is not known.

    Raises:
        ValueError: not numbers, another number of axes, a single layer of cells, infinite, or nothing known.
    """
    magnitude: Array = magnitude_tensor("volume", volume, "Pa").detach().cpu().numpy()
    if magnitude.ndim != 3 or min(magnitude.shape) < 2:
        raise ValueError(f"volume: shape {magnitude.shape}; must be (Nx, Ny, Nz), each at least 2")
    if np.isnan(magnitude).all() or np.isinf(magnitude).any():
        raise ValueError("volume: infinite, or NaN everywhere; must be finite where it is known")
    return magnitude


def zero_level(reference: float | None, on_plane: Array | None, in_domain: Array | None) -> float:
    """The pressure of 0 dB [Pa]: the reference or the peak on the plane, or else of the volume.

    Raises:
        ValueError: the reference is not > 0, or the peak is 0.
    """
    if reference is not None:
        return positive("reference", reference, "Pa")
    name, shown = ("field", on_plane) if on_plane is not None else ("volume", in_domain)
    if shown is None:  # no pressure is drawn
        return 1.0
    peak = float(np.nanmax(shown))
    if peak == 0:
        raise ValueError(f"{name}: 0 Pa everywhere has no level; give the reference of 0 dB [Pa]")
    return peak
