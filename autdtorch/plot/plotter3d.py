"""The plotter of a 3D view: window, camera, axes, colour bars and texts."""

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
_STILL_LETTERS, _BESIDE_BARS = 30, 23  # pixels; pictures without colour bars are shown smaller, as in reports
_MARGIN = 12  # pixels
_GREY = "#909090"
_FROM_FILE = 4  # VTK_FONT_FILE

_WINDOW = (1200, 860)  # pixels

# Size of tick labels and axis titles: VTK's default, and one for a picture at half size
_LETTERS = 10.0, 16.0
_SHORT = 0.5  # of the longest side of the domain; on a shorter one, large labels would overlap
_TITLES = 30.0  # distance of the axis titles from the tick labels, VTK's 20 by default

FIELD_BAR = 0.9  # left edge of the colour bar, as a share of the window
_CAPTION = (0.85, 0.15)  # lower left corner, as shares of the window
CAMERA = (-0.75, -1.0, 0.5)  # from the centre towards the camera

_BAR = {"vertical": True, "position_y": 0.25, "width": 0.05, "height": 0.5, "color": "black"}
_BAR |= {"title_font_size": 20, "label_font_size": 18, "unconstrained_font_size": True}


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

    letters = _BESIDE_BARS if any(margins) else _STILL_LETTERS
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


def empty_plotter(domain: tuple[Vector, Vector], off_screen: bool) -> pyvista.Plotter:
    """Return a plotter with axes around a domain [m] and the camera."""
    import pyvista

    with pyvista.vtk_verbosity("error"):  # VTK warns of a missing X server, which it does not need
        plotter = pyvista.Plotter(off_screen=off_screen, window_size=list(_WINDOW))
    plotter.set_background("white")
    add_axes(plotter, domain)
    look_at(plotter, domain)
    return plotter


def look_at(plotter: pyvista.Plotter, domain: tuple[Vector, Vector]) -> None:
    """Set the camera, so that it shows a whole domain [m]."""
    plotter.view_vector(CAMERA, viewup=(0.0, 0.0, 1.0))
    plotter.enable_parallel_projection()
    plotter.reset_camera(bounds=_bounds(domain))
    plotter.camera.zoom(1.05)


def add_axes(
    plotter: pyvista.Plotter, domain: tuple[Vector, Vector], ink: str = "black", letters: float | None = None
) -> None:
    """Draw axes around a domain [m], in place of the present ones.

    The size of letters is in VTK's screen units; the default suits a picture shown at half its size.
    """
    plotter.remove_bounds_axes()
    titles = {f"{name}title": f"{name} [mm]" for name in "xyz"}
    style = {"grid": "back", "location": "outer", "fmt": "%.0f", "color": ink, "font_size": 15}
    axes = plotter.show_bounds(bounds=_bounds(domain), **titles, **style)
    for axis in range(3):
        axes.SetAxisLabels(axis, None)  # PyVista's are not round numbers, VTK's are
    axes.GetLabelTextProperty(2).SetOrientation(90.0)  # upright
    lower, upper = domain
    sides = np.subtract(upper, lower)
    axes.SetScreenSize(letters or _LETTERS[int(min(sides) >= _SHORT * max(sides))])
    axes.SetTitleOffset([_TITLES, _TITLES])


def _bounds(domain: tuple[Vector, Vector]) -> list[float]:
    lower, upper = domain
    return [MM * corner[axis] for axis in range(3) for corner in (lower, upper)]


def add_bar(
    plotter: pyvista.Plotter, mesh: pyvista.Actor, title: str, *, position: float, labels: int, fmt: str
) -> None:
    """Draw the colour bar of a mesh; `position` is its left edge, as a share of the window."""
    title += "\n"  # VTK sets the title tight against the bar
    bar = plotter.add_scalar_bar(
        title, mapper=mesh.mapper, n_labels=labels, fmt=fmt, position_x=position, **_BAR
    )
    use_font(bar.GetTitleTextProperty(), bar.GetLabelTextProperty())


def add_caption(plotter: pyvista.Plotter, *lines: str) -> None:
    """Write lines below the colour bar of the field."""
    text = plotter.add_text("\n".join(lines), position=_CAPTION, viewport=True, font_size=10, color="black")
    use_font(text.prop)
