"""The field of a drive in the whole domain of a scene."""

from __future__ import annotations

import math

import torch

from autdtorch.propagators.simulated import Propagator
from autdtorch.scene.drive import validate_single_drive
from autdtorch.scene.obstacles.base import inside_any
from autdtorch.scene.reflectors import are_in_front
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.spatial import nearest
from autdtorch.utils.validation import ArrayLike, invalid, positive, require_kind

_CLEARANCE = 0.5  # wavelengths around a transducer, where its own 1/r would hide the field of the others
_MOST_CELLS = 10_000_000


def volume_field(propagator: Propagator, drive: ArrayLike, spacing: float | None = None) -> torch.Tensor:
    """Return the pressure of a drive at the centres of equal cells that fill the scene's domain.

    Args:
        propagator: the propagator of the scene.
        drive: complex (M,), |q| <= 1.
        spacing: approximate edge of a cell [m], > 0; by default a quarter of the wavelength.

    Returns:
        complex128 (Nx, Ny, Nz) [Pa], with Nx = Lx / spacing rounded and at least 2, likewise Ny and Nz. NaN
        in obstacles, behind reflectors and within half a wavelength of a transducer.

    Raises:
        ValueError: `drive` or `spacing` is out of range, or there are more than 10 million cells.
    """
    require_kind("propagator", propagator, Propagator)
    scene = propagator.scene
    drive = validate_single_drive(drive, len(scene.array))
    spacing = scene.wavelength / 4 if spacing is None else positive("spacing", spacing, "m")
    lower, upper = torch.tensor(scene.domain, **REAL)
    counts = [max(2, round(float(length) / spacing)) for length in upper - lower]
    if math.prod(counts) > _MOST_CELLS:
        raise invalid("spacing", spacing, f"gives {counts} cells, must give at most {_MOST_CELLS}", "m")
    steps = [torch.arange(count, **REAL) + 0.5 for count in counts]
    axes = zip(lower, upper, steps, counts, strict=True)
    points = torch.cartesian_prod(*(low + (high - low) * step / count for low, high, step, count in axes))
    valid = are_shown(scene, points)
    field = torch.full((len(points),), complex(math.nan, math.nan), **COMPLEX)
    field[valid] = propagator.field(drive, points[None, valid])[0]  # a grid, which may touch obstacles
    return field.reshape(counts)


def are_shown(scene: Scene, points: torch.Tensor) -> torch.Tensor:
    """Return which points (N, 3) [m] are not in obstacles, behind reflectors or next to transducers."""
    gap, _ = nearest(points, scene.array.nodes.positions.reshape(-1, 3))
    clear = (gap > _CLEARANCE * scene.wavelength) & ~inside_any(points, scene.obstacles)
    return clear & are_in_front(scene.reflectors, points)
