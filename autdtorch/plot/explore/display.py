"""The display of a live view: numbers and texts in the state of its page, and its picture."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from autdtorch.methods.base import Method
from autdtorch.methods.catalogue import METHODS, VARIANTS, label_of
from autdtorch.plot import colours
from autdtorch.plot.data import MM, in_decibels
from autdtorch.plot.explore.calculation import Result
from autdtorch.plot.explore.rendering import Rendering, Scale
from autdtorch.plot.explore.situation import SCENE_PLANE, History, Situation, devices_of, free_folder
from autdtorch.plot.meshes3d import map_colours
from autdtorch.scene.drive import amplitudes_of, phases_of
from autdtorch.utils.array_types import Array
from autdtorch.utils.text import decimals_of, in_percent
from autdtorch.utils.units import prefixed

POSITION, ANGLES = ("body_x", "body_y", "body_z"), ("turn_x", "turn_y", "turn_z")
"""Names of a body's position [mm] and angles [degrees] in the state of the page."""
FOCUS = ("focus_x", "focus_y", "focus_z")
"""Names of a focus's position [mm] in the state of the page."""

_COLUMNS = "focus", "x [mm]", "y [mm]", "z [mm]", "|p| [Pa]", "level [dB]"
_FIRST_SURFACE = -6.0  # level of the isosurface in the volume [dB]


class Display:
    """The state of the page and the picture.

    Attributes:
        picture: the picture.
        update: sends the picture, once there is a page.
        result: the newest; None until there is one.
        surface: level of the isosurface in the volume [dB].
        silent: phases [degrees] of transducers with amplitude 0, by index; their drives have none.
    """

    def __init__(self, state: Any, situation: Situation) -> None:
        """Draw a situation; `state` is trame's."""
        self._state = state
        self.picture = Rendering(situation)
        self.update: Callable[[], None] = lambda: None
        self.surface = _FIRST_SURFACE
        self.silent: dict[int, float] = {}
        self.result: Result | None = None

    def chosen(self, name: str, count: int) -> int:
        """Return the index that is chosen in a list of the page."""
        value = self._state[name]
        is_index = isinstance(value, int) and 0 <= value < count
        return int(value) if is_index else 0

    def body_values(self, now: Situation, index: int) -> tuple[float, ...]:
        """Return position [mm] and angles [degrees] of a body, as the page has them."""
        body = now.bodies[index]
        return (*map(in_mm, body.center), *(round(math.degrees(angle), 6) + 0.0 for angle in body.angles))

    def focus_values(self, now: Situation, index: int) -> tuple[float, ...]:
        """Return the position of a focus [mm], as the page has it."""
        return tuple(map(in_mm, now.scene.control_points[index].tolist()))

    def drive_values(self, now: Situation, index: int) -> tuple[float, float]:
        """Return phase [degrees] and amplitude of a transducer, as the page has them."""
        drive = now.drive[index : index + 1]
        phase, amplitude = math.degrees(float(phases_of(drive))), float(amplitudes_of(drive))
        return round(phase if amplitude else self.silent.get(index, 0.0), 2), round(amplitude, 4)

    def place(self, history: History) -> None:
        """Set the numbers of the page to the present situation, and move the objects in the picture."""
        state, now = self._state, history.now
        if not self.picture.shows(now):
            self.picture.draw(now)
            self.silent.clear()
            with state:
                state.update(_scene_state(now))
        points = now.scene.control_points
        focus = self.chosen("focus", len(points))
        with state:
            if now.bodies:
                index = self.chosen("body", len(now.bodies))
                self._set((*POSITION, *ANGLES), self.body_values(now, index))
                body = now.bodies[index]
                state.update({"body_moves": body.moves, "body_turns": body.turns})
            self._set(FOCUS, self.focus_values(now, focus))
            transducer = self.chosen("transducer", len(now.drive))
            self._set(("phase", "amplitude"), self.drive_values(now, transducer))
            state.update(
                {
                    "transducer": transducer,
                    "foci": [(index, str(index)) for index in range(len(points))], "focus": focus,
                    "plane": now.plane, "height": in_mm(now.height),
                    "range_height": [in_mm(end) for end in now.heights],
                    "can_undo": history.can_undo, "can_redo": history.can_redo,
                }
            )  # fmt: skip
        self.picture.place(now, focus, transducer)
        self._show_force(now)

    def redraw(self, result: Result, reference: float) -> None:
        """Colour the plane, draw the isosurface, and set the readings; `reference` [Pa] is the brightest."""
        scale = Scale(reference, self._state.unit != "Pa")
        self.picture.show_field(result.request.situation.sheet, np.abs(result.field), scale)
        low, _ = scale.limits
        brightest = f"{float(f'{reference:.3g}'):g} Pa"  # 1180, not 1.18e+03
        with self._state:
            if not self.picture.show_volume(result.volume, scale, self.surface):
                self._state.message = f"No surface: around the foci all is below {self.surface:g} dB."
            self._state.update(
                {
                    "rows": _rows(result, reference), "summary": _summary(result),
                    "reference": four_digits(reference), "surface": self.surface,
                    "shown": result.request.number,
                    "scale_low": f"{low:.3g} {'dB' if scale.decibels else 'Pa'}",
                    "scale_high": f"0 dB = {brightest}" if scale.decibels else brightest,
                }
            )  # fmt: skip
        self._show_force(result.request.situation)
        self.update()

    def _show_force(self, now: Situation) -> None:
        """Show the force on the chosen obstacle, if it is known in this situation."""
        forces = None
        if self.result is not None and self.result.request.situation.scene is now.scene:
            forces = self.result.forces
        body = self.chosen("body", len(now.bodies))
        force = None if forces is None or not forces[body].norm() > 0 else forces[body].numpy()
        self.picture.show_force(body, force)
        with self._state:
            self._state.force = "" if force is None else _force_text(force, now.bodies[body].weight)

    def _set(self, names: Sequence[str], values: Sequence[float]) -> None:
        self._state.update(dict(zip(names, values, strict=True)))


