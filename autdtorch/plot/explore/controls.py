"""The controls of a live view: its page and the mouse in the picture.

Values from the page (numbers, indices, names of lists) are checked here; others are set back.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from autdtorch.plot.data import MM
from autdtorch.plot.explore.display import ANGLES, FOCUS, POSITION, first_state, four_digits, in_mm
from autdtorch.plot.explore.page import CAMERA
from autdtorch.plot.explore.rendering import DIGITS
from autdtorch.plot.explore.session import Session

_LOWEST = -60.0  # level of the isosurface in the volume [dB]
_BEFORE_CAMERA = 10.0  # priority of the mouse; the camera's is lower
_ANGLE = math.radians(0.5)  # for each pixel
_KEYS = "CharEvent", "KeyPressEvent", "KeyReleaseEvent"  # VTK would change the picture, such as to stereo


class Controls:
    """The controls of the page: they follow changes of its state, and its actions."""

    def __init__(self, trame: Any, session: Session) -> None:
        """Set the state of the page, and listen to it."""
        self._state, self._session, self._display = trame.state, session, session.display
        self._settled: object = 0
        trame.state.update(first_state(session.now, session.methods))
        listeners: list[tuple[tuple[str, ...], Callable[[], None]]] = [
            (("body", "focus", "transducer"), self._choose),
            ((*POSITION, *ANGLES), self._move_body),
            (FOCUS, self._move_focus),
            (("phase", "amplitude"), self._edit_drive),
            (("plane",), self._choose_plane),
            (("height",), self._move_plane),
            (("unit",), session.redraw),
            (("reference", "surface"), self._choose_scale),
            (("volume",), session.look),
            (("dark",), self._choose_dark),
            (("settled",), self._let_go),  # the last, as it follows changes that come with it
        ]
        for names, listener in listeners:
            trame.state.change(*names)(lambda listener=listener, **_: listener())
        for action in (
            session.undo, session.redo, session.add_focus, session.remove_focus, session.in_phase,
            session.find, session.cancel, session.write_python, session.save, self.rescale,
        ):  # fmt: skip
            trame.controller.trigger(action.__name__)(action)
        for name in CAMERA:
            trame.controller.trigger(name)(lambda name=name: self._look(name))

    def rescale(self) -> None:
        """Fit the colours to the field; the page cannot give a pressure."""
        self._session.rescale()

    def _look(self, name: str) -> None:
        self._display.picture.move_camera(*CAMERA[name].move)
        self._display.update()

    def _choose(self) -> None:
        self._session.place()
        self._display.update()

    def _move_body(self) -> None:
        now = self._session.now
        if not now.bodies:
            return
        index = self._display.chosen("body", len(now.bodies))
        if entered := self._entered((*POSITION, *ANGLES), self._display.body_values(now, index)):
            x, y, z = (round(number / MM, DIGITS) for number in entered[:3])
            a, b, c = map(math.radians, entered[3:])
            self._attempt(lambda: now.with_body(index, (x, y, z), (a, b, c)))

    def _move_focus(self) -> None:
        now = self._session.now
        points = now.scene.control_points.clone()
        index = self._display.chosen("focus", len(points))
        if entered := self._entered(FOCUS, self._display.focus_values(now, index)):
            points[index] = points.new_tensor([round(number / MM, DIGITS) for number in entered])
            self._attempt(lambda: now.with_points(points))

    def _edit_drive(self) -> None:
        now = self._session.now
        index = self._display.chosen("transducer", len(now.drive))
        if entered := self._entered(("phase", "amplitude"), self._display.drive_values(now, index)):
            phase, amplitude = entered
            if amplitude == 0:
                self._display.silent[index] = phase
            self._attempt(lambda: now.with_transducer(index, math.radians(phase), amplitude))

    def _choose_plane(self) -> None:
        if self._state.plane != self._session.now.plane:
            self._session.attempt(lambda: self._session.now.with_plane(self._state.plane), moving=False)
            self._session.settle()

    def _move_plane(self) -> None:
        now = self._session.now
        if entered := self._entered(("height",), (in_mm(now.height),)):
            self._attempt(lambda: now.with_plane(now.plane, entered[0] / MM))

    def _choose_scale(self) -> None:
        display, now = self._display, self._session.now
        shown = 1.0 if now.reference is None else four_digits(now.reference)
        reference = self._entered(("reference",), (shown,))
        surface = self._entered(("surface",), (display.surface,))
        if surface and _LOWEST <= surface[0] < 0:
            display.surface = surface[0]
            self._state.message = ""
        if reference and reference[0] > 0:
            self._session.rescale(reference[0])
        elif reference or surface:
            self._session.redraw()  # sets back what is out of range

    def _choose_dark(self) -> None:
        self._display.picture.set_dark(bool(self._state.dark))
        self._display.update()

    def _attempt(self, changed: Callable[[], Any]) -> None:
        """Change the situation. When a slider is let go, the fine calculation follows at once."""
        self._session.attempt(changed, moving=self._state.settled == self._settled)

    def _let_go(self) -> None:
        """Calculate finely when a slider is let go or a number entered."""
        if self._state.settled != self._settled:
            self._settled = self._state.settled
            self._session.settle()

    def _entered(self, names: tuple[str, ...], shown: tuple[float, ...]) -> tuple[float, ...] | None:
        """Return numbers of the page, or None where they are those shown; other values are set back."""
        values = tuple(self._state[name] for name in names)
        if values == shown:
            return None
        if not all(type(value) in (int, float) and math.isfinite(value) for value in values):  # no bool
            self._choose()
            return None
        return tuple(map(float, values))


class Mouse:
    """The mouse in the picture: it drags bodies and foci, and turns bodies; elsewhere it turns the camera.

    VTK's interactor brings its events.
    """

    def __init__(self, session: Session) -> None:
        """Listen to the window of the picture."""
        self._session, self._picture = session, session.display.picture
        self._place = np.zeros(3)  # of the grip in the last move [m]
        self._from, self._upright = 0.0, False
        self._interactor: Any = self._picture.plotter.iren.interactor
        self._commands: dict[str, Any] = {}
        for event, listener in (
            *((event, functools.partial(self._stop, event)) for event in _KEYS),
            ("LeftButtonPressEvent", self._press),
            ("MouseMoveEvent", self._move),
            ("LeftButtonReleaseEvent", self._release),
        ):
            tag = self._interactor.AddObserver(event, listener, _BEFORE_CAMERA)
            self._commands[event] = self._interactor.GetCommand(tag)

    def _press(self, *_: object) -> None:
        x, y = self._interactor.GetEventPosition()
        if (grip := self._picture.grip(x, y)) is None:
            return
        self._session.choose(grip)
        if grip.kind != "transducer":
            self._session.grip, self._place = grip, grip.place
            self._from, self._upright = x, False
            self._stop("LeftButtonPressEvent")

    def _move(self, *_: object) -> None:
        if (grip := self._session.grip) is None:
            return
        x, y = self._interactor.GetEventPosition()
        if self._interactor.GetShiftKey():
            self._session.turn(grip, _ANGLE * (x - self._from))
        else:
            upright = bool(self._interactor.GetControlKey() or self._interactor.GetAltKey())
            if upright != self._upright:  # continue from the present place
                origin = grip.origin + self._place - grip.place
                self._session.grip = grip = grip._replace(place=self._place, origin=origin)
                self._upright = upright
            self._place = self._picture.moved(grip, x, y, upright)
            self._session.drag(grip, self._place)
        self._stop("MouseMoveEvent")

    def _release(self, *_: object) -> None:
        if self._session.grip is not None:
            self._session.grip = None
            self._stop("LeftButtonReleaseEvent")
            self._session.settle()

    def _stop(self, event: str, *_: object) -> None:
        """Hide the event from the camera."""
        self._commands[event].SetAbortFlag(1)
