"""Animations of the wave over one period."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from autdtorch.plot.colours import WAVE_MAP
from autdtorch.plot.view3d import scene_meshes as meshes
from autdtorch.plot.view3d.export import require_suffix
from autdtorch.plot.view3d.opengl import require_rendering
from autdtorch.plot.view3d.pressure_meshes import add_sheet, plane_mesh, plane_pressure
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import ArrayLike, complex_tensor, integer_at_least, require_kind

if TYPE_CHECKING:
    import pyvista

_FRAME_TIME = 80  # ms; GIF counts hundredths of a second

_GREYS, _SHADES = 24, 8  # of 256 colours: for lines and obstacles, and for control points


def animate3d(
    scene: Scene, drive: ArrayLike, field: ArrayLike, path: str | Path, *, frames: int = 24
) -> None:
    """Write a GIF of the instantaneous pressure Re(p e^{-i w t}) on the observation plane over one period.

    The colours of the transducers are their phases phi + w t. The GIF repeats without a jump.

    Args:
        scene: scene to draw.
        drive: complex (M,).
        field: complex pressure on the observation plane (Nu, Nv) [Pa], at the points of `Plane.points`.
        path: file to write, ``.gif``.
        frames: number of frames in the period, >= 2.

    Raises:
        RuntimeError: this machine cannot render; the message names the cause.
        ValueError: `drive` or `field` does not fit the scene, `field` is a magnitude, `path` has another
            suffix, or `frames` is less than 2.
    """
    require_kind("scene", scene, Scene)
    phases = meshes.emitted_phases(drive, len(scene.array))
    plane, _ = plane_pressure(scene, field)
    pressure = complex_tensor("field", field).detach().cpu().numpy()
    frames = integer_at_least("frames", frames, 2)
    path = require_suffix("path", path, (".gif",))
    require_rendering()
    plotter = meshes.new_plotter(scene, off_screen=True)
    discs = meshes.add_transducers(plotter, scene, phases)
    sheet = plane_mesh(plane, pressure.real)
    limit = _round_up(float(np.abs(pressure).max()))
    actor = add_sheet(plotter, sheet, WAVE_MAP, (-limit, limit))
    meshes.add_bar(plotter, actor, "p(t) [Pa]", position=meshes.FIELD_BAR, labels=5, fmt="%.3g")
    meshes.add_caption(plotter, f"one period: {1e6 / scene.frequency:.3g} µs")
    emitted = discs["phase"].copy()
    pictures = []
    for turn in np.arange(frames) / frames:
        discs["phase"] = (emitted + 2 * turn) % 2
        sheet.copy_from(plane_mesh(plane, (pressure * np.exp(-2j * math.pi * turn)).real))
        plotter.render()
        pictures.append(Image.fromarray(plotter.screenshot(return_img=True)))
    colours = _colours(plotter)
    plotter.close()
    palette = Image.new("P", (1, 1))
    palette.putpalette(colours.tobytes())
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(path, save_all=True, append_images=others, duration=_FRAME_TIME, loop=0)


def _round_up(pressure: float) -> float:
    """Round up to one digit, for round numbers on the colour bar."""
    digit = 10.0 ** math.floor(math.log10(pressure)) if pressure else 1.0
    return digit * max(1, math.ceil(pressure / digit))


def _colours(plotter: pyvista.Plotter) -> NDArray[np.uint8]:
    """Return one palette (256, 3) for all frames: with different palettes, static parts would flicker."""
    tables = [np.asarray(bar.lookup_table.values)[:, :3] for bar in plotter.scalar_bars.values()]
    greys = np.linspace(0, 255, _GREYS)[:, None] * np.ones(3)
    shades = np.linspace(0.3, 1.0, _SHADES)[:, None] * np.array(ImageColor.getrgb(meshes.POINT_COLOUR))
    each = (256 - _GREYS - _SHADES) // len(tables)
    maps = [table[np.linspace(0, len(table) - 1, each).astype(int)] for table in tables]
    return np.concatenate([greys, shades, *maps]).astype(np.uint8)
