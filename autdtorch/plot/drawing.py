"""What the pictures of `plot` and `rendering` share: units, colours, and checks of what is drawn."""

from __future__ import annotations

import numpy as np

from autdtorch.scene.drive import phases_of, validate_single_drive
from autdtorch.utils.arrays import Array
from autdtorch.utils.validation import ArrayLike, Vector, magnitude_tensor, real_tensor

MM = 1e3  # lengths are drawn in millimetres

# From the Okabe-Ito palette, told apart by colour-blind readers too.
TRANSDUCER_COLOUR = "#0072B2"
FOCUS_COLOUR = "#D55E00"
PLANE_COLOUR = "#56B4E9"
OBSTACLE_COLOUR = "#B0B0B0"
EDGE_COLOUR = "#222222"

SHARP_ANGLE = np.radians(30)  # edges of obstacles are drawn where faces meet at more than this
MOST_EDGES = 500  # of one obstacle; more, as voxels have, would blacken it and are left out

PHASE_MAP = "twilight"  # cyclic: 0 and 2 pi look the same
PRESSURE_MAP = "inferno"
FLOOR = -30.0  # dB, the lower end of the colours of levels
WAVE_MAP = "RdBu_r"  # of pressures of both signs; white is 0


def clipped(corners: Array, lower: Vector, upper: Vector) -> Array:
    """The part of a convex polygon or of a line (K, 3) that lies in a box (Sutherland & Hodgman 1974).

    Returns:
        Corners (L, 3), L = 0 where nothing is left. A line is run through to its end and may run back.
    """
    for side in range(6):
        axis, sign, bound = side // 2, (1, -1)[side % 2], (lower, upper)[side % 2][side // 2]
        height = sign * (corners[:, axis] - bound)
        kept = []
        for here, there in enumerate(np.roll(np.arange(len(corners)), -1)):
            if height[here] >= 0:
                kept.append(corners[here])
            if height[here] * height[there] < 0:
                share = height[here] / (height[here] - height[there])
                kept.append(corners[here] + share * (corners[there] - corners[here]))
        corners = np.array(kept).reshape(-1, 3)
    return corners


def plane_magnitude(name: str, pressure: ArrayLike) -> Array:
    """Return |p| (Nu, Nv) of complex pressure, or of its magnitude, on a plane.

    Raises:
        ValueError: not finite numbers, another number of axes, or no entry.
    """
    magnitude: Array = real_tensor(name, magnitude_tensor(name, pressure, "Pa"), "Pa").detach().cpu().numpy()
    if magnitude.ndim != 2 or magnitude.size == 0:
        raise ValueError(f"{name}: shape {magnitude.shape}; must be (Nu, Nv), the points of a plane")
    return magnitude


def in_decibels(magnitude: Array, zero: float) -> Array:
    """Level 20 lg(|p| / zero) [dB]; of silence, minus infinity; NaN stays."""
    with np.errstate(divide="ignore"):
        level: Array = 20 * np.log10(magnitude / zero)
    return level


def single_drive_phases(drive: ArrayLike, transducers: int) -> Array:
    """Phases (M,) in [0, 2 pi) [rad] of one drive of an array of `transducers`.

    Raises:
        ValueError: not one drive that the array can play.
    """
    phases: Array = phases_of(validate_single_drive(drive, transducers)).detach().cpu().numpy()
    return phases
