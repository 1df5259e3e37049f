"""The numbers of a live view, as its page shows them."""

from __future__ import annotations

import math

from autdtorch.plot.data import in_decibels
from autdtorch.plot.explore.calculation import Result

MM = 1e-3
COLUMNS = "focus", "x [mm]", "y [mm]", "z [mm]", "|p| [Pa]", "level [dB]"


def in_mm(length: float) -> float:
    """Return a length [m] in mm, without rounding errors."""
    return round(length / MM, 4) + 0.0


def in_degrees(angle: float) -> float:
    """Return an angle [rad] in degrees, without rounding errors."""
    return round(math.degrees(angle), 6) + 0.0


def four_digits(value: float) -> float:
    """Return a number rounded to four digits."""
    return float(f"{value:.4g}")


def rows(result: Result, reference: float) -> list[list[str]]:
    """Return the lines of the table of foci; levels are relative to a reference [Pa]."""
    points = result.request.situation.scene.control_points
    levels = in_decibels(result.pressure.numpy(), reference)
    each = zip(points.tolist(), result.pressure.tolist(), levels.tolist(), strict=True)
    return [
        [str(index), *(f"{one / MM:.1f}" for one in point), f"{pressure:.3g}", f"{level:.1f}"]
        for index, (point, pressure, level) in enumerate(each)
    ]


def summary(result: Result) -> str:
    """Return the readings as a sentence or two."""
    weakest = float(result.pressure.min())
    text = f"Weakest focus {weakest:.3g} Pa"
    if result.bound is not None:
        text += f", {100 * weakest / result.bound:.0f} % of what any drive can reach ({result.bound:.3g} Pa)"
    if result.spacing is None and not result.error:
        return f"{text}. In closed form, without cells."
    cells = "without cells" if result.spacing is None else f"cells of {result.spacing / MM:.3g} mm"
    if result.error is None:
        return f"{text}. {'Fine' if result.request.fine else 'Coarse'}, {cells}."
    return f"{text}. Estimated error {100 * result.error:.2g} %, {cells}."
