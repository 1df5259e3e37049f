"""Heterogeneous cells of a scene, counted from its geometry alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autdtorch.fdtd.grid import layer_cells
from autdtorch.fdtd.region import Region
from autdtorch.scene.obstacles import Mesh
from autdtorch.utils.array_types import Array

_BESIDE_RIGID, _BESIDE_FLUID, _SHARE_INSIDE = 1.5, 2.0, 0.5
"""Heterogeneous cells for each area of a cell of a rigid or fluid surface; their share of the cuboid around
an obstacle of another sound speed."""


@dataclass(frozen=True)
class Heterogeneity:
    """Estimated numbers of cells and elements that are not uniform air, on all grids of a scene.

    Attributes:
        cut: elements that surfaces cut.
        cells: heterogeneous cells: beside surfaces, and inside another medium.
        columns: elements that surfaces cut in the boundary layers.
        meshed: heterogeneous cells at meshes.
    """

    cut: float
    cells: float
    columns: float
    meshed: float


def heterogeneity(region: Region, spacing: float, whole_domain: bool) -> Heterogeneity:
    """Count what is not uniform air on cells of `spacing` [m].

    Args:
        region: the region.
        spacing: edge of a cell [m].
        whole_domain: True for a grid of the domain, whose boundary layers continue the obstacles; False for
            boxes around all obstacles.
    """
    inner = outer = np.array([[-np.inf] * 3, [np.inf] * 3])
    if whole_domain:
        inner = np.array(region.domain)
        outer = inner + spacing * layer_cells(region.wavenumber * spacing) * np.array([[-1.0], [1.0]])
    cut = cells = columns = meshed = 0.0
    for body in region.bodies:
        vertices, triangles = (part.numpy() for part in body.shape.surface())
        doubled = _doubled_areas(np.clip(vertices, *inner)[triangles])
        continued = _doubled_areas(np.clip(vertices, *outer)[triangles])
        area = float(np.linalg.norm(doubled, axis=1).sum()) / 2
        # a plane of normal n cuts |nx| + |ny| + |nz| elements for each area of a cell
        cut += float(np.abs(doubled).sum()) / 2 / spacing**2
        columns += (float(np.linalg.norm(continued, axis=1).sum()) / 2 - area) / spacing**2
        beside = (_BESIDE_FLUID if body.fluid else _BESIDE_RIGID) * area / spacing**2
        cells += beside
        meshed += beside if isinstance(body.shape, Mesh) else 0.0
        if body.fluid and body.fluid.sound_speed != region.fluid.sound_speed:
            box = np.clip([body.shape.lower, body.shape.upper], *inner)
            cells += _SHARE_INSIDE * float(np.prod(box[1] - box[0])) / spacing**3
    return Heterogeneity(cut, cells, columns, meshed)


def _doubled_areas(triangles: Array) -> Array:
    """Normals (T, 3) of triangles (T, 3, 3), twice as long as their areas."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.asarray(np.cross(b - a, c - a))
