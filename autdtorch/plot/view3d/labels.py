"""Texts of 3D views: their font, and upright axes of still pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import ImageFont

from autdtorch.plot.data import MM
from autdtorch.utils.validation import Vector

if TYPE_CHECKING:
    import pyvista
    from vtkmodules.vtkRenderingCore import vtkTextProperty

STILL_AXES = "still axes"  # prefix of the names of the actors
_LETTERS, _BESIDE_BARS = 30, 23  # pixels; pictures without colour bars are shown smaller, as in reports
_MARGIN = 12  # pixels
_GREY = "#909090"
_FROM_FILE = 4  # VTK_FONT_FILE


def font_file() -> str:
    """Return the path of the font of 3D views, Matplotlib's: the fonts of VTK have no π."""
    from matplotlib import get_data_path

    return str(Path(get_data_path()) / "fonts/ttf/DejaVuSans.ttf")


def use_font(*properties: vtkTextProperty) -> None:
    """Use the font for texts."""
    for text in properties:
        text.SetFontFamily(_FROM_FILE)
        text.SetFontFile(font_file())


def add_still_axes(
    plotter: pyvista.Plotter,
    domain: tuple[Vector, Vector],
    towards_camera: Vector,
    margins: tuple[float, float],
) -> None:
    """Draw axes around a domain [m] whose labels do not turn with the view, and fit the camera to them.

    `margins` of the window are on the left and on the right [pixels].
    """
    import pyvista
    from vtkmodules.vtkRenderingCore import vtkBillboardTextActor3D

    from autdtorch.plot.axes3d import axes_of, grid_lines, view_from  # with Matplotlib

    letters = _BESIDE_BARS if any(margins) else _LETTERS
    font = ImageFont.truetype(font_file(), letters)
    lower, upper = (MM * np.array(corner) for corner in domain)
    towards = np.array(towards_camera) / np.linalg.norm(towards_camera)
    view = view_from(towards)
    width, height = plotter.window_size
    room = width - sum(margins) - 2 * _MARGIN, height - 2 * _MARGIN
    titles = [f"{name} [mm]" for name in "xyz"]
    axes = axes_of(lower, upper, view, room, lambda text: (font.getlength(text), 0.8 * letters), titles)

    # The middle of box and labels is in the middle of the room.
    off = np.array([(margins[0] - margins[1]) / 2, 0.0]) - (axes.low + axes.high) / 2
    focal = (lower + upper) / 2 - off @ view / axes.scale
    plotter.camera.focal_point = focal
    plotter.camera.position = focal + 2 * np.linalg.norm(upper - lower) * towards
    plotter.camera.up = view[1]
    plotter.camera.parallel_scale = height / 2 / axes.scale
    plotter.camera.is_set = True

    lines = pyvista.line_segments_from_points(grid_lines(lower, upper, axes.ticks).reshape(-1, 3))
    look = {"color": _GREY, "line_width": 1, "lighting": False, "reset_camera": False}
    plotter.add_mesh(lines, name=f"{STILL_AXES}: grid", **look)
    for number, label in enumerate(axes.labels):
        text = vtkBillboardTextActor3D()
        text.SetInput(label.text)
        text.SetPosition(*label.point)
        text.SetDisplayOffset(*np.round(label.corner).astype(int).tolist())
        style = text.GetTextProperty()
        style.SetFontSize(letters)
        style.SetColor(0.0, 0.0, 0.0)
        use_font(style)
        plotter.add_actor(text, name=f"{STILL_AXES}: {number}", reset_camera=False)
