"""The display of a live view: numbers and texts of its page, and its picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from autdtorch.plot.explore.calculation import Result
from autdtorch.plot.explore.history import History
from autdtorch.plot.explore.page import FIRST_SURFACE, scene_state
from autdtorch.plot.explore.picture import Picture, Scale
from autdtorch.plot.explore.readings import four_digits, in_degrees, in_mm, rows, summary
from autdtorch.plot.explore.situation import Situation
from autdtorch.scene.drive import amplitudes_of, phases_of

PLACE, TURN = ("body_x", "body_y", "body_z"), ("turn_x", "turn_y", "turn_z")
"""Names of a body's place [mm] and angles [degrees] in the state of the page."""
FOCUS = ("focus_x", "focus_y", "focus_z")
"""Names of a focus's place [mm] there."""


class Display:
    """The state of the page and the picture.

    Attributes:
        picture: the picture.
        update: sends the picture, once there is a page.
        result: the newest; None until there is one.
        surface: level of the surface in the volume [dB].
        silent: phases [degrees] of transducers with amplitude 0, by index; their drives have none.
    """

    def __init__(self, state: Any, situation: Situation) -> None:
        """Draw a situation; `state` is trame's."""
        self._state = state
        self.picture = Picture(situation)
        self.update: Callable[[], None] = lambda: None
        self.surface = FIRST_SURFACE
        self.silent: dict[int, float] = {}
        self.result: Result | None = None

    def chosen(self, name: str, count: int) -> int:
        """Return the index that a list of the page has chosen."""
        value = self._state[name]
        is_index = isinstance(value, int) and 0 <= value < count
        return int(value) if is_index else 0

    def body_values(self, now: Situation, index: int) -> tuple[float, ...]:
        """Return place [mm] and angles [degrees] of a body, as the page has them."""
        body = now.bodies[index]
        return (*map(in_mm, body.center), *map(in_degrees, body.angles))

    def focus_values(self, now: Situation, index: int) -> tuple[float, ...]:
        """Return the place of a focus [mm], as the page has it."""
        return tuple(map(in_mm, now.scene.control_points[index].tolist()))

    def drive_values(self, now: Situation, index: int) -> tuple[float, float]:
        """Return phase [degrees] and amplitude of a transducer, as the page has them."""
        one = now.drive[index : index + 1]
        phase, amplitude = math.degrees(float(phases_of(one))), float(amplitudes_of(one))
        return round(phase if amplitude else self.silent.get(index, 0.0), 2), round(amplitude, 4)

    def place(self, history: History) -> None:
        """Set the numbers of the page to the situation now, and move what is in the picture."""
        state, now = self._state, history.now
        if not self.picture.shows(now):
            self.picture.draw(now)
            self.silent.clear()
            with state:
                state.update(scene_state(now))
        points = now.scene.control_points
        focus = self.chosen("focus", len(points))
        with state:
            if now.bodies:
                index = self.chosen("body", len(now.bodies))
                self._set((*PLACE, *TURN), self.body_values(now, index))
                body = now.bodies[index]
                state.update({"body_moves": body.moves, "body_turns": body.turns})
            self._set(FOCUS, self.focus_values(now, focus))
            transducer = self.chosen("transducer", len(now.drive))
            self._set(("phase", "amplitude"), self.drive_values(now, transducer))
            low, high = now.heights
            state.update(
                {
                    "transducer": transducer,
                    "foci": [(index, str(index)) for index in range(len(points))], "focus": focus,
                    "plane": now.plane, "height": in_mm(now.height),
                    "range_height": [in_mm(low), in_mm(high)],
                    "can_undo": history.can_undo, "can_redo": history.can_redo,
                }
            )  # fmt: skip
        self.picture.place(now, focus, transducer)

    def redraw(self, result: Result, reference: float) -> None:
        """Colour the plane, draw the surface, and set the readings; `reference` [Pa] is the brightest."""
        magnitude = np.abs(result.field)
        scale = Scale(reference, self._state.unit != "Pa")
        self.picture.show_field(result.request.situation.sheet, magnitude, scale)
        low, _ = scale.limits
        brightest = f"{float(f'{reference:.3g}'):g} Pa"  # 1180, not 1.18e+03
        with self._state:
            if not self.picture.show_volume(result.volume, scale, self.surface):
                self._state.message = f"No surface: around the foci all is below {self.surface:g} dB."
            self._state.update(
                {
                    "rows": rows(result, reference), "summary": summary(result),
                    "reference": four_digits(reference), "surface": self.surface,
                    "shown": result.request.number,
                    "scale_low": f"{low:.3g} {'dB' if scale.decibels else 'Pa'}",
                    "scale_high": f"0 dB = {brightest}" if scale.decibels else brightest,
                }
            )  # fmt: skip
        self.update()

    def _set(self, names: tuple[str, ...], values: tuple[float, ...]) -> None:
        self._state.update(dict(zip(names, values, strict=True)))
