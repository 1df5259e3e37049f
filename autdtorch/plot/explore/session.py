"""The session of a live view: it asks for calculations of its situation and shows their results.

All methods are called in the thread of the server, which also renders.
"""

from __future__ import annotations

import asyncio
import itertools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from autdtorch.plot.data import largest
from autdtorch.plot.explore.calculation import Calculator, Finished, Report, Request, Result
from autdtorch.plot.explore.display import Display, offered, refusal
from autdtorch.plot.explore.rendering import Grip
from autdtorch.plot.explore.situation import (
    History,
    Situation,
    in_phase,
    python_of,
    same_array,
    save_situation,
)
from autdtorch.plot.explore.trial_pictures import TrialPictures
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array

_PATIENCE = 0.25  # s; a picture before the field would slow its calculation down
_LOOK = 0.5  # s between looks for a new picture of a trial
_NEW_FOCUS = 1.5  # wavelengths beside the last focus
_FOLLOWING = "follow"
FIRST_METHOD = "gradient_ascent"
"""The method that finds the first drive."""


class Session:
    """The situation that page, mouse and calculations share.

    A search for a drive is part of every fine calculation until it has ended: a move of an obstacle begins it
    again, for the new scene. A change of the view alone waits for its end.

    Attributes:
        display: page and picture.
        methods: the methods that the page offers, by name.
        grip: the hold of the mouse on a body or a focus, while it drags one.
        ready: set while nothing is calculated; threads may wait for it.
        failure: the error that ended the last calculation, if any.
    """

    def __init__(
        self,
        trame: Any,
        situation: Situation,
        spacing: float,
        defer: Callable[..., None],
        pictures: TrialPictures | None,
    ) -> None:
        """Begin with a situation; cells have a `spacing` [m] when nothing is dragged.

        `defer` queues a call of a function in this thread. The `pictures` of a trial, if any, are followed.
        """
        self._state = trame.state
        self._history = History(situation)
        self.display = Display(trame.state, situation)
        self.methods = offered()
        self._calculator = Calculator(spacing, lambda report: defer(self._receive, report))
        self.grip: Grip | None = None
        self._numbers, self._seeds = itertools.count(1), itertools.count()
        self._request = Request(0, situation)  # the newest
        self._search: str | None = None  # a method, or to follow the obstacles
        self._seed = 0
        self._running = False  # a method
        self._view_waits = False  # for the end of the method
        self._cancelled = ""  # a text about a cancelled method
        self._saved: set[str] = set()
        self._closed = False
        self.ready = threading.Event()
        self.failure: Exception | None = None
        self._waiting = asyncio.get_running_loop().call_later(_PATIENCE, self.display.update)
        self._pictures = pictures

    @property
    def now(self) -> Situation:
        """The situation that is shown."""
        return self._history.now

    def begin(self, method: str | None) -> None:
        """Show the first situation; run a method first, if any."""
        self._search = method
        self.place()
        self._ask()
        if self._pictures is not None:
            self._look_for_pictures(self._pictures)

    def place(self) -> None:
        """Show the situation in the page and the picture, as yet without its field."""
        self.display.place(self._history)

    def close(self) -> None:
        """End calculations; later results are not shown."""
        self._closed = True
        self._waiting.cancel()
        self._calculator.close()

    # Changes of the situation

    def attempt(self, changed: Callable[[], Situation], moving: bool = True) -> None:
        """Change the situation if that is possible; calculate it coarsely while something is `moving`."""
        try:
            self._change(changed())
        except ValueError as error:
            self.refuse(error)
        else:
            self._state.message = ""
            self.place()
            if moving:
                self._ask(fine=False)

    def settle(self) -> None:
        """Calculate a change finely, if there is one: the mouse or a slider was let go."""
        if self._history.settle():
            self._show()

    def refuse(self, error: Exception) -> None:
        """Show why a change is not possible, and set the page back."""
        self.place()
        self._state.message = f"Not possible: {refusal(error)}"

    def drag(self, grip: Grip, place: Array) -> None:
        """Move a body or a focus so that its grip is at a place (3,) [m]."""
        self.attempt(lambda: grip.dragged(self.now, place))

    def turn(self, grip: Grip, angle: float) -> None:
        """Turn a body about the vertical by an angle [rad] from its angles when it was gripped."""
        if grip.kind == "body":
            self.attempt(lambda: grip.turned(self.now, angle))

    def choose(self, grip: Grip) -> None:
        """Choose the gripped object in the lists of the page."""
        with self._state:
            self._state[grip.kind] = grip.number

    # Changes by the program

    def show(self, scene: Scene) -> None:
        """Show another scene, as a step. A search continues there; another array begins one."""
        self.grip = None
        before = self.now
        self._history.step(before.with_scene(scene))
        if not same_array(scene.array, before.scene.array):
            self._end_search()
            self._search = FIRST_METHOD
        elif self._state.follow:
            self._search = self._search or _FOLLOWING
        self._show()

    def play(self, drive: torch.Tensor) -> None:
        """Show the field of a drive (M,), as a step."""
        self._end_search()
        self._history.step(self.now.with_drive(drive))
        self._show()

    def _look_for_pictures(self, pictures: TrialPictures) -> None:
        """Show the field of the newest picture's drive, without a step, unless something is dragged."""
        if self._closed or pictures is not self._pictures:
            return
        try:
            drive = None if self.grip is not None else pictures.look()
            if drive is not None:
                situation = self.now.with_drive(drive)
                self._end_search()
                self._history.amend(situation)
                self._show()
        except (ValueError, OSError) as error:
            with self._state:
                self._state.message = f"Picture of the trial: {refusal(error)}"
        asyncio.get_running_loop().call_later(_LOOK, self._look_for_pictures, pictures)

    # Actions of the page

    def undo(self) -> None:
        """Go a step back."""
        self._go(self._history.undo)

    def redo(self) -> None:
        """Repeat a step."""
        self._go(self._history.redo)

    def add_focus(self) -> None:
        """Add a focus beside the chosen one."""
        scene, sheet = self.now.scene, self.now.sheet
        points = scene.control_points
        chosen, away = self.display.chosen("focus", len(points)), _NEW_FOCUS * scene.wavelength
        for direction in (*sheet.basis, *(-axis for axis in sheet.basis)):
            new = points[chosen] + away * direction
            try:
                self._change(self.now.with_points(torch.cat([points, new[None]])))
            except ValueError as error:
                refusal = error
            else:
                self._state.focus = len(points)
                self.settle()
                return
        self.refuse(refusal)

    def remove_focus(self) -> None:
        """Remove the chosen focus."""
        self.grip = None
        points = self.now.scene.control_points
        if len(points) > 1:
            index = self.display.chosen("focus", len(points))
            self._change(self.now.with_points(torch.cat([points[:index], points[index + 1 :]])))
            self._state.focus = 0
            self.settle()

    def in_phase(self) -> None:
        """Give all transducers phase 0 and amplitude 1."""
        self._change(self.now.with_drive(in_phase(self.now.scene)))
        self.settle()

    def find(self) -> None:
        """Run the chosen method."""
        if (name := str(self._state.method)) in self.methods:
            self._history.settle()
            self._running, self._search, self._seed = False, name, next(self._seeds)
            self._state.update({"progress": 0, "message": ""})
            self._ask()

    def cancel(self) -> None:
        """End the method that runs; the drive stays."""
        self._end_search()
        self._ask()

    def look(self) -> None:
        """Calculate the field again, for an option of the page."""
        self._ask()

    def rescale(self, reference: float | None = None) -> None:
        """Take a pressure [Pa] as the brightest colour, by default the largest, as a step."""
        self._history.step(self.now.with_reference(reference))
        self.place()
        self.redraw()

    def write_python(self) -> None:
        """Write scene and drive as Python."""
        try:
            self._state.python = python_of(self.now, str(self._state.folder))
        except ValueError as error:
            self.refuse(error)

    def save(self) -> None:
        """Write scene and drive to files."""
        folder = str(self._state.folder)
        try:
            path = save_situation(self.now, folder, str(self._state.device), folder in self._saved)
        except (ValueError, OSError) as error:
            self._state.update({"saved": "", "message": str(error)})
        else:
            self._saved.add(folder)
            self._state.update({"saved": f"saved in {path}", "message": ""})

    # Calculations

    def _change(self, situation: Situation) -> None:
        """Show another situation. A new drive ends a search; a new scene begins one if phases follow."""
        before = self.now
        self._history.change(situation)
        if situation.drive is not before.drive:
            self._end_search()
        elif situation.scene is not before.scene and self._state.follow:
            self._search = self._search or _FOLLOWING

    def _end_search(self) -> None:
        if self._running:
            self._cancelled = f"{self.methods[str(self._search)].label} cancelled, "
        self._search, self._running, self._view_waits = None, False, False

    def _go(self, along_history: Callable[[], None]) -> None:
        """Show another step, which ends a search."""
        self.grip = None
        self._end_search()
        along_history()
        self._show()

    def _show(self) -> None:
        self.place()
        self._ask()

    def redraw(self) -> None:
        """Draw the field; the first field decides the colours."""
        if (result := self.display.result) is not None:
            reference = self.now.reference or largest(np.abs(result.field)) or 1.0
            self._history.amend(self.now.with_reference(reference))  # first, as the page sends it back
            self.display.redraw(result, reference)
            if self._pictures is not None and result.request.fine:
                with self._state:
                    self._state.update(self._pictures.state(result))

    def _ask(self, fine: bool = True) -> None:
        """Ask for the field of the situation, and show the picture with it or, if it takes long, without."""
        self.display.picture.smooth(fine)
        self.ready.clear()
        self._waiting.cancel()
        self._waiting = asyncio.get_running_loop().call_later(_PATIENCE, self._show_wait, fine)
        if self._running and self.now.scene is self._request.situation.scene:
            self._view_waits = True
            return
        method = self.methods.get(self._search or "") if fine else None
        self._running = method is not None
        self.failure = None
        self._request = Request(
            next(self._numbers), self.now, fine,
            follow=self._search == _FOLLOWING,
            volume=bool(self._state.volume) and fine,
            method=method, seed=self._seed,
        )  # fmt: skip
        self._calculator.ask(self._request)
        with self._state:
            self._state.update({"wanted": self._request.number, "busy": self._running})
            if fine and self._state.python:
                self.write_python()

    def _show_wait(self, fine: bool) -> None:
        if fine and not self._running:
            with self._state:
                self._state.status = f"{self._cancelled}calculating ..."
        self.display.update()

    def _receive(self, report: Report) -> None:
        """Show a result, or the progress of a method."""
        if self._closed:
            return
        is_newest = report.request.number == self._request.number
        with self._state:
            if isinstance(report, Result):
                self._take(report, is_newest)
            elif not is_newest:
                return
            elif isinstance(report, Finished):
                if report.error is not None:
                    self._fail(report.error)
                if report.request is self._request:  # else a change of the view waited for its end
                    self.ready.set()
            elif self._running:
                text = f"{report.label}: {report.evaluations} of at most {report.most} evaluations"
                self._state.progress = 100 * report.evaluations / max(report.most, 1)
                self._state.status = f"{text}, weakest focus {report.score:.3g} Pa"

    def _take(self, result: Result, is_newest: bool) -> None:
        request = result.request
        if not is_newest and not self.display.picture.shows(request.situation):
            return
        if is_newest:
            if not torch.equal(result.drive, self.now.drive):
                self._take_drive(result)
            if request.fine:
                self._search = None
            self._running = self._state.busy = False
        self._waiting.cancel()
        self.display.result = result
        self.redraw()
        coarse = "" if request.fine else "coarse, "
        self._state.status = f"{self._cancelled}{coarse}calculated in {result.seconds:.2g} s"
        self._cancelled = "" if request.fine else self._cancelled
        if is_newest:
            self._ask_waiting()

    def _fail(self, error: Exception) -> None:
        """Show the error that ended the newest request."""
        self._search, self._running = None, False
        message = {"message": refusal(error), "status": "", "busy": False, "shown": self._request.number}
        self._state.update(message)
        self._ask_waiting()
        self.failure = error

    def _ask_waiting(self) -> None:
        """Ask for a change of the view that waited for the end of a method."""
        if self._view_waits:
            self._view_waits = False
            self._ask()

    def _take_drive(self, result: Result) -> None:
        """Take the drive of a search: a new step, or a part of the move that it follows."""
        situation, is_first = self.now.with_drive(result.drive), result.request.number == 1
        if result.request.method is not None:
            situation = situation.with_reference(None)
        if result.request.method is not None and not is_first:
            self._history.step(situation)
        else:
            self._history.amend(situation)
        self.place()
