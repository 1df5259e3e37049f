"""Rendered views of a scene and its field."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from autdtorch.plot.colours import FLOOR
from autdtorch.plot.data import in_decibels
from autdtorch.plot.view3d import pressure_meshes as meshes
from autdtorch.plot.view3d.export import require_suffix, write
from autdtorch.plot.view3d.opengl import require_rendering
from autdtorch.plot.view3d.scene_meshes import add_caption, add_transducers, emitted_phases, new_plotter
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import ArrayLike, boolean, number_between, require_kind

if TYPE_CHECKING:
    import pyvista


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

    Pressures are shown as levels 20 lg(|p| / reference) from -30 to 0 dB. A caption gives the reference.

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
    phases = None if drive is None else emitted_phases(drive, len(scene.array))
    on_plane = None if field is None else meshes.plane_pressure(scene, field)[1]
    in_domain = None if volume is None else meshes.volume_magnitude(volume)
    height = number_between("isosurface", isosurface, FLOOR, 0.0, "dB")
    zero = meshes.zero_level(reference, on_plane, in_domain)
    path = None if save is None else require_suffix("save", save)
    require_rendering()
    plotter = new_plotter(scene, off_screen)
    add_transducers(plotter, scene, phases)
    if scene.observation_plane is not None:
        level = None if on_plane is None else in_decibels(on_plane, zero)
        meshes.add_plane(plotter, scene.observation_plane, level)
    caption = [] if on_plane is None and in_domain is None else [f"0 dB = {zero:.3g} Pa"]
    if in_domain is not None:
        meshes.add_isosurface(plotter, scene, in_decibels(in_domain, zero), height)
        caption.append(f"surface: {height:g} dB")
    add_caption(plotter, *caption)
    if path is not None:
        write(plotter, path, caption)
    return plotter
