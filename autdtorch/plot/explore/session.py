"""The session of a live view: what the page changes, what is calculated for it, and what it shows.

All methods are called in the thread of the server, which also renders.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from autdtorch.plot.data import largest
from autdtorch.plot.explore import saving
from autdtorch.plot.explore.calculation import Calculator, Progress, Request, Result
from autdtorch.plot.explore.catalogue import OFFERED
from autdtorch.plot.explore.history import History
from autdtorch.plot.explore.mouse import Mouse
from autdtorch.plot.explore.page import FIRST_SURFACE, first_state
from autdtorch.plot.explore.picture import Grip, Picture, Scale
from autdtorch.plot.explore.readings import MM, four_digits, in_degrees, in_mm, rows, summary
from autdtorch.plot.explore.situation import Situation
from autdtorch.scene.drive import amplitudes_of, phases_of
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.moving import angles_of
from autdtorch.utils.array_types import Array

_DIGITS = 7  # decimals of lengths [m] from the page, whose steps are 0.1 mm

_PATIENCE = 0.25  # s; a picture before the field would slow its calculation down
_NEW_FOCUS = 1.5  # wavelengths beside the last focus
_PLACE, _TURN = ("body_x", "body_y", "body_z"), ("turn_x", "turn_y", "turn_z")
_FOCUS = ("focus_x", "focus_y", "focus_z")


class Session:
    """A situation that page, mouse and calculations share."""

    def __init__(
        self,
        trame: Any,
        situation: Situation,
        spacing: float,
        defer: Callable[..., None],
        note: Callable[[Situation], None],
    ) -> None:
        """Begin with a situation; cells have a `spacing` [m] when nothing is dragged.

        `defer` calls a function in this thread, soon. `note` is told of every situation.
        """
        self._trame, self._state, self._note = trame, trame.state, note
        self._history = History(situation)
        self.picture = Picture(situation)
        self.update: Callable[[], None] = lambda: None  # sends the picture, once there is a page
        self._calculator = Calculator(spacing, lambda found: defer(self._receive, found))
        self._mouse = Mouse(self.picture, self)
        self._result: Result | None = None
        self._reference: float | None = None
        self._number, self._running = 0, False
        self._extras: tuple[object, ...] = ()
        self._settled: object = 0
        self._waiting = asyncio.get_running_loop().call_later(_PATIENCE, self.update)

    @property
    def now(self) -> Situation:
        """The situation that is shown."""
        return self._history.now

    def close(self) -> None:
        """End calculations and rendering."""
        self._calculator.close()
        self.picture.close()

    # What the page calls

    def settle(self) -> None:
        """Calculate finely: the mouse or a slider was let go."""
        self._history.settle()
        self._show_situation()
        self._ask()

    def undo(self) -> None:
        """Go a step back."""
        self._history.undo()
        self._show_situation()
        self._ask()

    def redo(self) -> None:
        """Take a step again."""
        self._history.redo()
        self._show_situation()
        self._ask()

    def add_focus(self) -> None:
        """Add a focus beside the chosen one."""
        points, scene = self.now.scene.control_points, self.now.scene
        sheet = self.now.sheet
        for direction in (*sheet.basis, *(-one for one in sheet.basis)):
            new = points[self._chosen("focus", len(points))] + _NEW_FOCUS * scene.wavelength * direction
            try:
                self._change(self.now.with_points(torch.cat([points, new[None]])))
            except ValueError as error:
                refusal = error
            else:
                self._state.focus = len(points)
                self.settle()
                return
        self._refuse(refusal)

    def remove_focus(self) -> None:
        """Remove the chosen focus."""
        points = self.now.scene.control_points
        if len(points) > 1:
            kept = torch.arange(len(points), device="cpu") != self._chosen("focus", len(points))
            self._change(self.now.with_points(points[kept]))
            self._state.focus = 0
            self.settle()

    def in_phase(self) -> None:
        """Give all transducers phase 0 and amplitude 1."""
        self._change(self.now.with_drive(torch.ones_like(self.now.drive)))
        self.settle()

    def find(self) -> None:
        """Run the chosen method."""
        if (name := str(self._state.method)) in OFFERED:
            self._history.settle()
            self._running = True
            self._state.update({"busy": True, "progress": 0, "message": ""})
            self._ask(method=name)

    def cancel(self) -> None:
        """End the method that runs; the drive stays."""
        self._ask()

    def rescale(self) -> None:
        """Fit the colours to the field."""
        self._reference = None
        self._show_field()

    def write_python(self) -> None:
        """Write scene and drive as Python."""
        self._state.python = saving.python_of(self.now)

    def save(self) -> None:
        """Write scene and drive to files."""
        try:
            folder = saving.save(self.now, str(self._state.folder), str(self._state.device))
        except (ValueError, OSError) as error:
            self._state.update({"saved": "", "message": str(error)})
        else:
            self._state.update({"saved": f"saved in {folder}", "message": ""})

    # What the mouse calls

    def drag(self, grip: Grip, place: Array) -> None:
        """Move a body or a focus so that its grip is at a place (3,) [m]."""
        offset = np.round((place - grip.place) / MM, 1) * MM
        if grip.kind == "body":
            body = self.now.bodies[grip.number]
            x, y, z = (round(one, _DIGITS) for one in (grip.origin + offset).tolist())
            self._try(lambda: self.now.with_body(grip.number, (x, y, z), body.angles))
        else:
            points = self.now.scene.control_points.clone()
            points[grip.number] = points.new_tensor((grip.origin + offset).round(_DIGITS))
            self._try(lambda: self.now.with_points(points))

    def turn(self, grip: Grip, angle: float) -> None:
        """Turn a body about the vertical by an angle [rad] from where it was gripped."""
        if grip.kind == "body":
            body = self.now.bodies[grip.number]
            turn = rotation_matrix((0.0, 0.0, angle)) @ rotation_matrix(grip.angles)
            a, b, c = angles_of(turn).tolist()
            self._try(lambda: self.now.with_body(grip.number, body.center, (a, b, c)))

    def choose(self, grip: Grip) -> None:
        """Choose what was gripped in the lists of the page."""
        with self._state:
            self._state[grip.kind] = grip.number

    # What the page changes

    def begin(self, method: str | None) -> None:
        """Set the state of the page, and what follows when it changes; run a method first, if given."""
        state = self._state
        state.update(first_state(self.now))
        self._extras = state.follow, state.volume, self._surface()
        self._show_situation()
        followed: list[tuple[tuple[str, ...], Callable[[], None]]] = [
            (("body", "focus", "transducer"), self._show_choice),
            ((*_PLACE, *_TURN), self._move_body),
            (_FOCUS, self._move_focus),
            (("phase", "amplitude"), self._edit_drive),
            (("plane",), self._choose_plane),
            (("height",), self._move_plane),
            (("unit", "reference"), self._choose_scale),
            (("follow", "volume", "surface"), self._choose_extras),
            (("dark",), self._choose_dark),
            (("settled",), self._let_go),  # the last, as it follows changes that come with it
        ]
        for names, changed in followed:
            state.change(*names)(lambda changed=changed, **_: changed())
        for action in (
            self.undo, self.redo, self.add_focus, self.remove_focus, self.in_phase, self.find,
            self.cancel, self.rescale, self.write_python, self.save,
        ):  # fmt: skip
            self._trame.controller.trigger(action.__name__)(action)
        self._ask(method=method)

    def _move_body(self) -> None:
        index = self._chosen("body", len(self.now.bodies))
        if self.now.bodies and (entered := self._entered((*_PLACE, *_TURN), self._body_values(index))):
            x, y, z = (round(MM * one, _DIGITS) for one in entered[:3])
            a, b, c = (math.radians(one) for one in entered[3:])
            self._try(lambda: self.now.with_body(index, (x, y, z), (a, b, c)))

    def _move_focus(self) -> None:
        index = self._chosen("focus", len(self.now.scene.control_points))
        if entered := self._entered(_FOCUS, self._focus_values(index)):
            points = self.now.scene.control_points.clone()
            points[index] = points.new_tensor([round(MM * one, _DIGITS) for one in entered])
            self._try(lambda: self.now.with_points(points))

    def _edit_drive(self) -> None:
        index = self._chosen("transducer", len(self.now.drive))
        if entered := self._entered(("phase", "amplitude"), self._drive_values(index)):
            self._try(lambda: self.now.with_transducer(index, math.radians(entered[0]), entered[1]))

    def _choose_plane(self) -> None:
        if self._state.plane != self.now.plane:
            self._try(lambda: self.now.with_plane(self._state.plane))
            self.settle()

    def _move_plane(self) -> None:
        if entered := self._entered(("height",), (in_mm(self.now.height),)):
            self._try(lambda: self.now.with_plane(self.now.plane, MM * entered[0]))

    def _choose_scale(self) -> None:
        shown = 1.0 if self._reference is None else four_digits(self._reference)
        if (entered := self._entered(("reference",), (shown,))) and entered[0] > 0:
            self._reference = entered[0]
        self._show_field()

    def _choose_extras(self) -> None:
        chosen = self._state.follow, self._state.volume, self._surface()
        if chosen != self._extras:
            self._extras = chosen
            self._ask()

    def _choose_dark(self) -> None:
        self.picture.set_dark(bool(self._state.dark))
        self.update()

    def _try(self, changed: Callable[[], Situation]) -> None:
        """Change the situation if that is possible, and calculate it coarsely."""
        try:
            self._change(changed())
        except ValueError as error:
            self._refuse(error)
        else:
            self._show_situation()
            if self._state.settled == self._settled:  # else the fine calculation follows at once
                self._ask(fine=False)

    def _let_go(self) -> None:
        """Calculate finely, if a slider was let go or a number entered."""
        if self._state.settled != self._settled:
            self._settled = self._state.settled
            self.settle()

    def _change(self, situation: Situation) -> None:
        self._history.change(situation)
        self._state.message = ""

    def _refuse(self, error: Exception) -> None:
        """Say why something cannot be, and set the page back."""
        self._show_situation()
        self._state.message = str(error)

    def _entered(self, names: tuple[str, ...], shown: tuple[float, ...]) -> tuple[float, ...] | None:
        """Return numbers of the page, or None where they are those shown; what is no number is set back."""
        given = tuple(self._state[name] for name in names)
        if given == shown:
            return None
        if not all(type(one) in (int, float) and math.isfinite(one) for one in given):  # bool is an int
            self._show_situation()
            return None
        return tuple(map(float, given))

    def _chosen(self, name: str, count: int) -> int:
        """Return the index that a list of the page has chosen."""
        value = self._state[name]
        is_index = isinstance(value, int) and 0 <= value < count
        return int(value) if is_index else 0

    # What the page shows

    def _body_values(self, index: int) -> tuple[float, ...]:
        body = self.now.bodies[index]
        return (*map(in_mm, body.center), *(in_degrees(one) for one in body.angles))

    def _focus_values(self, index: int) -> tuple[float, ...]:
        return tuple(map(in_mm, self.now.scene.control_points[index].tolist()))

    def _drive_values(self, index: int) -> tuple[float, float]:
        one = self.now.drive[index : index + 1]
        return round(math.degrees(float(phases_of(one))), 2), round(float(amplitudes_of(one)), 4)

    def _show_situation(self) -> None:
        """Set the numbers of the page, and move what is in the picture."""
        state, now = self._state, self.now
        points = now.scene.control_points
        focus = self._chosen("focus", len(points))
        with state:
            if now.bodies:
                index = self._chosen("body", len(now.bodies))
                self._set((*_PLACE, *_TURN), self._body_values(index))
                body = now.bodies[index]
                state.update({"body_moves": body.moves, "body_turns": body.turns})
            self._set(_FOCUS, self._focus_values(focus))
            self._set(("phase", "amplitude"), self._drive_values(self._chosen("transducer", len(now.drive))))
            low, high = now.heights
            state.update(
                {
                    "foci": [(index, str(index)) for index in range(len(points))], "focus": focus,
                    "plane": now.plane, "height": in_mm(now.height),
                    "range_height": [in_mm(low), in_mm(high)],
                    "can_undo": self._history.can_undo, "can_redo": self._history.can_redo,
                }
            )  # fmt: skip
        self.picture.place(now, focus)
        self._note(now)

    def _show_choice(self) -> None:
        """Show what is chosen in the lists of the page."""
        self._show_situation()
        self.update()

    def _set(self, names: tuple[str, ...], values: tuple[float, ...]) -> None:
        self._state.update(dict(zip(names, values, strict=True)))

    def _ask(self, fine: bool = True, method: str | None = None) -> None:
        """Ask for the field of the situation, and show the picture with it, or without if that takes long."""
        self.picture.smooth(fine)
        self._waiting.cancel()
        self._waiting = asyncio.get_running_loop().call_later(_PATIENCE, self.update)
        self._number += 1
        self._running = method is not None
        self._calculator.ask(
            Request(
                self._number, self.now, fine,
                follow=bool(self._state.follow) and method is None,
                volume=bool(self._state.volume) and fine,
                method=None if method is None else OFFERED[method],
            )
        )  # fmt: skip
        with self._state:
            self._state.update({"wanted": self._number, "busy": self._running})

    def _receive(self, found: Result | Progress | Exception) -> None:
        """Show what was calculated."""
        state = self._state
        with state:
            if isinstance(found, Exception):
                state.update({"message": str(found), "status": "", "busy": False})
            elif isinstance(found, Progress):
                if self._running:
                    text = f"{found.label}: {found.evaluations} of at most {found.most} evaluations"
                    state.progress = 100 * found.evaluations / max(found.most, 1)
                    state.status = f"{text}, weakest focus {found.score:.3g} Pa"
            else:
                self._take(found)

    def _take(self, result: Result) -> None:
        request = result.request
        if request.number == self._number and not torch.equal(result.drive, self.now.drive):
            if request.method is not None:
                self._change(self.now.with_drive(result.drive))
                self._history.settle()
                if request.number == 1:
                    self._history = History(self.now)
                self._reference = None
            else:
                self._history.now = self.now.with_drive(result.drive)
            self._show_situation()
        if request.number == self._number:
            self._running = self._state.busy = False
        self._result = result
        self._show_field()
        what = "calculated" if request.fine else "coarse, calculated"
        self._state.status = f"{what} in {result.seconds:.2g} s"

    def _show_field(self) -> None:
        """Colour the plane, and set the readings."""
        if (result := self._result) is None:
            return
        self._waiting.cancel()
        magnitude = np.abs(result.field)
        reference = self._reference or largest(magnitude) or 1.0
        if result.request.number == self._number:
            self._reference = reference
        scale = Scale(reference, self._state.unit != "Pa")
        situation = result.request.situation
        self.picture.show_field(situation.sheet, magnitude, scale)
        self.picture.show_volume(result.volume, scale, self._surface())
        low, high = scale.limits
        zero = f"0 dB = {reference:.3g} Pa"
        with self._state:
            self._state.update(
                {
                    "rows": rows(result, reference), "summary": summary(result),
                    "reference": four_digits(reference), "shown": result.request.number,
                    "scale_low": f"{low:.3g} {'dB' if scale.decibels else 'Pa'}",
                    "scale_high": zero if scale.decibels else f"{high:.3g} Pa",
                }
            )  # fmt: skip
        self.update()

    def _surface(self) -> float:
        """Return the level of the surface in the volume [dB] that the page asks for."""
        height = self._state.surface
        is_level = isinstance(height, int | float) and -60.0 <= height <= 0.0
        return float(height) if is_level else FIRST_SURFACE
