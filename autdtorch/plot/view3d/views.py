"""Rendered views of a scene and its field, and animations of the wave over one period."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from autdtorch.plot.colours import FLOOR, WAVE_MAP
from autdtorch.plot.data import in_decibels, largest, pressure_text, pressure_unit, zero_level
from autdtorch.plot.view3d import meshes
from autdtorch.plot.view3d.export import export_path, write
from autdtorch.plot.view3d.opengl import require_rendering
from autdtorch.scene.scene import Scene
from autdtorch.utils.files import in_folder
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    complex_tensor,
    integer_at_least,
    number_between,
    path_of,
    require_kind,
)

if TYPE_CHECKING:
    import pyvista

_FRAME_TIME = 80  # ms; GIF counts hundredths of a second

_GREYS, _SHADES = 24, 8  # of 256 colours: for lines and obstacles, and for control points


def view3d(
    scene: Scene,
    drive: ArrayLike | None = None,
    field: ArrayLike | None = None,
    volume: ArrayLike | None = None,
    *,
    isosurface: float = -3.0,
    reference: float | None = None,
    save: str | Path | None = None,
    off_screen: bool = True,
) -> pyvista.Plotter:
    """Render transducers, obstacles, control points, observation plane and field, in millimetres.

    Pressures outside the obstacles are shown as levels 20 lg(|p| / reference) from -30 to 0 dB. A caption
    gives the reference.

    Args:
        scene: scene to draw.
        drive: complex (M,); colours the transducers by phase. Silent transducers are grey.
        field: pressure on the observation plane (Nu, Nv) [Pa], complex or its magnitude, at the points of
            `Plane.points`; colours the plane. Without it, the plane is translucent.
        volume: pressure in the domain (Nx, Ny, Nz) [Pa], complex or its magnitude, from `volume_field`; NaN
            where unknown. It is shown as an isosurface.
        isosurface: level of the isosurface [dB], in -30 to 0.
        reference: the pressure of 0 dB [Pa], > 0; by default the largest of `field` or, without it, of
            `volume`. Pictures with equal references can be compared.
        save: file to write, ``.png``, ``.html`` (interactive; extra ``notebook``) or ``.gltf`` (for other 3D
            programs, in m, without axes and colour bars).
        off_screen: False for a plotter whose ``show()`` opens a window.

    Returns:
        The plotter, for changes or ``show()``; close it when done.

    Raises:
        RuntimeError: this machine cannot render, or cannot write HTML; the message names the cause.
        ValueError: `drive`, `field` or `volume` does not fit the scene, or another argument is out of range.
    """
    require_kind("scene", scene, Scene)
    off_screen = boolean("off_screen", off_screen)
    phases = None if drive is None else meshes.emitted_phases(drive, len(scene.array))
    on_plane = None if field is None else meshes.plane_pressure(scene, field)[1]
    in_domain = None if volume is None else meshes.volume_magnitude(scene, volume)
    height = number_between("isosurface", isosurface, FLOOR, 0.0, "dB")
    name, shown = ("volume", in_domain) if on_plane is None else ("field", on_plane)
    zero = zero_level(reference, name, np.ones(1) if shown is None else shown)
    path = None if save is None else export_path("save", save)
    require_rendering()
    plotter = meshes.new_plotter(scene, off_screen, (drive is not None, shown is not None))
    meshes.add_transducers(plotter, scene, phases)
    if scene.observation_plane is not None:
        level = None if on_plane is None else in_decibels(on_plane, zero)
        meshes.add_plane(plotter, scene.observation_plane, level)
    caption = [] if on_plane is None and in_domain is None else [f"0 dB = {pressure_text(zero)}"]
    if in_domain is not None:
        meshes.add_isosurface(plotter, scene, in_decibels(in_domain, zero), height)
        caption.append(f"surface: {height:g} dB")
    meshes.add_caption(plotter, *caption)
    if path is not None:
        write(plotter, path, scene, caption)
    return plotter


def animate3d(
    scene: Scene, drive: ArrayLike, field: ArrayLike, path: str | Path, *, frames: int = 24
) -> None:
    """Write a GIF of the instantaneous pressure Re(p e^{-i w t}) on the observation plane over one period.

    The colours of the transducers are their phases phi + w t. The GIF repeats without a jump. The pressure
    inside obstacles is not shown.

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
    plane, magnitude = meshes.plane_pressure(scene, field)
    pressure = complex_tensor("field", field).detach().cpu().numpy()
    unit, size = pressure_unit(largest(magnitude))
    pressure[np.isnan(magnitude)] = math.nan
    pressure /= size
    frames = integer_at_least("frames", frames, 2)
    path = path_of("path", path, suffixes=(".gif",))
    require_rendering()
    plotter = meshes.new_plotter(scene, off_screen=True, bars=(True, True))
    discs = meshes.add_transducers(plotter, scene, phases)
    sheet = meshes.plane_mesh(plane, pressure.real)
    peak = largest(magnitude) / size
    digit = 10.0 ** math.floor(math.log10(peak)) if peak else 1.0
    limit = digit * max(1, math.ceil(peak / digit))  # of one digit, for round numbers on the colour bar
    actor = meshes.add_sheet(plotter, sheet, WAVE_MAP, (-limit, limit))
    meshes.add_bar(plotter, actor, f"p(t) [{unit}]", position=meshes.FIELD_BAR, labels=5, fmt="%.3g")
    meshes.add_caption(plotter, f"one period: {1e6 / scene.frequency:.3g} µs")
    emitted = discs["phase"].copy()
    pictures = []
    for turn in np.arange(frames) / frames:
        discs["phase"] = (emitted + 2 * turn) % 2
        sheet.copy_from(meshes.plane_mesh(plane, (pressure * np.exp(-2j * math.pi * turn)).real))
        plotter.render()
        pictures.append(Image.fromarray(plotter.screenshot(return_img=True)))
    colours = _colours(plotter)
    plotter.close()
    palette = Image.new("P", (1, 1))
    palette.putpalette(colours.tobytes())
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(in_folder(path), save_all=True, append_images=others, duration=_FRAME_TIME, loop=0)


def _colours(plotter: pyvista.Plotter) -> NDArray[np.uint8]:
    """Return one palette (256, 3) for all frames: with different palettes, static parts would flicker."""
    tables = [np.asarray(bar.lookup_table.values)[:, :3] for bar in plotter.scalar_bars.values()]
    greys = np.linspace(0, 255, _GREYS)[:, None] * np.ones(3)
    shades = np.linspace(0.3, 1.0, _SHADES)[:, None] * np.array(ImageColor.getrgb(meshes.POINT_COLOUR))
    each = (256 - _GREYS - _SHADES) // len(tables)
    maps = [table[np.linspace(0, len(table) - 1, each).astype(int)] for table in tables]
    return np.concatenate([greys, shades, *maps]).astype(np.uint8)