def first_state(situation: Situation, methods: dict[str, Method]) -> dict[str, Any]:
    """Return the first state of the page, without the values that `Display.place` sets."""
    return _scene_state(situation) | {
        "message": "", "status": "", "summary": "", "force": "", "saved": "", "python": "", "rows": [],
        "columns": _COLUMNS, "methods": _choices(methods), "method": "gradient_ascent", "follow": False,
        "busy": False, "progress": 0,
        "units": [("dB", "dB"), ("Pa", "Pa")], "unit": "dB", "reference": 1.0,
        "volume": False, "surface": _FIRST_SURFACE, "dark": False, "scale_low": "", "scale_high": "",
        "scale_style": _gradient(colours.PRESSURE_MAP), "phase_style": _gradient(colours.PHASE_MAP),
        "folder": free_folder(), "camera": "", "camera_text": "", "shown": -1, "wanted": 0, "settled": 0,
    }  # fmt: skip


def _scene_state(situation: Situation) -> dict[str, Any]:
    """Return the part of the state that stays while obstacles and foci move."""
    scene = situation.scene
    bodies = [(index, f"{index}: {body.name}") for index, body in enumerate(situation.bodies)]
    devices = [("", "no device"), *((name, name) for name in devices_of(situation))]
    planes = [(name, "as in the scene" if name == SCENE_PLANE else name) for name in situation.planes]
    ranges = {
        f"range_{axis}": [in_mm(low), in_mm(high)]
        for axis, low, high in zip("xyz", *scene.domain, strict=True)
    }
    return ranges | {
        "trame__title": f"autdtorch explore: {scene.name}", "name": scene.name,
        "bodies": bodies, "body": 0, "body_moves": False, "body_turns": False,
        "focus": 0, "transducers": len(scene.array), "transducer": 0,
        "planes": planes, "devices": devices, "device": "",
    }  # fmt: skip


