"""Two views of a scene as SVG text: small, made without any drawing package, for its display in Jupyter."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable

import numpy as np
import torch

from autdtorch.array import TransducerArray
from autdtorch.drawing import (
    FOCUS_COLOUR,
    MM,
    OBSTACLE_COLOUR,
    PLANE_COLOUR,
    TRANSDUCER_COLOUR,
    Array,
)
from autdtorch.geometry import Plane
from autdtorch.obstacles import Obstacle
from autdtorch.validation import Vector

_LONGEST = 200.0  # edge of the domain [px]
_LABELS = 18.0  # room for them below and on the left of a view [px]
_GAP = 8.0  # beside and above a view [px]
_DOT = 2.5  # radius of a transducer and of a control point [px]

#: By the axis that the array points along: (horizontal, vertical) axis from its side, and along its normal.
_VIEWS = {0: ((0, 2), (1, 2)), 1: ((1, 2), (0, 2)), 2: ((0, 2), (0, 1))}


def sketch(
    array: TransducerArray,
    obstacles: Iterable[Obstacle],
    control_points: torch.Tensor,
    plane: Plane | None,
    domain: tuple[Vector, Vector],
) -> str:
    """Outlines of what a scene holds, seen from the side of the array and along its normal, to one scale.

    Args:
        array: drawn as blue dots.
        obstacles: drawn in grey, all of what the domain holds of them.
        control_points: (P, 3) [m], drawn as orange dots.
        plane: drawn as a pale sheet or line, if there is one.
        domain: corners (lower, upper) [m] of what is shown.

    Returns:
        An ``svg`` element.
    """
    lower, upper = (MM * np.array(corner) for corner in domain)
    scale = _LONGEST / float((upper - lower).max())
    sheet = [] if plane is None else [MM * plane.corners[[0, 1, 3, 2]].numpy()]
    normal = int(array.normals.mean(dim=0).abs().argmax())
    parts, left, height = [], 0.0, 0.0
    for axes in map(list, _VIEWS[normal]):
        shapes = [_filled([corners[:, axes]], PLANE_COLOUR, 1 / scale, 0.3) for corners in sheet]
        shapes += [_filled(_outlines(obstacle, axes), OBSTACLE_COLOUR, 0, 1) for obstacle in obstacles]
        for points, colour in ((array.positions, TRANSDUCER_COLOUR), (control_points, FOCUS_COLOUR)):
            shapes.append(_dots(MM * points[:, axes].numpy(), colour, _DOT / scale))
        view, width, tall = _view(shapes, axes, lower[axes], upper[axes], scale, left)
        parts.append(view)
        left, height = left + width, max(height, tall)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{left:.0f}" height="{height:.0f}" '
        f'font-family="sans-serif" font-size="10" style="background: white">{"".join(parts)}</svg>'
    )


def _view(
    shapes: list[str], axes: list[int], lower: Array, upper: Array, scale: float, left: float
) -> tuple[str, float, float]:
    """One view with its frame and labels, `left` px from the border; its width and height [px] with these."""
    extent = upper - lower
    width, height = scale * extent
    x, y = left + _LABELS, _GAP
    across, upwards = (
        f"{'xyz'[axis]}: {low:.3g} to {high:.3g} mm"
        for axis, low, high in zip(axes, lower, upper, strict=True)
    )
    middle_x, middle_y = x + width / 2, y + height / 2
    box = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"'
    # An inner svg has units of its own, mm, and cuts off what is outside.
    inside = f'viewBox="{lower[0]:.6g} {-upper[1]:.6g} {extent[0]:.6g} {extent[1]:.6g}"'
    text = 'text-anchor="middle" fill="black"'
    svg = (
        f"<svg {box} {inside}>{''.join(shapes)}</svg>"
        f'<rect {box} fill="none" stroke="#888888"/>'
        f'<text x="{middle_x:.1f}" y="{y + height + 13:.1f}" {text}>{across}</text>'
        f'<text transform="translate({x - 6:.1f} {middle_y:.1f}) rotate(-90)" {text}>{upwards}</text>'
    )
    return svg, _LABELS + width + _GAP, _GAP + height + _LABELS


def _outlines(obstacle: Obstacle, axes: list[int]) -> list[Array]:
    """Polygons (K, 2) [mm] that go around all that faces the viewer, holes the other way round."""
    vertices, faces = (part.numpy() for part in obstacle.surface())
    seen = MM * vertices[:, axes]
    (x1, y1), (x2, y2) = ((seen[faces[:, corner]] - seen[faces[:, 0]]).T for corner in (1, 2))
    front = faces[x1 * y2 > x2 * y1]
    edges = Counter(map(tuple, front[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()))
    # Two triangles run through the edge that they share in opposite directions.
    border = edges - Counter({(end, start): count for (start, end), count in edges.items()})
    following = defaultdict(list)
    for start, end in border.elements():
        following[start].append(end)
    return [seen[_loop(following, start)] for start in list(following) if following[start]]


def _loop(following: dict[int, list[int]], start: int) -> list[int]:
    """Take one way out of `following` that leads back to its start."""
    loop = [start]
    while (after := following[loop[-1]].pop()) != start:
        loop.append(after)
    return loop


def _filled(polygons: list[Array], colour: str, line: float, opacity: float) -> str:
    """Polygons (K, 2) [mm], with an edge of width `line` [mm]."""
    runs = ("M" + "L".join(f"{x:.4g} {-y:.4g}" for x, y in polygon) + "Z" for polygon in polygons)
    return (
        f'<path d="{"".join(runs)}" fill="{colour}" stroke="{colour}" stroke-width="{line:.3g}" '
        f'opacity="{opacity:g}"/>'
    )


def _dots(points: Array, colour: str, radius: float) -> str:
    """Dots at points (N, 2) [mm]: the round ends of lines without length."""
    runs = "".join(f"M{x:.4g} {-y:.4g}h0" for x, y in points)
    return f'<path d="{runs}" stroke="{colour}" stroke-width="{2 * radius:.3g}" stroke-linecap="round"/>'
