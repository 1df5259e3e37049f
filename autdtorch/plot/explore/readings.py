"""The numbers of a live view, as its page shows them."""

from __future__ import annotations

import math
import re

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
        [str(index), *(f"{one / MM:.1f}" for one in point), _three_digits(pressure), f"{level:.1f}"]
        for index, (point, pressure, level) in enumerate(each)
    ]


def summary(result: Result) -> str:
    """Return the readings as a sentence or two."""
    weakest = float(result.pressure.min())
    text = f"Weakest focus {_three_digits(weakest)} Pa"
    if result.bound is not None:
        share, most = 100 * weakest / result.bound, _three_digits(result.bound)
        text += f", {share:.0f} % of what any drive can reach ({most} Pa)"
    if result.spacing is None and not result.error:
        return f"{text}. In closed form, without cells."
    cells = "without cells" if result.spacing is None else f"cells of {result.spacing / MM:.3g} mm"
    if result.error is None:
        return f"{text}. {'Fine' if result.request.fine else 'Coarse'}, {cells}."
    return f"{text}. Estimated error {100 * result.error:.2g} %, {cells}."


def refusal(error: Exception) -> str:
    """Return why something cannot be, with the names and units of the page."""
    text = str(error) or repr(error)
    for name, own in (("control_points", "focus"), ("obstacles", "obstacle")):
        text = re.sub(rf"Scene\.{name}\[(\d+)\]:?", rf"{own} \1:", text)
    return re.sub(r"\(([^()]*)\) m\b", _place_in_mm, text)


def _place_in_mm(found: re.Match[str]) -> str:
    try:
        place = [float(one) for one in found[1].split(",")]
    except ValueError:
        return found[0]
    return f"({', '.join(f'{in_mm(one):.1f}' for one in place)}) mm"


def _three_digits(value: float) -> str:
    """Return a number with three digits; `g` alone leaves out zeros at the end."""
    return f"{value:#.3g}".rstrip(".")
