"""The hold of the mouse on an object, which it drags or turns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from autdtorch.plot.data import MM
from autdtorch.plot.explore.situation import Situation
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.moving import angles_of
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import Vector

DIGITS = 7
"""Decimals of lengths [m] from the page, whose steps are 0.1 mm."""


class Grip(NamedTuple):
    """A hold of the mouse on an object in the picture.

    Attributes:
        kind: "body", "focus" or "transducer".
        number: index of the object.
        place: the point of the object under the mouse (3,) [m].
        origin: centre of the object when it was gripped (3,) [m].
        angles: angles of a body when it was gripped (3,) [rad].
    """

    kind: str
    number: int
    place: Array
    origin: Array
    angles: Vector = (0.0, 0.0, 0.0)

    def dragged(self, situation: Situation, place: Array) -> Situation:
        """Return a situation with the body or focus moved so that its grip is at a place (3,) [m]."""
        offset = np.round(MM * (place - self.place), 1) / MM
        center = (self.origin + offset).round(DIGITS)
        if self.kind == "body":
            x, y, z = center.tolist()
            return situation.with_body(self.number, (x, y, z), situation.bodies[self.number].angles)
        points = situation.scene.control_points.clone()
        points[self.number] = points.new_tensor(center)
        return situation.with_points(points)

    def turned(self, situation: Situation, angle: float) -> Situation:
        """Return a situation with the body turned about the vertical by an angle [rad] from its grip."""
        turn = rotation_matrix((0.0, 0.0, angle)) @ rotation_matrix(self.angles)
        a, b, c = angles_of(turn).tolist()
        return situation.with_body(self.number, situation.bodies[self.number].center, (a, b, c))
