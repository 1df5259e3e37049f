"""The mouse in the picture: it drags bodies and foci, and turns bodies; elsewhere it turns the camera."""

from __future__ import annotations

import functools
import math
from typing import Any, Protocol

import numpy as np

from autdtorch.plot.explore.picture import Grip, Picture
from autdtorch.utils.array_types import Array

_FIRST = 10.0  # priority; the camera's is lower
_ANGLE = math.radians(0.5)  # for each pixel
_KEYS = "CharEvent", "KeyPressEvent", "KeyReleaseEvent"  # VTK would change the picture, such as to stereo


class Owner(Protocol):
    """The session, as the mouse knows it."""

    def drag(self, grip: Grip, place: Array) -> None:
        """Move what is gripped to a place (3,) [m]."""

    def turn(self, grip: Grip, angle: float) -> None:
        """Turn what is gripped by an angle [rad]."""

    def choose(self, grip: Grip) -> None:
        """Choose what is gripped."""

    def settle(self) -> None:
        """Calculate finely: the mouse was let go."""


class Mouse:
    """The mouse, whose events VTK's interactor brings."""

    def __init__(self, picture: Picture, owner: Owner) -> None:
        """Listen to the picture's window."""
        self._picture, self._owner = picture, owner
        self._grip: Grip | None = None
        self._place = np.zeros(3)
        self._from, self._upright = 0.0, False
        self._interactor: Any = picture.plotter.iren.interactor
        for event, listener in (
            *((event, functools.partial(self._stop, event)) for event in _KEYS),
            ("LeftButtonPressEvent", self._press),
            ("MouseMoveEvent", self._move),
            ("LeftButtonReleaseEvent", self._release),
        ):
            tag = self._interactor.AddObserver(event, listener, _FIRST)
            setattr(self, f"_{event}", self._interactor.GetCommand(tag))

    def let_go(self) -> None:
        """Hold nothing any more: what was gripped may have gone."""
        self._grip = None

    def _press(self, *_: object) -> None:
        x, y = self._interactor.GetEventPosition()
        found = self._picture.grip(x, y)
        if found is None:
            return
        self._owner.choose(found)
        if found.kind != "transducer":
            self._grip, self._from, self._upright, self._place = found, x, False, found.place
            self._stop("LeftButtonPressEvent")

    def _move(self, *_: object) -> None:
        if self._grip is None:
            return
        x, y = self._interactor.GetEventPosition()
        if self._interactor.GetShiftKey():
            self._owner.turn(self._grip, _ANGLE * (x - self._from))
        else:
            upright = bool(self._interactor.GetControlKey() or self._interactor.GetAltKey())
            if upright != self._upright:  # go on from where it is
                middle = self._grip.origin + self._place - self._grip.place
                self._grip, self._upright = self._grip._replace(place=self._place, origin=middle), upright
            self._place = self._picture.moved(self._grip, x, y, upright)
            self._owner.drag(self._grip, self._place)
        self._stop("MouseMoveEvent")

    def _release(self, *_: object) -> None:
        if self._grip is not None:
            self._grip = None
            self._stop("LeftButtonReleaseEvent")
            self._owner.settle()

    def _stop(self, event: str, *_: object) -> None:
        """Keep the event from the camera."""
        getattr(self, f"_{event}").SetAbortFlag(1)
