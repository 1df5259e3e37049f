"""Axes of a box seen from a corner: its grid, and labels that neither overlap nor are cut off."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from autdtorch.plot.style import round_numbers
from autdtorch.utils.array_types import Array

TextSize = Callable[[str], tuple[float, float]]
"""Width and height of a text in the picture."""
_Ticks = tuple[list[float], int]  # places along an axis, and the decimals of their labels

# Sides of the box with the edges that have the labels of x, y and z; 0 is the lower side, 1 the upper one.
# The viewer is at low x, low y and high z.
_EDGES = ((0, 0, 0), (0, 0, 0), (0, 1, 0))
_BACK = (1, 1, 0)  # sides behind the box, which have the grid
# From a tick to the nearest point of its label, in heights of a text. The signs give the direction.
_OFFSETS = ((0.15, -0.55), (-0.15, -0.55), (-0.4, 0.0))
_APART = 0.35  # least distance of labels, in heights
_TITLE_STEP = 0.2  # by which a title is moved outwards until it is clear, in heights
_SHRINK = 0.97  # by which the box is made smaller until its labels fit


class Label(NamedTuple):
    """A text, the point of the box that it belongs to (3,), and its lower left corner from there (2,)."""

    text: str
    point: Array
    corner: Array


@dataclass(frozen=True)
class BoxAxes:
    """Ticks and labels of a box in a picture.

    Attributes:
        ticks: along x, y and z.
        labels: numbers and titles.
        scale: length in the picture of a unit of the box.
        low: lower left corner (2,) of the box with all labels, from the projected centre of the box.
        high: upper right corner (2,).
    """

    ticks: tuple[list[float], ...]
    labels: list[Label]
    scale: float
    low: Array
    high: Array


def axes_of(
    lower: Array, upper: Array, view: Array, room: tuple[float, float], size: TextSize, titles: Sequence[str]
) -> BoxAxes:
    """Return the axes of the largest picture of a box that fits a room.

    Args:
        lower: lower corner of the box (3,).
        upper: upper corner (3,).
        view: right and upward direction of the picture in the space of the box (2, 3), orthonormal.
        room: width and height of the picture.
        size: of texts, in the units of the room.
        titles: of x, y and z.
    """
    corners = (_corners(lower, upper) - (lower + upper) / 2) @ view.T
    scale = float(min(np.array(room) / np.ptp(corners, axis=0)))
    while True:
        axes = _at_scale(lower, upper, view, scale, size, titles)
        if (axes.high - axes.low <= room).all() or scale < 1e-3 * min(room) / max(upper - lower):
            return axes
        scale *= _SHRINK


def view_from(towards: Array) -> Array:
    """Return the right and upward direction (2, 3) of a picture, from the direction (3,) to its viewer."""
    right = np.cross((0.0, 0.0, 1.0), towards)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(towards / np.linalg.norm(towards), right)])


def grid_lines(lower: Array, upper: Array, ticks: Sequence[Sequence[float]]) -> Array:
    """Return the ends (N, 2, 3) of the lines at the ticks on the sides behind the box, and of their edges."""
    ends = (lower, upper)
    lines = []
    for axis, other in itertools.permutations(range(3), 2):
        fixed = 3 - axis - other  # on the back side across `fixed`: lines along `other` at ticks of `axis`
        for place in (lower[axis], *ticks[axis], upper[axis]):
            line = np.empty((2, 3))
            line[:, axis], line[:, fixed] = place, ends[_BACK[fixed]][fixed]
            line[:, other] = lower[other], upper[other]
            lines.append(line)
    return np.array(lines)


def _corners(lower: Array, upper: Array) -> Array:
    return np.array(list(itertools.product(*zip(lower, upper, strict=True))))


class _Texts:
    """Texts of a picture at a scale, placed one after the other."""

    def __init__(self, centre: Array, view: Array, size: TextSize) -> None:
        """Begin with no text; `view` includes the scale."""
        self.labels: list[Label] = []
        self.boxes: list[tuple[Array, Array]] = []  # lower and upper corners, from the projected centre
        self._centre, self._view, self._size = centre, view, size
        self.height = size("0")[1]

    def place(self, text: str, point: Array, offset: Array, gap: float) -> bool:
        """Place a text unless it is within a gap of another; offset and gap in heights of a text."""
        extent, gap = np.array(self._size(text)), gap * self.height
        corner = self.height * offset + np.choose(np.sign(offset).astype(int) + 1, (-1.0, -0.5, 0.0)) * extent
        low = self._view @ (point - self._centre) + corner
        if any(((low - gap < high) & (low + extent + gap > other)).all() for other, high in self.boxes):
            return False
        self.boxes.append((low, low + extent))
        self.labels.append(Label(text, point, corner))
        return True

    def ticks(self, axis: int, low: float, high: float) -> _Ticks:
        """Return ticks along an axis whose labels do not overlap."""
        length = np.abs(self._view[:, axis]) * (high - low)

        def fits(text: str, intervals: float) -> bool:
            return bool((length / intervals > np.array(self._size(text)) + _APART * self.height).any())

        return round_numbers(low, high, fits)


def _at_scale(
    lower: Array, upper: Array, view: Array, scale: float, size: TextSize, titles: Sequence[str]
) -> BoxAxes:
    """Return the axes of a box at a scale."""
    centre = (lower + upper) / 2
    texts = _Texts(centre, scale * view, size)
    ticks = _alike([texts.ticks(axis, lower[axis], upper[axis]) for axis in range(3)], lower, upper)
    offsets = np.array(_OFFSETS)
    edges = np.where(_EDGES, upper, lower)  # a point of each edge with labels
    for axis, (edge, (places, decimals)) in enumerate(zip(edges, ticks, strict=True)):
        for place in places:
            name = f"{place:.{decimals}f}".replace("-", "\N{MINUS SIGN}")
            texts.place(name, np.where(np.arange(3) == axis, place, edge), offsets[axis], _APART)
    for axis, (title, edge) in enumerate(zip(titles, edges, strict=True)):
        middle = np.where(np.arange(3) == axis, centre, edge)
        outwards = offsets[axis] / np.linalg.norm(offsets[axis])
        steps = (offsets[axis] + _TITLE_STEP * count * outwards for count in itertools.count())
        next(offset for offset in steps if texts.place(title, middle, offset, 2 * _APART))
    boxes, drawn = np.array(texts.boxes), scale * (_corners(lower, upper) - centre) @ view.T
    low, high = np.minimum(boxes[:, 0].min(0), drawn.min(0)), np.maximum(boxes[:, 1].max(0), drawn.max(0))
    return BoxAxes(tuple(places for places, _ in ticks), texts.labels, scale, low, high)


def _alike(ticks: Sequence[_Ticks], lower: Array, upper: Array) -> list[_Ticks]:
    """Return the ticks at the widest step of all, along each axis that is long enough for it."""
    steps = [(places[1] - places[0], digits) for places, digits in ticks if len(places) > 1]
    step, decimals = max(steps, default=(math.inf, 0))
    alike = []
    for axis, (places, digits) in enumerate(ticks):
        first, last = math.ceil(lower[axis] / step - 1e-9), math.floor(upper[axis] / step + 1e-9)
        wide = [step * count for count in range(first, last + 1)]
        alike.append((wide, decimals) if len(wide) > 1 else (places, digits))
    return alike
