"""Triangles in space."""

from __future__ import annotations

import numpy as np

from autdtorch.utils.array_types import Array


def doubled_normals(corners: Array) -> Array:
    """Return the outward normals (T, 3) of triangles with `corners` (T, 3, 3), of twice their area."""
    first, second, third = np.moveaxis(corners, 1, 0)
    return np.asarray(np.cross(second - first, third - first))