def in_mm(length: float) -> float:
    """Return a length [m] in mm, without rounding errors."""
    return round(MM * length, 4) + 0.0


def four_digits(value: float) -> float:
    """Return a number rounded to four digits."""
    return float(f"{value:.4g}")


def refusal(error: Exception) -> str:
    """Return the message of an error with the names and units of the page."""
    text = str(error) or repr(error)
    for field, name in (("control_points", "focus"), ("obstacles", "obstacle"), ("reflectors", "reflector")):
        text = re.sub(rf"Scene\.{field}\[(\d+)\]:?", rf"{name} \1:", text)
    text = re.sub(r"\(([^()]*)\) to (?=\([^()]*\) m\b)", lambda corner: f"{_point_in_mm(corner)} to ", text)
    return re.sub(r"\(([^()]*)\) m\b", _point_in_mm, text)


def _point_in_mm(match: re.Match[str]) -> str:
    try:
        point = [float(number) for number in match[1].split(",")]
    except ValueError:
        return match[0]
    return f"({', '.join(f'{in_mm(number):.1f}' for number in point)}) mm"


def _force_text(force: Array, weight: float | None) -> str:
    """Return the force (3,) [N] on an obstacle, and its weight [N] if it is known."""
    size = float(np.linalg.norm(force))
    factor, unit = prefixed(size, "N")
    decimals = decimals_of([factor * size])
    parts = ", ".join(f"{round(factor * part, decimals) + 0.0:.{decimals}f}" for part in force.tolist())
    text = f"Force of the sound {factor * size:.{decimals}f} {unit}: ({parts}) {unit}"
    if weight is None:
        return f"{text}."
    factor, unit = prefixed(weight, "N")
    return f"{text}. Weight {_three_digits(factor * weight)} {unit}."


def _rows(result: Result, reference: float) -> list[list[str]]:
    """Return the rows of the table of foci; levels are relative to a reference [Pa]."""
    points = result.request.situation.scene.control_points
    levels = in_decibels(result.pressure.numpy(), reference)
    foci = zip(points.tolist(), result.pressure.tolist(), levels.tolist(), strict=True)
    return [
        [str(index), *(f"{MM * number:.1f}" for number in point), _three_digits(pressure), f"{level:.1f}"]
        for index, (point, pressure, level) in enumerate(foci)
    ]


def _summary(result: Result) -> str:
    weakest = float(result.pressure.min())
    text = f"Weakest focus {_three_digits(weakest)} Pa"
    if result.bound:  # 0 where no sound reaches a focus, as in a hollow body
        share, most = in_percent(weakest / result.bound), _three_digits(result.bound)
        text += f", {share} % of what any drive can reach ({most} Pa)"
    if result.spacing is None and not result.error:
        return f"{text}. In closed form, without cells."
    cells = "without cells" if result.spacing is None else f"cells of {MM * result.spacing:.3g} mm"
    if result.error is None:
        return f"{text}. {'Fine' if result.request.fine else 'Coarse'}, {cells}."
    return f"{text}. Estimated error {100 * result.error:.2g} %, {cells}."


def _three_digits(value: float) -> str:
    """Return a number with three digits; `g` alone leaves out zeros at the end."""
    return f"{value:#.3g}".rstrip(".")


def _gradient(name: str) -> str:
    """Return a colour map, from its lower end on, as the background of a legend."""
    return f"background: linear-gradient(to right, {', '.join(map_colours(name, 9))})"


def offered() -> dict[str, Method]:
    """Return the methods that a live view offers, by name: holography by its algorithms."""
    return {name: kind() for name, kind in METHODS.items() if name != "holography"} | VARIANTS


def _choices(methods: dict[str, Method]) -> list[tuple[str, str]]:
    """Return names and labels, those first that need least time."""
    first = ("gradient_ascent", "identify", "gabs")
    return [(name, label_of(name)) for name in sorted(methods, key=lambda name: name not in first)]
