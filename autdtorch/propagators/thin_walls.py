"""Walls thinner than a cell and oblique to the grid, whose errors are larger than grids tell."""

from __future__ import annotations

import logging

import numpy as np
import torch

from autdtorch.fdtd.assembly.slender import slender_faces
from autdtorch.fdtd.region import Body, Fluid, Shape
from autdtorch.fdtd.turning import flat_faces
from autdtorch.propagators.plan import Plan
from autdtorch.utils.array_types import Array
from autdtorch.utils.triangles import doubled_normals

logger = logging.getLogger(__name__)

_MOST_PLACES, _DEPTHS = 200, 16  # Places of a surface where the thickness is measured, and depths below each
_LEAST_SHARE = 0.05  # Least share of a surface that is a thin wall; at sharp edges less is
_ALIKE = 2.0  # Ratio of densities up to which a thin wall of fluid causes little


def warn_of_thin_walls(plan: Plan) -> None:
    """Log which obstacles of a plan have walls thinner than a cell, oblique to the grid."""
    for group, axes in zip(plan.grouping.groups, plan.grouping.axes, strict=True):
        for index in group:
            body = plan.region.bodies[index]
            if not _is_oblique(body, axes, plan.spacing) or _is_alike(body, plan.region.fluid):
                continue
            if (found := thin_wall(body.shape, plan.spacing)) is not None:
                thickness, place = found
                logger.warning(
                    "obstacle %d has a wall of %.2g mm at %s mm, oblique to the grid and thinner than a cell"
                    " of %.3g mm: the error may be larger than estimated",
                    index, 1e3 * thickness, tuple((1e3 * place).round(2).tolist()), 1e3 * plan.spacing,
                )  # fmt: skip


def thin_wall(shape: Shape, spacing: float) -> tuple[float, Array] | None:
    """Return the least thickness [m] of a shape and where (3,) [m], if walls are thinner than a cell."""
    vertices, triangles = (part.numpy() for part in shape.surface())
    corners = vertices[triangles]
    normals = doubled_normals(corners)
    size = np.linalg.norm(normals, axis=1)
    some = np.argsort(-size)[:: max(1, len(size) // _MOST_PLACES)]
    some = some[size[some] > 0]
    depths = spacing * np.arange(1, _DEPTHS + 1) / _DEPTHS
    inwards = -normals[some] / size[some, None]
    places = corners[some].mean(axis=1)[:, None] + depths[:, None] * inwards[:, None]
    distance = shape.signed_distance(torch.from_numpy(places)).numpy()
    first = (distance > 0).argmax(axis=1)  # depth behind the opposite face
    behind = distance[range(len(first)), first]
    thin = behind > 0
    if size[some][thin].sum() < _LEAST_SHARE * size[some].sum():
        return None
    thickness = np.where(thin, depths[first] - behind, np.inf)
    least = int(thickness.argmin())
    return float(thickness[least]), np.asarray(corners[some[least]].mean(axis=0))


def _is_oblique(body: Body, axes: Array, spacing: float) -> bool:
    """Return whether a body is neither flat along the `axes` of a grid nor a needle along one of them."""
    if body.continued or flat_faces(body.shape).all_aligned(axes):
        return False
    return slender_faces(body.shape.surface()[0].numpy() @ axes.T / spacing) is None


def _is_alike(body: Body, air: Fluid) -> bool:
    """Return whether a body is a fluid about as dense as air."""
    return body.fluid is not None and 1 / _ALIKE < body.fluid.density / air.density < _ALIKE
