"""The controls of a live view: what follows when the page changes its state or calls an action.

What the page sends is checked here: numbers, indices, names of lists. All else is set back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from autdtorch.plot.explore.display import FOCUS, PLACE, TURN
from autdtorch.plot.explore.page import CAMERA, first_state
from autdtorch.plot.explore.readings import MM, four_digits, in_mm
from autdtorch.plot.explore.session import DIGITS, Session

_LOWEST = -60.0  # of the level of the surface in the volume [dB]


class Controls:
    """The controls of a session."""

    def __init__(self, trame: Any, session: Session) -> None:
        """Set the state of the page, and what follows when it changes."""
        self._state, self._session, self._display = trame.state, session, session.display
        self._settled: object = 0
        trame.state.update(first_state(session.now, session.methods))
        followed: list[tuple[tuple[str, ...], Callable[[], None]]] = [
            (("body", "focus", "transducer"), self._choose),
            ((*PLACE, *TURN), self._move_body),
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
        for names, changed in followed:
            trame.state.change(*names)(lambda changed=changed, **_: changed())
        for action in (
            session.undo, session.redo, session.add_focus, session.remove_focus, session.in_phase,
            session.find, session.cancel, session.write_python, session.save, self.rescale,
        ):  # fmt: skip
            trame.controller.trigger(action.__name__)(action)
        for name in CAMERA:
            trame.controller.trigger(name)(lambda name=name: self._look(name))

    def rescale(self) -> None:
        """Fit the colours to the field."""
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
        if entered := self._entered((*PLACE, *TURN), self._display.body_values(now, index)):
            x, y, z = (round(MM * one, DIGITS) for one in entered[:3])
            a, b, c = (math.radians(one) for one in entered[3:])
            self._attempt(lambda: now.with_body(index, (x, y, z), (a, b, c)))

    def _move_focus(self) -> None:
        now = self._session.now
        points = now.scene.control_points.clone()
        index = self._display.chosen("focus", len(points))
        if entered := self._entered(FOCUS, self._display.focus_values(now, index)):
            points[index] = points.new_tensor([round(MM * one, DIGITS) for one in entered])
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
            self._attempt(lambda: now.with_plane(now.plane, MM * entered[0]))

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
        """Change the situation; where a slider was let go, the fine calculation follows at once."""
        self._session.attempt(changed, moving=self._state.settled == self._settled)

    def _let_go(self) -> None:
        """Calculate finely, if a slider was let go or a number entered."""
        if self._state.settled != self._settled:
            self._settled = self._state.settled
            self._session.settle()

    def _entered(self, names: tuple[str, ...], shown: tuple[float, ...]) -> tuple[float, ...] | None:
        """Return numbers of the page, or None where they are those shown; what is no number is set back."""
        given = tuple(self._state[name] for name in names)
        if given == shown:
            return None
        if not all(type(one) in (int, float) and math.isfinite(one) for one in given):  # bool is an int
            self._choose()
            return None
        return tuple(map(float, given))
